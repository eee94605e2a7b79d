"""Results say which noise the readings had in the fit, and where it is from."""

from __future__ import annotations

from pathlib import Path

import pytest

import ltsim as lt
from ltsim.reports.sections import result_section

EXAMPLE = Path(lt.__file__).parent / "examples" / "survey.csv"


@pytest.mark.parametrize("verb", [lt.adjust, lt.calibrate])
def test_declared_assumed_and_estimated_noise(verb, tmp_path: Path) -> None:
    source = lt.read(EXAMPLE)
    assumed = "3 um + 0.3 ppm, 0.37 arcsec across, 0.37 arcsec in elevation; assumed"
    assert verb(source.replace(notes=source.notes), noise_from_data=True).noise_text.count(" times assumed") == 3
    declared = verb(lt.convert(EXAMPLE, tmp_path / "native").replace(notes=()))
    result = verb(source)
    if result.noise:  # calibrate replaces a noise that is far too large
        assert result.noise_text.endswith("estimated from the readings")
        assert " times declared" in declared.noise_text
    else:
        assert result.noise_text == assumed
        assert declared.noise_text == assumed.replace("assumed", "declared")
    if verb is lt.adjust:  # the verdict and the diagnosis speak of the same noise
        assert "smaller than assumed" in result.verdict.sentence
        assert "smaller than declared" in declared.verdict.sentence
    sentence = f"Noise of the readings (one sigma): {result.noise_text}."
    assert sentence in str(result) and sentence in result_section(result).terminal_text()


def test_noise_of_a_data_sheet_and_of_rows() -> None:
    recording, _ = lt.simulate("paper-workshop", seed=7)
    instrument = recording.setup.instrument.model_copy(update={"sheet": "leica-at960"})
    from_sheet = recording.replace(setup=recording.setup.model_copy(update={"instrument": instrument}))
    assert lt.adjust(from_sheet).noise_text.endswith("; of the data sheet leica-at960")
