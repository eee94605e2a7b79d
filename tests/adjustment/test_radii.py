"""SMRs of several radii in one job: what is adjusted is one point a target, whatever SMR was in its nest."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.adjustment.identification import identify_causes
from ltsim.campaigns.true_network import make_true_network
from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError, NetworkError, RecordError
from ltsim.core.randomness import random_stream
from ltsim.geometry.polar import wrap_angle
from ltsim.measurands.inputs import TaskInputs
from ltsim.measurands.spec import validate_tasks
from ltsim.physics.model.construction import ideal_construction, misalignment_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.exchange import write
from ltsim.recordings.native import read_recording, write_recording
from ltsim.recordings.recording import Recording
from ltsim.recordings.reflectors import excess_radii
from ltsim.recordings.setup import Target
from ltsim.recordings.transcription_errors import UNIT_AND_CONVENTION_ERRORS
from ltsim.simulation.scenario import Scenario, change_scenario, load_scenario, scenario_to_toml, validate_scenario
from ltsim.simulation.truth import Truth

HERE = Path("reflectors.toml")
REFLECTORS = {"large": {"radius_mm": 19.05}, "small": {"radius_mm": 6.35}, "middle": {"radius_mm": 11.1125}}
CONTROL = ("T01", "T08", "T17", "T24")
OFF = -12.7
"""[mm] What the small SMR's centre is nearer to its seat."""


def scenario(**changes: Any) -> Scenario:
    """The paper's room with the small SMR in eight nests and the middle one at station 3."""
    small = {f"targets.T{i:02d}.reflector": "small" for i in range(9, 17)}
    settings = {
        "reflectors": REFLECTORS,
        "reference_radius_mm": 19.05,
        "smr.reflector": "large",
        "smr.incidence_error": False,
        "instrument.errors": {},
        "stations.S3.reflector": "middle",
    }
    keys = {key.replace("__", "."): value for key, value in changes.items()}
    return change_scenario(load_scenario("paper-workshop"), settings | small | keys, HERE)


def controlled(recording: Recording, truth: Truth, names: tuple[str, ...] = CONTROL) -> Recording:
    """The recording with some targets known as they are."""
    targets = dict(recording.setup.targets)
    for name in names:
        place = tuple((1e3 * truth.target_points[truth.target_names.index(name)]).tolist())
        targets[name] = targets[name].model_copy(update={"known_mm": place, "known_sigma_mm": 0.002})
    return with_setup(recording, targets=targets)


def with_setup(recording: Recording, **changes: Any) -> Recording:
    return recording.replace(setup=recording.setup.model_copy(update=changes))


def misses(recording: Recording, truth: Truth) -> tuple[Floats, Floats]:
    """Adjusted less true coordinates (T, 3) [m], and the covariances."""
    adjustment = adjust(recording)
    return adjustment.state.target_points - truth.target_points, adjustment.target_covariances


def test_targets_are_the_centres_of_the_reference_ball() -> None:
    recording, truth = lt.simulate(scenario(), seed=3)
    assert set(recording.labels["reflector"]) == set(REFLECTORS)
    miss, covariance = misses(controlled(recording, truth), truth)
    normalised = np.einsum("ti,tij,tj->t", miss, np.linalg.inv(covariance), miss)
    assert 0.4 < normalised.mean() / 3 < 2.0
    assert normalised.max() < 20.0
    assert np.abs(miss).max() < 50e-6


def test_without_the_column_they_are_off_by_the_difference_of_the_radii() -> None:
    recording, truth = lt.simulate(scenario(stations__S3__reflector="none"), seed=3)
    plain = with_setup(controlled(recording, truth).replace(labels={}), reflectors={})
    miss, _ = misses(plain, truth)
    for i, name in enumerate(recording.targets):
        normal = np.array(recording.target_setup(name).nest_normal)
        expected = OFF if name in {f"T{k:02d}" for k in range(9, 17)} else 0.0
        np.testing.assert_allclose(1e3 * miss[i], expected * normal, atol=0.06)


@pytest.mark.parametrize("names", [(), CONTROL[:1], CONTROL[:2]])
def test_a_network_that_nothing_holds_in_the_frame_of_the_normals_is_refused(names: tuple[str, ...]) -> None:
    recording, truth = lt.simulate(scenario(), seed=3)
    with pytest.raises(NetworkError, match=r"directions of these normals are unknown.* three known points"):
        adjust(controlled(recording, truth, names))


def test_levels_hold_it_where_the_normals_are_vertical() -> None:
    up = {f"targets__T{i:02d}__nest_normal": [0, 0, 1] for i in range(1, 25)}
    levels = {f"stations__S{i}__levelled": True for i in range(1, 6)}
    upright = scenario(**up, **levels, smr__nest_orientation="re-aimed", gauge__nest_normal=[0, 0, 1])
    recording, truth = lt.simulate(upright, seed=3)
    adjustment = adjust(recording)
    assert 0.8 < adjustment.sigma0 < 1.2 and not adjustment.is_gross_pointing.any()
    distances, true = (
        np.linalg.norm(p[:, None] - p[None], axis=2) for p in (adjustment.state.target_points, truth.target_points)
    )
    assert np.abs(distances - true).max() < 80e-6


@pytest.mark.parametrize("construction", [ideal_construction(), misalignment_construction()])
def test_first_order_and_exact_model_have_the_same_arm(construction: Any) -> None:
    recording, truth = lt.simulate(scenario(), seed=3)
    model = MeasurementModel(recording, construction)
    draw = random_stream(1, "reflectors")
    state = NetworkState(
        truth.station_positions, truth.station_rotations, truth.target_points, np.zeros((1, construction.n_parameters))
    )
    pose, points = (1e-6 * draw.standard_normal(size) for size in ((len(truth.stations), 6), truth.target_points.shape))
    there = model.linearise(state)
    first = np.einsum("nij,nj->ni", there.pose_derivatives, pose[recording.station])
    first += np.einsum("nij,nj->ni", there.target_derivatives, points[recording.target])
    zero = np.zeros_like(state.instrument_parameters), np.zeros(0)
    exact = model.predict(state.with_increments(pose, points, *zero)) - model.predict(
        state.with_increments(-pose, -points, *zero)
    )
    exact[:, 1] = wrap_angle(exact[:, 1])
    np.testing.assert_allclose(exact / 2, first, atol=1e-12)
    np.testing.assert_allclose(there.readings, model.predict(state), atol=1e-13)


def test_calibration_and_its_criteria_know_the_balls() -> None:
    recording, truth = lt.simulate(scenario(), seed=3)
    single_ball = lt.simulate(scenario(reflectors="none", stations__S3__reflector="none"), seed=3)[0]
    calibration, alone = lt.calibrate(controlled(recording, truth)), lt.calibrate(controlled(single_ball, truth))
    assert calibration.fit.sigma0 == pytest.approx(alone.fit.sigma0, abs=0.01)
    assert calibration.criteria is not None and alone.criteria is not None
    mine, plain = calibration.criteria.distance.before, alone.criteria.distance.before
    assert (mine.mean_um, mine.max_um) == pytest.approx((plain.mean_um, plain.max_um), abs=3)
    for method in (lambda: lt.calibrate(recording, method="distance"), lambda: lt.evaluate(recording)):
        with pytest.raises(NetworkError, match="SMRs of different radii have different centres"):
            method()


def test_a_radius_that_errs_is_an_error_of_all_its_pointings() -> None:
    errs = {"reflectors__small": {"radius_mm": 6.35, "sigma_radius_mm": 0.1}}
    (exact, _), (other, _) = lt.simulate(scenario(), seed=3), lt.simulate(scenario(**errs), seed=3)
    changed_rows = np.any(exact.readings != other.readings, axis=1)
    small = np.array(exact.labels["reflector"]) == "small"
    assert not changed_rows[~small].any() and changed_rows[small].all()


def test_a_recording_is_written_and_read_again_with_its_balls(tmp_path: Path) -> None:
    recording, _ = lt.simulate(scenario(), seed=3)
    write_recording(recording, tmp_path / "rec")
    again = read_recording(tmp_path / "rec")
    assert again.setup == recording.setup and again.labels == recording.labels
    text = scenario_to_toml(scenario())
    assert validate_scenario(tomllib.loads(text), HERE) == scenario()


def without_normal(recording: Recording) -> Recording:
    return with_setup(recording, targets=recording.setup.targets | {"T10": Target(reflector="small")})


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (without_normal, r"setup.toml: targets.T10.nest_normal is missing: its SMR small has a radius of 6.35 mm"),
        (
            lambda r: with_setup(r, reference_radius_mm=None),
            r"different radii \(small of 6.35 and middle of 11.1125 and large of 19.05 mm\); set reference_radius_mm",
        ),
        (
            lambda r: with_setup(r, reflectors={k: v for k, v in r.setup.reflectors.items() if k != "small"}),
            r"there is no table \[reflectors.small\]; reflectors: large, middle",
        ),
        (
            lambda r: with_setup(r.replace(labels={}), targets={}),
            r"observations.csv, row 1, column reflector: neither this cell nor targets.T\d+.reflector",
        ),
    ],
)
def test_a_missing_value_is_reported_in_a_sentence(spoil: Any, sentence: str, tmp_path: Path) -> None:
    recording, _ = lt.simulate(scenario(), seed=3)
    with pytest.raises(RecordError, match=sentence):
        write_recording(spoil(recording), tmp_path / "rec")
    assert not (tmp_path / "rec").exists()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"reference_radius_mm": "none"}, "set reference_radius_mm"),
        ({"smr__reflector": "huge"}, r"there is no table \[reflectors.huge\]"),
        ({"smr__reflector": "none"}, r"targets.T\d+.reflector is missing"),
        ({"smr__nest_orientation": "re-aimed"}, r"targets.T\d+.nest_normal is missing"),
    ],
)
def test_a_scenario_says_what_its_balls_lack(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        lt.simulate(scenario(**changes), seed=3)


def test_equal_radii_change_nothing() -> None:
    recording, _ = lt.simulate(scenario(), seed=3)
    same = {
        name: reflector.model_copy(update={"radius_mm": 5.0}) for name, reflector in recording.setup.reflectors.items()
    }
    assert excess_radii(with_setup(recording, reflectors=same, reference_radius_mm=None, targets={})) is None
    assert excess_radii(with_setup(recording, reflectors={})) is None


def test_trials_in_batch_refuse_balls_of_several_radii() -> None:
    with pytest.raises(InputError, match="a campaign uses one SMR radius"):
        make_true_network(scenario(), 1)


def test_the_radius_of_a_ball_is_a_source_of_the_budget() -> None:
    errs = scenario(reflectors__small__sigma_radius_mm=0.01, stations__S3__reflector="none")
    recording, truth = lt.simulate(errs, seed=3)
    point = {"name": "p", "kind": "point", "targets": ["T12"]}
    tasks = {"format": "ltsim-tasks/1", "source": "rec", "calibrate": False, "task": [point]}
    inputs = TaskInputs.from_recording(controlled(recording, truth), validate_tasks(tasks, "tasks.toml"))
    source = next(s for s in inputs.sources if s.name == "radius of small")
    normal = np.array(recording.target_setup("T12").nest_normal)
    assert source.evaluation_type == "B" and len([s for s in inputs.sources if s.name.startswith("radius")]) == 1
    np.testing.assert_allclose(1e3 * source.displacements_per_sigma[:, 0], 0.01 * normal, atol=1e-3)


def test_a_pointing_in_gon_to_a_small_ball_is_corrected() -> None:
    recording, truth = lt.simulate(scenario(), seed=3)
    row = recording.labels["reflector"].index("small")
    readings = recording.readings.copy()
    readings[[row]] = next(slip for slip in UNIT_AND_CONVENTION_ERRORS if slip.name == "gon").with_error(
        readings[[row]]
    )
    selection = identify_causes(controlled(recording.with_readings(readings), truth))
    assert selection is not None
    (choice,) = selection.selected_hypotheses
    assert choice.hypothesis.kind == "unit" and choice.hypothesis.row_numbers == (row + 1,)
    np.testing.assert_allclose(selection.fit.recording.readings, recording.readings, rtol=0, atol=1e-12)


def test_a_format_that_knows_no_normals_refuses_them(tmp_path: Path) -> None:
    recording, _ = lt.simulate(scenario(), seed=3)
    with pytest.raises(RecordError, match="gama-local does not support; write the recording in the native format"):
        write(recording, tmp_path / "out.gkf", "gama-local")
    assert not any(tmp_path.iterdir())


def test_a_reference_without_radii_is_reported_to_change_nothing(tmp_path: Path) -> None:
    recording, _ = lt.simulate(scenario(reflectors="none", stations__S3__reflector="none"), seed=3)
    write_recording(recording, tmp_path / "rec")
    (note,) = read_recording(tmp_path / "rec").notes
    assert note.startswith("reference_radius_mm has no effect")
