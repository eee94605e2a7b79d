"""Information of a layout: against dense algebra, against a solved recording, and the batch against the slow twin."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.remedies.detectability import detectability_at_places
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.errors import NetworkError, SetupError
from ltsim.core.randomness import stream
from ltsim.geometry.rotations import from_rotation_vector
from ltsim.physics.effects.index_drift import IndexDrift
from ltsim.physics.effects.range_offset import RangeOffset
from ltsim.physics.effects.station_weather import StationWeather
from ltsim.physics.model.construction import ideal_construction, misalignment_construction
from ltsim.planning.fast import LayoutScorer, NormalBlocks
from ltsim.planning.information import LayoutInformation, Predictor
from ltsim.planning.objective import smallest_sizes
from ltsim.planning.workshop import survey_of
from ltsim.recordings.setup import Station
from ltsim.simulation.scenario import load_scenario
from tests.planning.fixtures import POSITION, YAW, survey


def scattered(layouts: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return POSITION + rng.normal(0, 0.25, (layouts, 5, 3)), rng.uniform(0, 6, (layouts, 5))


def test_information_is_that_of_the_solved_recording() -> None:
    """Noise moves the state by micrometres: the covariance at the optimum is the one predicted before."""
    made = survey()
    information = LayoutInformation.of(made)
    recording = made.recording(misalignment_construction())
    noise = stream(1, "noise").normal(size=recording.readings.shape) * recording.sigma()
    solved = adjust(recording.with_readings(recording.readings + noise), misalignment_construction())
    sigma = np.sqrt(np.diag(solved.instrument_covariance))
    assert information.instrument_sigma == pytest.approx(sigma, rel=1e-3)
    trace = np.einsum("tii->t", solved.in_inner_datum().target_covariance)
    assert information.target_sigma == pytest.approx(np.sqrt(trace), rel=1e-3)


def test_undetermined_combinations_have_the_gain_they_state() -> None:
    information = LayoutInformation.of(survey((1,)))
    assert information.undetermined, "one face leaves the vertical group undetermined"
    for direction in information.undetermined:
        left = direction.vector @ information.scaled_covariance @ direction.vector
        assert 1.0 - left == pytest.approx(direction.gain, abs=1e-12)
        assert direction.gain < 0.5
    first = information.undetermined[0].coefficients(information.construction.parameter_names)
    assert {"vertical-index", "elevation-eccentricity-cos"} <= set(first)
    assert "both faces" in information.cures()[0]


def test_pose_covariance_does_not_depend_on_the_frame() -> None:
    """The same layout with its stations in another order: another datum inside, the same poses outside."""
    order = np.array([3, 1, 4, 0, 2])
    made = survey()
    turned = made.replace(
        position=made.position[order], yaw=made.yaw[order], station_names=tuple(f"P{i}" for i in order)
    )
    first, second = LayoutInformation.of(made), LayoutInformation.of(turned)
    a, b = first.pose_covariance[order], second.pose_covariance
    scale = np.sqrt(np.einsum("sii->si", a))
    assert np.abs((a - b) / (scale[:, :, None] * scale[:, None, :])).max() < 1e-7
    assert first.target_sigma == pytest.approx(second.target_sigma, rel=1e-9)


@pytest.mark.parametrize("faces", [(1,), (1, 2)])
def test_batch_agrees_with_the_slow_twin(faces: tuple[int, ...]) -> None:
    made = survey(faces, repeats=2, importance={"T03": 25.0, "T07": 0.0, "T26": 4.0})
    reducer = LayoutScorer(made)
    position, yaw = scattered(6, 2)
    visible = np.random.default_rng(5).uniform(size=(6, 5, 28)) < 0.8
    blocks = reducer.blocks(position.reshape(-1, 3), yaw.ravel(), visible=visible.reshape(-1, 28))
    out = reducer.reduce(blocks, np.arange(30).reshape(6, 5), targets=True)
    for i in range(6):
        slow = LayoutInformation.of(made.replace(position=position[i], yaw=yaw[i], visible=visible[i]))
        fast = np.linalg.inv(out.information[i])
        assert np.sqrt(np.diag(fast)) == pytest.approx(np.sqrt(np.diag(slow.scaled_covariance)), rel=1e-9)
        scale = np.sqrt(np.diag(fast))
        assert np.abs((fast - slow.scaled_covariance) / np.outer(scale, scale)).max() < 1e-9
        assert out.target_rms[i] == pytest.approx(slow.target_rms, rel=1e-9)


def test_batch_agrees_with_the_slow_twin_with_levels_and_without_parameters() -> None:
    made = survey()
    stations = {name: Station(levelled=True, levelling_sigma_arcsec=1.0) for name in made.station_names[:3]}
    made = made.replace(setup=made.setup.model_copy(update={"stations": stations}))
    reducer = LayoutScorer(made, ideal_construction())
    out = reducer.reduce(reducer.blocks(made.position, made.yaw), np.arange(5)[None], targets=True)
    assert out.target_rms[0] == pytest.approx(LayoutInformation.of(made, ideal_construction()).target_rms, rel=1e-9)


def test_batch_agrees_with_the_slow_twin_for_ranges_alone() -> None:
    made = survey((1,), observables=("distance",))
    reducer = LayoutScorer(made)
    position, yaw = scattered(4, 2)
    out = reducer.reduce(
        reducer.blocks(position.reshape(-1, 3), yaw.ravel()), np.arange(20).reshape(4, 5)[:, :5], targets=True
    )
    for i in range(4):
        slow = LayoutInformation.of(made.replace(position=position[i], yaw=yaw[i]))
        fast = np.linalg.inv(out.information[i])
        assert np.abs(fast - slow.scaled_covariance).max() < 1e-7
        assert out.target_rms[i] == pytest.approx(slow.target_rms, rel=1e-7)


def test_ranges_from_one_plane_determine_nothing() -> None:
    """Stations in a plane may be sheared against their targets without any range changing: only the gauge resists."""
    made = survey((1,), observables=("distance",))
    made = made.replace(setup=made.setup.model_copy(update={"gauge": None}))
    flat = made.position * [1.0, 1.0, 0.0] + [0.0, 0.0, 2.0]
    reducer = LayoutScorer(made)
    both = np.concatenate([made.position, flat])
    out = reducer.reduce(reducer.blocks(both, np.tile(YAW, 2)), np.arange(10).reshape(2, 5), targets=True)
    assert np.isfinite(out.target_rms).tolist() == [True, False]
    with pytest.raises(NetworkError, match="not in one plane"):
        LayoutInformation.of(made.replace(position=flat))


def test_an_effect_in_the_batch_is_what_it_would_be_as_a_parameter() -> None:
    """A range offset taken as an effect beside the others has the information it has as a parameter without prior."""
    made = survey()
    from ltsim.physics.effects import BASELINE

    others = misalignment_construction(e for e in BASELINE if e.name != "range-offset")
    reducer = LayoutScorer(made, others, [RangeOffset()])
    out = reducer.reduce(reducer.blocks(made.position, made.yaw, np.arange(5)), np.arange(5)[None])
    own = np.linalg.inv(out.information[0])[-1, -1] * RangeOffset.parameters[0].prior_sigma ** 2
    whole = LayoutInformation.of(made)
    at = whole.construction.index("range-offset")
    without_prior = 1 / whole.instrument_covariance[at, at] - 1 / whole.prior_sigma[at] ** 2
    assert own == pytest.approx(1 / without_prior, rel=1e-8)


def masks() -> dict[str, np.ndarray]:
    """What each station sees where S3's pose is lost to counting, to a line, to a cut through the network."""
    few, line, apart, two = (np.ones((5, 28), dtype=bool) for _ in range(4))
    few[2, 2:] = False
    line[2] = False
    line[2, [0, 2, 4, 6]] = True
    apart[:3, 14:], apart[3:, :14] = False, False
    two[:3, 14:], two[3:, 2:14] = False, False
    return {"two targets": few, "one line": line, "two networks": apart, "two networks and a line": two}


@pytest.mark.parametrize("case", masks())
def test_a_layout_that_determines_no_pose_has_no_information(case: str) -> None:
    made, visible = survey(), masks()[case]
    with pytest.raises(NetworkError, match="S3 sees fewer than three" if visible[2].sum() < 5 else "share more"):
        LayoutInformation.of(made.replace(visible=visible))
    reducer = LayoutScorer(made)
    out = reducer.reduce(reducer.blocks(made.position, made.yaw, visible=visible), np.arange(5)[None], targets=True)
    assert not np.isfinite(out.information).any()
    assert not np.isfinite(out.target_rms).any()


def test_a_lost_layout_does_not_spoil_its_neighbours_in_the_batch() -> None:
    made, whole = survey(), np.ones((5, 28), dtype=bool)
    lost = list(masks().values())
    reducer = LayoutScorer(made)
    visible = np.concatenate([whole, *lost, whole])
    places = (np.tile(a, (len(lost) + 2, *[1] * (a.ndim - 1))) for a in (made.position, made.yaw))
    out = reducer.reduce(reducer.blocks(*places, visible=visible), np.arange(5 * (len(lost) + 2)).reshape(-1, 5))
    alone = reducer.reduce(reducer.blocks(made.position, made.yaw), np.arange(5)[None])
    for i in (0, -1):
        assert out.information[i] == pytest.approx(alone.information[0], rel=1e-12, abs=1e-9)
    assert not np.isfinite(out.information[1:-1]).any()


def test_rotation_of_a_survey_is_about_the_vertical() -> None:
    made = survey()
    assert made.rotation == pytest.approx(from_rotation_vector(np.outer(YAW, [0, 0, 1])), abs=1e-15)
    with pytest.raises(SetupError, match="faces are"):
        survey((1, 3))


@pytest.mark.parametrize("face_by_face", [True, False])
def test_an_effect_that_knows_the_clock_is_the_same_in_the_batch(face_by_face: bool) -> None:
    """Stations of a batch know when in the work they stand, also when only one of them is in it."""
    rank = np.array([np.random.default_rng(s).permutation(28) for s in range(5)])
    made = survey(rank=rank, face_by_face=face_by_face)
    effects = [IndexDrift(law="linear"), IndexDrift(law="visit"), StationWeather(stations=("S4",))]
    reducer = LayoutScorer(made, effects=effects)
    whole = reducer.blocks(made.position, made.yaw, np.arange(5))
    alone = NormalBlocks.concatenated(
        [reducer.blocks(made.position[s : s + 1], made.yaw[s : s + 1], np.array([s])) for s in range(5)]
    )
    space = ResidualSpace.from_adjustment(LayoutInformation.of(made).adjustment)
    for blocks in (whole, alone):
        information = reducer.reduce(blocks, np.arange(5)[None]).information
        for k, effect in enumerate(effects):
            visible = detectability_at_places(space, [effect])
            assert visible is not None
            only = np.delete(
                np.delete(information, [16 + j for j in range(3) if j != k], 1), [16 + j for j in range(3) if j != k], 2
            )
            size = smallest_sizes(only, 16, [effect])[0] * effect.parameters[0].prior_sigma
            assert size == pytest.approx(visible.minimal_sizes[0][0], rel=1e-6)


def test_fixed_nests_have_the_reflectors_error_in_both() -> None:
    """It is a nuisance that costs information, the same in the batch and in its twin, and a group of the criteria."""
    made = survey_of(load_scenario("paper-workshop"))
    reducer, slow = LayoutScorer(made), LayoutInformation.of(made)
    out = reducer.reduce(reducer.blocks(made.position, made.yaw, np.arange(5)), np.arange(5)[None], targets=True)
    assert np.abs(np.linalg.inv(out.information[0]) - slow.scaled_covariance).max() < 1e-9
    assert out.target_rms[0] == pytest.approx(slow.target_rms, rel=1e-9)
    targets = {name: target.model_copy(update={"reaimed": True}) for name, target in made.setup.targets.items()}
    aimed = LayoutInformation.of(made.replace(setup=made.setup.model_copy(update={"targets": targets})))
    ratio = slow.instrument_sigma / aimed.instrument_sigma
    assert ratio.min() > 1.0 - 1e-9 and ratio.max() > 1.2
    with_error, without = (Predictor.of(slow).expected({"reflectors": size}) for size in (1.0, 0.0))
    assert with_error.distance_before[0] > without.distance_before[0]
    assert with_error.distance_after[0] > without.distance_after[0]
