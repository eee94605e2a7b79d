"""calibration.json and its companions: the agreed form, read back, and one sentence for whatever is wrong."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.calibration.correct import correct
from ltsim.calibration.evidence import amplitude_and_phase
from ltsim.calibration.files import read_calibration, write_calibration
from ltsim.calibration.network import calibrate_network
from ltsim.core.errors import NetworkError, RecordError
from ltsim.core.units import MICRORADIAN
from ltsim.geometry.polar import from_polar
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings.setup import Instrument, Setup, Station
from ltsim.reports.sections import result_section


@pytest.fixture(scope="module")
def calibration(make, drawn):
    return calibrate_network(make(drawn(misalignment_construction(), 3, 0), faces=(1, 2)), recommend_measurements=False)


def test_keys_and_units_of_the_file(calibration, tmp_path: Path) -> None:
    write_calibration(calibration, tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {
        "calibration.json",
        "residuals.csv",
        "targets.covariance.csv",
        "targets.csv",
    }
    content = json.loads((tmp_path / "calibration.json").read_text())
    assert content["format"] == "ltsim-calibration/1"
    assert (content["method"], content["construction"]) == ("network", "misalignment")
    assert {"chi2", "dof", "sigma0", "p_value", "iterations", "status"} <= set(content["fit"])
    tilt = next(p for p in content["parameters"] if p["name"] == "beam-tilt")
    at = calibration.instrument_parameter_names.index("beam-tilt")
    assert tilt["unit"] == "urad"
    assert tilt["value"] == pytest.approx(calibration.estimates[0, at] / MICRORADIAN)
    assert tilt["prior_sigma"] == pytest.approx(14.54, abs=0.01)
    assert np.sqrt(content["covariance"][at][at]) == pytest.approx(tilt["sigma"])
    station = content["stations"][0]
    assert station["position_mm"] == pytest.approx([0, 0, 0], abs=1e-6)
    assert station["rotation_quaternion"] == pytest.approx([0, 0, 0, 1], abs=1e-9)
    assert content["frame"] == "the frame of station S1"
    assert set(content["criteria"]["distance"]) == {"before", "after", "improvement_percent"}


def test_tables(calibration, tmp_path: Path) -> None:
    write_calibration(calibration, tmp_path)
    targets = list(csv.DictReader((tmp_path / "targets.csv").read_text().splitlines()))
    assert list(targets[0]) == ["target", "x_mm", "y_mm", "z_mm", "sigma_x_mm", "sigma_y_mm", "sigma_z_mm"]
    assert float(targets[3]["y_mm"]) == pytest.approx(1e3 * calibration.target_points[3, 1], abs=1e-6)
    rows = list(csv.DictReader((tmp_path / "residuals.csv").read_text().splitlines()))
    wanted = "row station target face repeat observable residual unit redundancy w"
    assert list(rows[0]) == wanted.split()
    assert len(rows) == int(calibration.adjustment.problem.is_used_reading.sum())
    assert (rows[0]["row"], rows[0]["observable"], rows[0]["unit"]) == ("1", "distance", "mm")
    assert rows[1]["unit"] == "arcsec"
    assert float(rows[0]["residual"]) == pytest.approx(1e3 * calibration.adjustment.residuals[0, 0], rel=1e-4)


def test_read_back_is_the_same(calibration, tmp_path: Path) -> None:
    write_calibration(calibration, tmp_path)
    again = read_calibration(tmp_path / "calibration.json")
    assert np.allclose(again.estimates, calibration.estimates, rtol=1e-12, atol=0)
    scale = np.sqrt(np.diag(calibration.covariance))
    assert np.allclose(again.covariance / np.outer(scale, scale), calibration.covariance / np.outer(scale, scale))
    assert again.instrument_parameter_names == calibration.instrument_parameter_names
    assert again.fit == calibration.fit
    assert [c.gain for c in again.undetermined] == [c.gain for c in calibration.undetermined]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(format="ltsim-calibration/9"), "format is 'ltsim-calibration/9'"),
        (lambda c: c.pop("parameters"), "parameters: Field required"),
        (
            lambda c: c["parameters"][0].update(name="beam-tlt"),
            r"no parameter of construction misalignment called 'beam-tlt'; did you mean beam-tilt",
        ),
        (
            lambda c: c["parameters"][0].update(name="???"),
            r"called '\?\?\?'; did you mean azimuth-eccentricity-cos",
        ),
        (lambda c: c["parameters"].__setitem__(1, c["parameters"][0]), "occurs twice"),
        (lambda c: c["parameters"][0].update(unit="furlong"), "unknown unit 'furlong'"),
        (lambda c: c["parameters"][0].update(value="much"), "parameters.0.value"),
        (lambda c: c["covariance"].pop(), "not a matrix of 16 x 16"),
        (lambda c: c.update(construction="mirror"), "no construction called 'mirror'"),
    ],
)
def test_wrong_files_are_refused_in_a_sentence(calibration, tmp_path: Path, change, message: str) -> None:
    write_calibration(calibration, tmp_path)
    file = tmp_path / "calibration.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))
    with pytest.raises(RecordError, match=message) as caught:
        read_calibration(file)
    assert "\n" not in str(caught.value)
    assert str(file) in str(caught.value)


def test_parameters_missing_in_a_file_are_zero_and_reported(calibration, tmp_path: Path) -> None:
    write_calibration(calibration, tmp_path)
    content = json.loads((tmp_path / "calibration.json").read_text())
    rows = [0, 4]
    content["parameters"] = [content["parameters"][i] for i in rows]
    content["covariance"] = [[content["covariance"][i][j] for j in rows] for i in rows]
    (tmp_path / "calibration.json").write_text(json.dumps(content))
    restored = read_calibration(tmp_path)
    rest = np.setdiff1d(np.arange(16), rows)
    assert restored.instrument_parameter_names == calibration.instrument_parameter_names
    assert np.allclose(restored.estimates[0, rows], calibration.estimates[0, rows], rtol=1e-12)
    assert np.allclose(restored.sigma[0, rows], calibration.sigma[0, rows], rtol=1e-9)
    assert np.all(restored.estimates[0, rest] == 0)
    assert np.array_equal(restored.sigma[0, rest], restored.prior_sigma[0, rest])
    (note,) = restored.warnings
    assert "14 parameters are not in the file and taken as zero: range-scale, " in note
    assert note.endswith("and 8 more")


def test_a_file_written_by_hand_needs_name_value_and_unit(tmp_path: Path) -> None:
    text = {"format": "ltsim-calibration/1", "construction": "misalignment"}
    rows = [{"name": "beam-tilt", "value": 5.9, "unit": "urad"}]
    (tmp_path / "hand.json").write_text(json.dumps(text | {"parameters": rows}))
    calibration = read_calibration(tmp_path / "hand.json")
    at = calibration.instrument_parameter_names.index("beam-tilt")
    assert calibration.estimates[0, at] == pytest.approx(5.9e-6)
    assert np.count_nonzero(calibration.estimates) == 1
    assert calibration.sigma[0, at] == calibration.prior_sigma[0, at]
    assert "15 parameters" in calibration.warnings[0]


def test_files_that_are_not_json(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="no such file"):
        read_calibration(tmp_path / "none.json")
    (tmp_path / "cut.json").write_text('{"format": ')
    with pytest.raises(RecordError, match="not JSON"):
        read_calibration(tmp_path / "cut.json")


def test_nothing_half_written(calibration, tmp_path: Path) -> None:
    target = tmp_path / "taken"
    target.write_text("a file where a folder should be")
    with pytest.raises(RecordError):
        write_calibration(calibration, target)
    assert target.read_text() == "a file where a folder should be"
    assert list(tmp_path.iterdir()) == [target]


def test_corrected_readings_are_those_of_an_ideal_tracker(make, drawn) -> None:
    truth = drawn(misalignment_construction(), 3, 1)
    recording = make(truth, faces=(1, 2), noise=0.0)
    calibration = calibrate_network(make(truth, faces=(1, 2)), recommend_measurements=False)
    exact = calibration.with_changes(estimates=truth[None], correction=None)
    corrected = correct(recording, exact)
    ideal = make(np.zeros(16), faces=(1, 2), noise=0.0)
    assert np.abs(corrected.readings - ideal.readings).max() < 1e-12
    assert corrected.setup.instrument.corrected
    assert not recording.setup.instrument.corrected
    # Corrected once, nothing is left to find.
    again = calibrate_network(corrected, recommend_measurements=False)
    assert np.abs(again.estimates / again.sigma).max() < 0.01


def test_a_row_without_range_is_corrected_where_its_target_is(make, drawn) -> None:
    truth = drawn(misalignment_construction(), 3, 2)
    recording = make(truth, faces=(1,))
    readings = recording.readings.copy()
    readings[5, 0] = np.nan
    calibration = calibrate_network(recording, recommend_measurements=False)
    whole, partly = correct(recording, calibration), correct(recording.with_readings(readings), calibration)
    assert np.isnan(partly.readings[5, 0])
    assert np.abs(partly.readings[5, 1:] - whole.readings[5, 1:]).max() < 1e-9
    alone = recording.with_readings(readings).select(recording.station == 0)
    alone = alone.with_readings(np.where(alone.target[:, None] == 5, np.nan, alone.readings))
    alone.readings[5, 1:] = readings[5, 1:]
    with pytest.raises(NetworkError, match="row 6 lacks a range or an angle"):
        correct(alone, calibration)


def test_two_instruments_have_separate_parameters(make, drawn, tmp_path: Path) -> None:
    first, second = drawn(misalignment_construction(), 3, 3), drawn(misalignment_construction(), 3, 4)
    first_recording, two = make(first, faces=(1, 2), trial=1), make(second, faces=(1, 2), trial=1)
    later = first_recording.station >= 2
    setup = Setup(
        gauge=first_recording.setup.gauge,
        instruments={"A": Instrument(), "B": Instrument()},
        stations={name: Station(instrument="AABB"[i]) for i, name in enumerate(first_recording.stations)},
    )
    both = first_recording.replace(
        setup=setup, readings=np.where(later[:, None], two.readings, first_recording.readings)
    )
    calibration = calibrate_network(both, recommend_measurements=False)
    assert calibration.estimates.shape == (2, 16)
    truth = np.stack([first, second])
    assert np.abs((calibration.estimates - truth) / calibration.sigma).max() < 4.5
    write_calibration(calibration, tmp_path)
    again = read_calibration(tmp_path)
    assert again.instruments == ("A", "B")
    assert np.allclose(again.estimates, calibration.estimates)
    applied = again.applied_values_for(both)
    assert np.allclose(applied[later], calibration.estimates[1])
    with pytest.raises(RecordError, match=r"is not in the calibration \(A, B\)"):
        again.applied_values_for(first_recording)


def test_adjustment_without_parameters_is_written_too(make, tmp_path: Path) -> None:
    write_calibration(lt.adjust(make(np.zeros(16))), tmp_path)
    content = json.loads((tmp_path / "calibration.json").read_text())
    assert content["parameters"] == []
    assert "after" not in content["criteria"]["distance"]
    assert read_calibration(tmp_path).estimates.shape == (1, 0)


def test_outliers_are_listed_and_gross_rows_excluded(make) -> None:
    recording = make(np.zeros(16), faces=(1, 2))
    readings = recording.readings.copy()
    readings[16, 0] += 80e-6
    swap = readings[[3, 4]]
    readings[[3, 4]] = swap[::-1]
    calibration = calibrate_network(recording.with_readings(readings), recommend_measurements=False)
    gross = {(o.row, o.pointing_excluded) for o in calibration.outliers if o.pointing_excluded}
    assert gross == {(4, True), (5, True)}
    single = next(o for o in calibration.outliers if not o.pointing_excluded)
    assert (single.row, single.station, single.observable, single.unit) == (17, "S1", "distance", "mm")
    assert single.size == pytest.approx(0.08, abs=0.02)


def test_amplitude_and_phase() -> None:
    covariance = np.diag([0.04, 0.01])
    amplitude, sigma, phase, spread = amplitude_and_phase(np.array([3.0, 4.0]), covariance)
    assert (amplitude, phase) == (pytest.approx(5.0), pytest.approx(np.arctan2(4, 3)))
    draws = np.array([3.0, 4.0]) + np.random.default_rng(0).standard_normal((40000, 2)) * [0.2, 0.1]
    assert sigma == pytest.approx(np.std(np.hypot(*draws.T)), rel=0.02)
    assert spread == pytest.approx(np.std(np.arctan2(draws[:, 1], draws[:, 0])), rel=0.02)
    assert amplitude_and_phase(np.array([0.1, 0.1]), covariance)[2:] == (None, None)
    assert amplitude_and_phase(np.zeros(2), covariance) == (0.0, pytest.approx(np.sqrt(0.025)), None, None)


def test_harmonics_of_a_calibration(calibration) -> None:
    harmonics_by_name = {h.name: h for h in calibration.harmonics}
    assert set(harmonics_by_name) == {
        "azimuth-eccentricity",
        "azimuth-second-order",
        "elevation-eccentricity",
        "elevation-second-order",
    }
    at = calibration.instrument_parameter_names.index("azimuth-eccentricity-cos")
    wave = harmonics_by_name["azimuth-eccentricity"]
    amplitude = 1e-6 * wave.amplitude
    assert wave.unit == "urad"
    assert amplitude == pytest.approx(np.hypot(*calibration.estimates[0, at : at + 2]))
    assert wave.phase_deg is not None
    angle = np.linspace(-3, 3, 7)
    series = calibration.estimates[0, at] * np.cos(angle) + calibration.estimates[0, at + 1] * np.sin(angle)
    assert np.allclose(amplitude * np.cos(angle - np.radians(wave.phase_deg)), series)


def test_points_do_not_move_by_correction(calibration, make, drawn) -> None:
    recording = make(drawn(misalignment_construction(), 3, 5))
    corrected = correct(recording, calibration)
    values = calibration.estimates[0]
    assert np.allclose(
        from_polar(corrected.readings), misalignment_construction().points_from_readings(recording.readings, values)
    )


def test_calibration_without_fit_statistics_has_no_convergence_warning(tmp_path: Path) -> None:
    content = {
        "format": "ltsim-calibration/1",
        "construction": "misalignment",
        "parameters": [{"name": "beam-tilt", "value": 5.0, "unit": "urad", "sigma": 1.0, "prior_sigma": 10.0}],
    }
    (tmp_path / "calibration.json").write_text(json.dumps(content))
    blocks = result_section(read_calibration(tmp_path / "calibration.json")).blocks
    assert not [block.title for block in blocks if "converge" in block.title]
