"""Information of a layout: against dense algebra, against a solved recording, and the batch against the slow twin."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.remedies.detectability import detectability_of_variants
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.errors import InputError, NetworkError
from ltsim.core.randomness import random_stream
from ltsim.geometry.rigid import matrix_from_rotation_vector
from ltsim.physics.effects.index_drift import IndexDrift
from ltsim.physics.effects.range_offset import RangeOffset
from ltsim.physics.effects.station_weather import StationWeather
from ltsim.physics.model.construction import ideal_construction, misalignment_construction
from ltsim.planning.expected_precision import DisagreementPredictor, ExpectedPrecision
from ltsim.planning.layout_scorer import LayoutScorer
from ltsim.planning.normal_blocks import NormalBlocks
from ltsim.planning.objective import mean_detectable_size
from ltsim.planning.search_inputs import planned_survey
from ltsim.recordings.setup import Station
from ltsim.simulation.scenario import load_scenario
from tests.planning.fixtures import POSITION, YAW, survey


def scattered(layouts: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return POSITION + rng.normal(0, 0.25, (layouts, 5, 3)), rng.uniform(0, 6, (layouts, 5))


def test_information_is_that_of_the_solved_recording() -> None:
    """Noise moves the state by micrometres: the covariance at the optimum is the one predicted before."""
    made = survey()
    information = ExpectedPrecision.from_survey(made)
    recording = made.noise_free_recording(misalignment_construction())
    noise = random_stream(1, "noise").normal(size=recording.readings.shape) * recording.reading_sigmas()
    solved = adjust(recording.with_readings(recording.readings + noise), misalignment_construction())
    sigma = np.sqrt(np.diag(solved.first_instrument_covariance))
    assert information.instrument_sigmas == pytest.approx(sigma, rel=1e-3)
    trace = np.einsum("tii->t", solved.with_inner_datum().target_covariances)
    assert information.target_point_errors == pytest.approx(np.sqrt(trace), rel=1e-3)


def test_undetermined_combinations_have_the_gain_they_state() -> None:
    information = ExpectedPrecision.from_survey(survey((1,)))
    assert information.undetermined_combinations, "one face leaves the vertical group undetermined"
    for direction in information.undetermined_combinations:
        variance = direction.coefficient_vector @ information.covariance_in_prior_sigmas @ direction.coefficient_vector
        assert 1.0 - variance == pytest.approx(direction.gain, abs=1e-12)
        assert direction.gain < 0.5
    first = information.undetermined_combinations[0].coefficients(information.construction.parameter_names)
    assert {"vertical-index", "elevation-eccentricity-cos"} <= set(first)
    assert "both faces" in information.measurements_for_undetermined()[0].sentence


def test_pose_covariance_does_not_depend_on_the_frame() -> None:
    """The same layout with its stations in another order: another datum inside, the same poses outside."""
    order = np.array([3, 1, 4, 0, 2])
    made = survey()
    turned = made.replace(
        station_positions=made.station_positions[order],
        station_yaws=made.station_yaws[order],
        station_names=tuple(f"P{i}" for i in order),
    )
    first, second = ExpectedPrecision.from_survey(made), ExpectedPrecision.from_survey(turned)
    a, b = first.pose_covariance[order], second.pose_covariance
    scale = np.sqrt(np.einsum("sii->si", a))
    assert np.abs((a - b) / (scale[:, :, None] * scale[:, None, :])).max() < 1e-7
    assert first.target_point_errors == pytest.approx(second.target_point_errors, rel=1e-9)


@pytest.mark.parametrize("faces", [(1,), (1, 2)])
def test_batch_agrees_with_the_slow_twin(faces: tuple[int, ...]) -> None:
    made = survey(faces, repeats=2, target_weights={"T03": 25.0, "T07": 0.0, "T26": 4.0})
    reducer = LayoutScorer(made)
    position, yaw = scattered(6, 2)
    visible = np.random.default_rng(5).uniform(size=(6, 5, 28)) < 0.8
    blocks = reducer.normal_blocks(position.reshape(-1, 3), yaw.ravel(), is_visible=visible.reshape(-1, 28))
    out = reducer.evaluate_layouts(blocks, np.arange(30).reshape(6, 5), with_target_errors=True)
    for i in range(6):
        slow = ExpectedPrecision.from_survey(
            made.replace(station_positions=position[i], station_yaws=yaw[i], is_visible=visible[i])
        )
        fast = np.linalg.inv(out.information_matrices[i])
        assert np.sqrt(np.diag(fast)) == pytest.approx(np.sqrt(np.diag(slow.covariance_in_prior_sigmas)), rel=1e-9)
        scale = np.sqrt(np.diag(fast))
        assert np.abs((fast - slow.covariance_in_prior_sigmas) / np.outer(scale, scale)).max() < 1e-9
        assert out.weighted_target_rms[i] == pytest.approx(slow.weighted_target_rms, rel=1e-9)


def test_batch_agrees_with_the_slow_twin_with_levels_and_without_parameters() -> None:
    made = survey()
    stations = {name: Station(levelled=True, levelling_sigma_arcsec=1.0) for name in made.station_names[:3]}
    made = made.replace(setup=made.setup.model_copy(update={"stations": stations}))
    reducer = LayoutScorer(made, ideal_construction())
    out = reducer.evaluate_layouts(
        reducer.normal_blocks(made.station_positions, made.station_yaws), np.arange(5)[None], with_target_errors=True
    )
    assert out.weighted_target_rms[0] == pytest.approx(
        ExpectedPrecision.from_survey(made, ideal_construction()).target_rms, rel=1e-9
    )


def test_batch_agrees_with_the_slow_twin_for_ranges_alone() -> None:
    made = survey((1,), observables=("distance",))
    reducer = LayoutScorer(made)
    position, yaw = scattered(4, 2)
    out = reducer.evaluate_layouts(
        reducer.normal_blocks(position.reshape(-1, 3), yaw.ravel()),
        np.arange(20).reshape(4, 5)[:, :5],
        with_target_errors=True,
    )
    for i in range(4):
        slow = ExpectedPrecision.from_survey(made.replace(station_positions=position[i], station_yaws=yaw[i]))
        fast = np.linalg.inv(out.information_matrices[i])
        assert np.abs(fast - slow.covariance_in_prior_sigmas).max() < 1e-7
        assert out.weighted_target_rms[i] == pytest.approx(slow.target_rms, rel=1e-7)


def test_ranges_from_a_single_plane_determine_nothing() -> None:
    """Stations in a plane may be sheared against their targets without any range changing: only the gauge resists."""
    made = survey((1,), observables=("distance",))
    made = made.replace(setup=made.setup.model_copy(update={"gauge": None}))
    flat = made.station_positions * [1.0, 1.0, 0.0] + [0.0, 0.0, 2.0]
    reducer = LayoutScorer(made)
    both = np.concatenate([made.station_positions, flat])
    out = reducer.evaluate_layouts(
        reducer.normal_blocks(both, np.tile(YAW, 2)), np.arange(10).reshape(2, 5), with_target_errors=True
    )
    assert np.isfinite(out.weighted_target_rms).tolist() == [True, False]
    with pytest.raises(NetworkError, match="not in one plane"):
        ExpectedPrecision.from_survey(made.replace(station_positions=flat))


def test_an_effect_in_the_batch_is_what_it_would_be_as_a_parameter() -> None:
    """A range offset taken as an effect beside the others has the information it has as a parameter without prior."""
    made = survey()
    from ltsim.physics.effects import ORDINARY_CALIBRATION_EFFECTS

    others = misalignment_construction(e for e in ORDINARY_CALIBRATION_EFFECTS if e.name != "range-offset")
    reducer = LayoutScorer(made, others, [RangeOffset()])
    out = reducer.evaluate_layouts(
        reducer.normal_blocks(made.station_positions, made.station_yaws, np.arange(5)), np.arange(5)[None]
    )
    variance = np.linalg.inv(out.information_matrices[0])[-1, -1] * RangeOffset.parameters[0].prior_sigma ** 2
    whole = ExpectedPrecision.from_survey(made)
    at = whole.construction.parameter_index("range-offset")
    without_prior = 1 / whole.instrument_covariance[at, at] - 1 / whole.prior_sigma[at] ** 2
    assert variance == pytest.approx(1 / without_prior, rel=1e-8)


def masks() -> dict[str, np.ndarray]:
    """What each station sees where S3's pose is lost to counting, to a line, to a cut through the network."""
    few, line, disconnected, two = (np.ones((5, 28), dtype=bool) for _ in range(4))
    few[2, 2:] = False
    line[2] = False
    line[2, [0, 2, 4, 6]] = True
    disconnected[:3, 14:], disconnected[3:, :14] = False, False
    two[:3, 14:], two[3:, 2:14] = False, False
    return {"two targets": few, "one line": line, "two networks": disconnected, "two networks and a line": two}


@pytest.mark.parametrize("case", masks())
def test_a_layout_that_determines_no_pose_has_no_information(case: str) -> None:
    made, visible = survey(), masks()[case]
    with pytest.raises(
        NetworkError, match="S3 measures fewer than three" if visible[2].sum() < 5 else "do not determine all poses"
    ):
        ExpectedPrecision.from_survey(made.replace(is_visible=visible))
    reducer = LayoutScorer(made)
    out = reducer.evaluate_layouts(
        reducer.normal_blocks(made.station_positions, made.station_yaws, is_visible=visible),
        np.arange(5)[None],
        with_target_errors=True,
    )
    assert not np.isfinite(out.information_matrices).any()
    assert not np.isfinite(out.weighted_target_rms).any()


def test_a_lost_layout_does_not_spoil_its_neighbours_in_the_batch() -> None:
    made, whole = survey(), np.ones((5, 28), dtype=bool)
    lost = list(masks().values())
    reducer = LayoutScorer(made)
    visible = np.concatenate([whole, *lost, whole])
    places = (np.tile(a, (len(lost) + 2, *[1] * (a.ndim - 1))) for a in (made.station_positions, made.station_yaws))
    out = reducer.evaluate_layouts(
        reducer.normal_blocks(*places, is_visible=visible), np.arange(5 * (len(lost) + 2)).reshape(-1, 5)
    )
    alone = reducer.evaluate_layouts(
        reducer.normal_blocks(made.station_positions, made.station_yaws), np.arange(5)[None]
    )
    for i in (0, -1):
        assert out.information_matrices[i] == pytest.approx(alone.information_matrices[0], rel=1e-12, abs=1e-9)
    assert not np.isfinite(out.information_matrices[1:-1]).any()


def test_rotation_of_a_survey_is_about_the_vertical() -> None:
    made = survey()
    assert made.station_rotations == pytest.approx(matrix_from_rotation_vector(np.outer(YAW, [0, 0, 1])), abs=1e-15)
    with pytest.raises(InputError, match="faces are"):
        survey((1, 3))


@pytest.mark.parametrize("face_by_face", [True, False])
def test_an_effect_that_knows_the_clock_is_the_same_in_the_batch(face_by_face: bool) -> None:
    """Stations of a batch know when in the work they stand, also when only one of them is in it."""
    rank = np.array([np.random.default_rng(s).permutation(28) for s in range(5)])
    made = survey(target_ranks=rank, measures_face_by_face=face_by_face)
    effects = [IndexDrift(law="linear"), IndexDrift(law="visit"), StationWeather(stations=("S4",))]
    reducer = LayoutScorer(made, effects=effects)
    whole = reducer.normal_blocks(made.station_positions, made.station_yaws, np.arange(5))
    alone = NormalBlocks.concatenate(
        [
            reducer.normal_blocks(made.station_positions[s : s + 1], made.station_yaws[s : s + 1], np.array([s]))
            for s in range(5)
        ]
    )
    space = ResidualSpace.from_adjustment(ExpectedPrecision.from_survey(made).adjustment)
    for blocks in (whole, alone):
        information = reducer.evaluate_layouts(blocks, np.arange(5)[None]).information_matrices
        for k, effect in enumerate(effects):
            visible = detectability_of_variants(space, [effect])
            assert visible is not None
            only = np.delete(
                np.delete(information, [16 + j for j in range(3) if j != k], 1), [16 + j for j in range(3) if j != k], 2
            )
            size = mean_detectable_size(only, 16, [effect])[0] * effect.parameters[0].prior_sigma
            assert size == pytest.approx(visible.minimal_detectable_sizes[0][0], rel=1e-6)


def test_fixed_nests_have_the_reflectors_error_in_both() -> None:
    """It is a nuisance that costs information, the same in the batch and in its twin, and a group of the criteria."""
    made = planned_survey(load_scenario("paper-workshop"))
    reducer, slow = LayoutScorer(made), ExpectedPrecision.from_survey(made)
    out = reducer.evaluate_layouts(
        reducer.normal_blocks(made.station_positions, made.station_yaws, np.arange(5)),
        np.arange(5)[None],
        with_target_errors=True,
    )
    assert np.abs(np.linalg.inv(out.information_matrices[0]) - slow.covariance_in_prior_sigmas).max() < 1e-9
    assert out.weighted_target_rms[0] == pytest.approx(slow.target_rms, rel=1e-9)
    targets = {name: target.model_copy(update={"reaimed": True}) for name, target in made.setup.targets.items()}
    aimed = ExpectedPrecision.from_survey(made.replace(setup=made.setup.model_copy(update={"targets": targets})))
    ratio = slow.instrument_sigmas / aimed.instrument_sigmas
    assert ratio.min() > 1.0 - 1e-9 and ratio.max() > 1.2
    with_error, without = (
        DisagreementPredictor.from_expected_precision(slow).expected_disagreement({"reflectors": size})
        for size in (1.0, 0.0)
    )
    assert with_error.distance_disagreement_before[0] > without.distance_disagreement_before[0]
    assert with_error.distance_disagreement_after[0] > without.distance_disagreement_after[0]
