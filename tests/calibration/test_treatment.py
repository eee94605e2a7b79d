"""Outliers left out, noise from the readings, datum by inner constraints: what the calibration says of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.adjustment.snooping import screen_gross_errors
from ltsim.calibration.correct import correct
from ltsim.calibration.distance import calibrate_distance
from ltsim.calibration.files import write_calibration
from ltsim.calibration.network import calibrate_network
from ltsim.core.errors import ModelError, NetworkError
from ltsim.recordings import Hints, read
from ltsim.recordings.recording import OBSERVABLES
from ltsim.recordings.setup import Target


@pytest.fixture(scope="module")
def spoiled(make):
    """A recording whose ranges are twice as noisy as stated, with three wrong readings."""
    recording = make(np.zeros(16), faces=(1, 2))
    extra = np.random.default_rng(8).standard_normal(len(recording))
    readings = recording.readings.copy()
    readings[:, 0] += np.sqrt(3.0) * recording.reading_sigmas()[:, 0] * extra
    for row, column, size in ((16, 0, 150e-6), (40, 1, 40e-6), (90, 2, -50e-6)):
        readings[row, column] += size
    return recording.with_readings(readings)


def test_robust_leaves_out_what_does_not_belong_and_says_so(spoiled, tmp_path: Path) -> None:
    calibration = calibrate_network(spoiled, recommend_measurements=False, robust=True, noise_from_data=True)
    write_calibration(calibration, tmp_path)
    content = json.loads((tmp_path / "calibration.json").read_text())
    excluded = [(o["row"], o["observable"]) for o in content["outliers"] if o["excluded"]]
    assert sorted(excluded) == [(17, "distance"), (41, "azimuth"), (91, "elevation")]
    sizes = {o["row"]: o["size"] for o in content["outliers"]}
    assert sizes[17] == pytest.approx(0.15, abs=0.05)
    used = (tmp_path / "residuals.csv").read_text()
    assert "\n17,S1,T17,1,1,azimuth" in used
    assert "\n17,S1,T17,1,1,distance" not in used
    assert content["robust"] is True


def test_noise_of_each_observable_is_estimated_and_written(spoiled) -> None:
    calibration = calibrate_network(spoiled, recommend_measurements=False, robust=True, noise_from_data=True)
    rows = {n["observable"]: n for n in calibration.content()["noise"]}
    assert list(rows) == ["distance", "azimuth", "elevation"]
    for name, truth in (("distance", 2.0), ("azimuth", 1.0), ("elevation", 1.0)):
        assert abs(rows[name]["factor"] - truth) < 3.5 * rows[name]["factor_sigma"]
    median_sigma = np.median(spoiled.reading_sigmas()[:, 0])
    assert rows["distance"]["median_sigma"] == pytest.approx(rows["distance"]["factor"] * median_sigma * 1e3, rel=0.01)
    assert rows["distance"]["unit"] == "mm"
    assert calibration.fit.sigma0 == pytest.approx(1.0, abs=0.03)
    plain = calibrate_network(spoiled, recommend_measurements=False)
    assert plain.noise == ()


def test_noise_that_could_not_be_estimated_leaves_the_fit_a_test(make) -> None:
    recording = make(np.zeros(16))
    recording = recording.select((recording.station < 2) & (recording.target < 4))
    readings = recording.readings.copy()
    readings[0, 0] += 1e-4
    adjustment = lt.adjust(recording.with_readings(readings), noise_from_data=True)
    assert not adjustment.noise_estimated
    assert any(n.factor_sigma is None for n in adjustment.noise)
    content = adjustment.content()
    assert content["noise_estimated"] is False
    assert None in [n["factor_sigma"] for n in content["noise"]]
    assert content["verdict"]["sentence"]


def test_the_verdict_is_written_where_tests_conflict(make) -> None:
    recording = make(np.zeros(16), faces=(1, 2))
    clean = calibrate_network(recording, recommend_measurements=False).content()["verdict"]
    assert clean["case"] == "clean"
    readings = recording.readings.copy()
    readings[16, 0] += 30e-6
    first_calibration = calibrate_network(recording.with_readings(readings), recommend_measurements=False)
    verdict = first_calibration.content()["verdict"]
    assert verdict["case"] == "single errors hidden in the sum"
    assert verdict["sentence"].startswith("One reading is an outlier. Trust the test of single readings, although")
    assert first_calibration.fit.p_value > 0.01
    quiet = recording.with_readings(recording.readings)
    noise = recording.setup.instrument.noise
    wide = noise.model_copy(update={k: 3 * v for k, v in noise.model_dump().items()})
    instrument = recording.setup.instrument.model_copy(update={"noise": wide})
    setup = recording.setup.model_copy(update={"instrument": instrument})
    quiet = quiet.replace(setup=setup)
    verdict = calibrate_network(quiet, recommend_measurements=False, choose_correction=False).content()["verdict"]
    assert verdict["case"] == "smaller noise"
    assert verdict["is_sigma0_credible"] is True
    with_noise = calibrate_network(quiet, recommend_measurements=False)
    assert any("the estimated noise replaces it" in note for note in with_noise.notes)
    assert {n.observable: round(3 * n.factor) for n in with_noise.noise} == dict.fromkeys(OBSERVABLES, 1)


def test_a_target_without_a_place_is_named_and_has_no_coordinates(make, tmp_path: Path) -> None:
    recording = make(np.zeros(16))
    keep = (recording.target != 7) | (recording.station < 2)
    recording = recording.select(keep)
    rows = np.flatnonzero(recording.target == 7)
    readings = recording.readings.copy()
    readings[rows[0], 1] = np.nan
    readings[rows[1]] = np.nan
    calibration = calibrate_network(recording.with_readings(readings), recommend_measurements=False)
    assert calibration.undetermined_targets == ("T08",)
    advised = calibrate_network(recording.with_readings(readings))
    assert np.allclose(advised.estimates, calibration.estimates)
    assert all(c.cure for c in advised.undetermined)
    by_distance = calibrate_distance(recording.with_readings(readings))
    assert by_distance.undetermined_targets == ("T08",)
    assert not screen_gross_errors(recording.with_readings(readings)).is_gross_pointing.any()
    with pytest.raises(NetworkError, match=r"lacks a range or an angle.* no reading connects target T08"):
        correct(recording.with_readings(readings), calibration)
    write_calibration(calibration, tmp_path)
    assert json.loads((tmp_path / "calibration.json").read_text())["undetermined_targets"] == ["T08"]
    table = (tmp_path / "targets.csv").read_text().splitlines()
    assert len(table) == len(recording.targets)
    assert not any(line.startswith("T08") for line in table)
    assert "nan" not in "".join(table)


def test_datum_by_inner_constraints_is_the_s_transformation(make) -> None:
    """Baarda's C' = S C S^T with S = I - G (B^T G)^-1 B^T, written out here with whole matrices."""
    recording = make(np.zeros(16))
    names = ("T03", "T09", "T14", "T22")
    plain, adjustment = adjust(recording), lt.adjust(recording, datum=names)
    unknowns, points = plain.problem.unknowns, plain.state.target_points
    whole = plain.factorised_normals.multiply_by_covariance(np.eye(unknowns.n_columns))
    chosen = [recording.targets.index(name) for name in names]
    motion = np.zeros((unknowns.n_columns, 6))
    motion[unknowns.target_columns.ravel(), :3] = np.tile(np.eye(3), (len(points), 1))
    for axis in range(3):
        turn = np.eye(3)[axis]
        motion[unknowns.target_columns.ravel(), 3 + axis] = np.cross(turn, points).ravel()
    motion[unknowns.pose_columns[:, :3].ravel(), :3] = np.tile(np.eye(3), (len(plain.state.station_positions), 1))
    for axis in range(3):
        motion[unknowns.pose_columns[:, :3].ravel(), 3 + axis] = np.cross(
            np.eye(3)[axis], plain.state.station_positions
        ).ravel()
    motion[unknowns.pose_columns[:, 3:].ravel(), 3:] = np.tile(np.eye(3), (len(plain.state.station_positions), 1))
    held = np.zeros_like(motion)
    held[unknowns.target_columns[chosen].ravel()] = motion[unknowns.target_columns[chosen].ravel()]
    s = np.eye(unknowns.n_columns) - motion @ np.linalg.solve(held.T @ motion, held.T)
    wanted = s @ whole @ s.T
    blocks = wanted[unknowns.target_columns[:, :, None], unknowns.target_columns[:, None, :]]
    np.testing.assert_allclose(adjustment.target_covariances, blocks, rtol=1e-4, atol=1e-16)
    sums = wanted[unknowns.target_columns[chosen].ravel()].reshape(len(chosen), 3, -1).sum(axis=0)
    assert np.abs(sums).max() < 1e-6 * np.abs(wanted).max()
    trace = np.einsum("tii->t", adjustment.target_covariances)[chosen].sum()
    assert trace < 0.9 * np.einsum("tii->t", plain.target_covariances)[chosen].sum()
    assert (
        adjustment.frame == "the frame of station S1, standard deviations by inner constraints over T03, T09, T14, T22"
    )
    np.testing.assert_allclose(adjustment.target_points, plain.state.target_points, atol=1e-12)


def test_a_datum_that_cannot_be_is_refused(make) -> None:
    recording = make(np.zeros(16))
    with pytest.raises(ModelError, match="target of the datum called 'T99'"):
        lt.adjust(recording, datum=("T99", "T01", "T02"))
    with pytest.raises(ModelError, match="at least three that are not on one line"):
        lt.adjust(recording, datum=("T01", "T02"))
    places = [(0, (1.0, 0.02, 0.2)), (3, (1.0, 0.02, 1.6)), (23, (0.02, 4.9, 5.6))]
    references = {f"T{i + 1:02d}": Target(known_mm=tuple(1e3 * v for v in p), known_sigma_mm=0.01) for i, p in places}
    held = recording.replace(setup=recording.setup.model_copy(update={"targets": references}))
    with pytest.raises(NetworkError, match="control points define the frame already"):
        lt.adjust(held, datum=("T02", "T05", "T09"))


# --- real recordings ----------------------------------------------------------------------------------------------


def recorded(shared: Path, place: str, **options):
    file = shared / "recordings" / place
    if not file.is_file():
        pytest.skip(f"../shared/recordings/{place} is not beside this checkout")
    return read(file, **options)


@pytest.mark.long
def test_esa_robust_with_noise_of_each_instrument(shared: Path) -> None:
    recording = recorded(shared, "cern-lgc-trackers/20697_V2_Dirk_ESA_experimental.lgc")
    plain = lt.adjust(recording)
    assert plain.verdict is not None
    assert "4 readings are outliers. " in plain.verdict.sentence and "fails only because" in plain.verdict.sentence
    adjustment = lt.adjust(recording, robust=True, noise_from_data=True)
    excluded_rows = {o.row for o in adjustment.outliers if o.excluded}
    assert {42, 199, 361, 362, 348, 363} <= excluded_rows
    assert 41 not in excluded_rows
    assert len({n.instrument for n in adjustment.noise if n.observable != "level"}) == 3
    noise = {(n.instrument, n.observable): n for n in adjustment.noise}
    level = noise["", "level"]
    assert (level.factor, level.factor_sigma) == (1.0, None)  # exact levels: nothing to estimate
    assert adjustment.fit.sigma0 == pytest.approx(1.0, abs=0.01)


@pytest.mark.long
def test_desy_noise_and_the_nest_that_moved(shared: Path) -> None:
    place = "desy-girder-at960/Polar_measurements_24Feb22.txt"
    recording = recorded(shared, place, hints=Hints(azimuth="clockwise"))
    calibration = calibrate_network(recording, recommend_measurements=False, robust=True, noise_from_data=True)
    noise = {n.observable: n for n in calibration.noise}
    assert noise["distance"].factor < 0.6
    assert noise["azimuth"].median_sigma == pytest.approx(0.41, abs=0.08)
    assert noise["elevation"].median_sigma == pytest.approx(0.56, abs=0.08)
    assert (
        "K6" in calibration.undetermined_targets
    )  # its two faces differ by 32 um in range, and nothing else measured it
    assert {(81, "distance"), (82, "distance")} <= {(o.row, o.observable) for o in calibration.outliers if o.excluded}
