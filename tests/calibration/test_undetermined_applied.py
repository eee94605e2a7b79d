"""Correction of parameters that a recording does not determine."""

from pathlib import Path

import pytest

import ltsim as lt
from ltsim.cli.main import run


def test_an_undetermined_parameter_is_not_applied_and_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without reference lengths a network contains no information on the range scale."""
    recording, _ = lt.simulate("paper-workshop", seed=3)
    recording = recording.replace(setup=recording.setup.model_copy(update={"gauge": None}))
    calibration = lt.calibrate(recording, advise=False)
    scale = calibration.construction.parameter_names.index("range-scale")
    assert calibration.parameters[scale].variance_reduction < 0.01
    assert calibration.applied_values[0, scale] == 0.0
    assert abs(calibration.applied_values[0]).max() > 0.0
    lt.write(recording, tmp_path / "rec")
    assert run(["calibrate", str(tmp_path / "rec")]) in (0, 1)
    assert "Not determined by the recording, so that the prior remains: range-scale." in capsys.readouterr().out
