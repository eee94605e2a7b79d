"""Built-in data sheets: where they come from, what they become, what they leave to the person."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.core.errors import InputError, ModelError, RecordError
from ltsim.core.units import ARCSECOND, MICROMETRE, MILLIMETRE
from ltsim.recordings.specification import (
    MPE_COVERAGE_FACTOR,
    REQUIRED_LIMIT_KEYS,
    Specification,
    data_sheet_names,
    data_sheet_specification,
    data_sheet_values,
    noise_and_prior_tables,
)

RANGE_TABLES = {
    "noise": {"distance_mm": 0.004, "distance_ppm": 0.1},
    "prior": {"range_scale_ppm": 0.2, "range_offset_mm": 0.003},
}
WHOLE = [name for name in data_sheet_names() if all(key in data_sheet_values(name) for key in REQUIRED_LIMIT_KEYS)]


def limits_of(noise: dict[str, float], prior: dict[str, float], *, has_separate_zero: bool) -> dict[str, float]:
    """Limits whose `COVERAGE`-th part noise and prior are, each as the root sum of squares of its parts."""
    zero = [noise["distance_mm"]] if has_separate_zero else [noise["distance_mm"], prior["range_offset_mm"]]
    angle = np.hypot(noise["azimuth_arcsec"], np.sqrt(2) * prior["angle_arcsec"])
    return {
        "transverse_limit_um": MPE_COVERAGE_FACTOR * prior["offset_mm"] * MILLIMETRE / MICROMETRE,
        "transverse_limit_um_per_m": MPE_COVERAGE_FACTOR * angle * ARCSECOND / MICROMETRE,
        "range_limit_um": MPE_COVERAGE_FACTOR * float(np.linalg.norm(zero)) * MILLIMETRE / MICROMETRE,
        "range_limit_um_per_m": MPE_COVERAGE_FACTOR * float(np.hypot(noise["distance_ppm"], prior["range_scale_ppm"])),
        "range_offset_limit_um": MPE_COVERAGE_FACTOR * prior["range_offset_mm"] * MILLIMETRE / MICROMETRE
        if has_separate_zero
        else 0.0,
    }


@pytest.mark.parametrize("name", data_sheet_names())
def test_noise_and_prior_give_the_declared_limits_back(name: str) -> None:
    limits = data_sheet_values(name)
    tables = noise_and_prior_tables(name, RANGE_TABLES)
    made = limits_of(tables["noise"], tables["prior"], has_separate_zero="range_offset_limit_um" in limits)
    keys = [key for key in made if key in limits and (name in WHOLE or key.startswith("transverse"))]
    assert keys[:2] == ["transverse_limit_um", "transverse_limit_um_per_m"]
    assert {key: made[key] for key in keys} == pytest.approx({key: limits[key] for key in keys}, abs=3e-3, rel=1e-5)


def test_every_sheet_says_where_its_figures_stand() -> None:
    for name in data_sheet_names():
        assert re.search(r"\d{4}|p\. \d|\.com/", data_sheet_values(name)["source"]), name
        assert data_sheet_values(name)["name"]
    assert set(WHOLE) == {"leica-at500", "faro-vantage", "sensors-2021"}


def test_no_range_is_guessed() -> None:
    with pytest.raises(ModelError, match="leica-at960 does not give range_limit_um"):
        data_sheet_specification("leica-at960")
    with pytest.raises(ModelError, match=r"give errors of ranges; set prior\.range_scale_ppm, prior\.range_offset"):
        noise_and_prior_tables("api-radian", {"noise": RANGE_TABLES["noise"]})


def test_a_specification_completes_a_sheet() -> None:
    plan = {"standard": "asme-b89.4.19-2006", "instrument": "leica-at960"}
    with pytest.raises(InputError, match="does not give range_limit_um; set it in the table"):
        lt.accept(plan)
    specification = lt.accept({**plan, "specification": {"range_limit_um": 10}}).specification
    assert (specification.transverse_limit_um, specification.range_limit_um, specification.range_limit_um_per_m) == (
        15,
        10,
        0.5,
    )
    assert specification.source.endswith("not from the data sheet: range_limit_um")


LIMIT_SETTINGS = {
    "instrument.limits.elevation_min_deg": -50.0,
    "instrument.limits.elevation_max_deg": 75.0,
    "instrument.limits.range_min_mm": 500.0,
    "instrument.limits.range_max_mm": 35_000.0,
}


def test_limits_of_another_instrument_are_dropped() -> None:
    """A preset took the 20 m and the travel of the paper's tracker without a word."""
    with pytest.raises(InputError, match=r"and ranges; set limits.*limits.range_max_mm in the table"):
        lt.scenario("paper-workshop", {"instrument.preset": "faro-vantage"})
    subset = {key: x for key, x in LIMIT_SETTINGS.items() if "range_max" not in key}
    with pytest.raises(InputError, match=r"set limits\.range_max_mm in the table \[instrument\]$"):
        lt.scenario("paper-workshop", {"instrument.preset": "faro-vantage", **subset})


def test_a_scenario_takes_a_sheet_as_preset() -> None:
    tracker = lt.scenario("paper-workshop", {"instrument.preset": "faro-vantage", **LIMIT_SETTINGS}).instrument
    assert tracker.limits.range_max_mm == 35_000.0
    assert tracker.noise.model_dump() == noise_and_prior_tables("faro-vantage", {})["noise"]
    with pytest.raises(InputError, match="does not give errors of ranges"):
        lt.scenario("paper-workshop", {"instrument.preset": "leica-at901"})
    settings = {f"instrument.{table}.{key}": x for table, values in RANGE_TABLES.items() for key, x in values.items()}
    tracker = lt.scenario(
        "paper-workshop", {"instrument.preset": "leica-at901", **settings, **LIMIT_SETTINGS}
    ).instrument
    assert tracker.noise.distance_mm == 0.004
    assert tracker.noise.azimuth_arcsec == pytest.approx(
        data_sheet_values("leica-at901")["transverse_limit_um_per_m"] * 0.0729, rel=1e-3
    )


def test_a_recording_takes_a_sheet(tmp_path: Path) -> None:
    recording, _ = lt.simulate("paper-laboratory", seed=1)
    lt.write(recording, tmp_path / "rec")
    file = tmp_path / "rec" / "setup.toml"
    text = re.sub(r"\[instrument\.noise\].*?(?=\[stations)", "", file.read_text(), flags=re.DOTALL)
    setup_text = '[instrument]\nsheet = "leica-at500"\nnoise = {distance_mm = 0.002}\n'
    file.write_text(text.replace("[instrument]\n", setup_text))
    instrument = lt.read(tmp_path / "rec").setup.instrument
    assert instrument.model == "Leica Absolute Tracker AT500"
    assert (instrument.noise.distance_mm, instrument.noise.distance_ppm) == (0.002, pytest.approx(0.106066))
    lt.write(lt.read(tmp_path / "rec"), tmp_path / "again")
    assert lt.read(tmp_path / "again").setup.instrument == instrument
    file.write_text(file.read_text().replace("leica-at500", "leica-at50"))
    with pytest.raises(
        RecordError, match=r"instrument\.sheet: there is no data sheet called 'leica-at50'; did you mean leica"
    ):
        lt.read(tmp_path / "rec")


def test_a_users_specification_becomes_an_instrument() -> None:
    specification = Specification(
        transverse_limit_um=0, transverse_limit_um_per_m=6, range_limit_um=10, range_limit_um_per_m=0
    )
    instrument = specification.to_instrument()
    made = limits_of(instrument.noise.model_dump(), instrument.prior.model_dump(), has_separate_zero=False)
    assert made["transverse_limit_um_per_m"] == pytest.approx(6)
    assert made["range_limit_um"] == pytest.approx(10)
    assert "2 standard deviations" in specification.limit_interpretation_sentence


def test_a_sheet_below_what_the_file_states_itself_is_reported_key_by_key(tmp_path: Path) -> None:
    """A converted table states the default noise in full: a sheet that is named beside it would change nothing."""
    lt.write(lt.simulate("paper-workshop", seed=1)[0], tmp_path / "rec")
    setup = tmp_path / "rec" / "setup.toml"
    whole = setup.read_text()
    setup.write_text(whole.replace("[instrument]\n", '[instrument]\nsheet = "leica-at500"\n', 1))
    notes = [note for note in lt.read(tmp_path / "rec").notes if "replace values of the data sheet leica-at500" in note]
    assert len(notes) == 1
    assert "noise.azimuth_arcsec" in notes[0]
    assert "prior.range_scale_ppm" in notes[0]
    bare = re.sub(r"\[instrument\.(noise|prior)\]\n(.+\n)*", "", setup.read_text())
    setup.write_text(bare)
    assert not [note for note in lt.read(tmp_path / "rec").notes if "replace values" in note]
