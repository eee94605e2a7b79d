"""States that pointings add to, forget and release; latches; switches; lever-weighted paths through regions."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.physics.laws.accumulations import (
    ACCUMULATED_COVARIATES,
    FIXED_COUNT_RESET_FUNCTION,
    POINTING_DECAY_FUNCTION,
    TIME_DECAY_FUNCTION,
    accumulation_column,
    candidate_accumulation_keys,
    candidate_latch_keys,
)
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.regressor_library import (
    candidate_regressors,
    contains_several_targets,
    temporary_region_regressors,
)
from ltsim.physics.laws.regressors import latch_regressor, scalar_regressor, switch_regressor
from ltsim.physics.laws.responses import RESPONSE_AND_DESIGN_BY_NAME
from ltsim.scene.regions import (
    REGION_SHAPES,
    HallRegion,
    lever_weighted_path_lengths_in_regions,
    path_lengths_in_regions,
)
from ltsim.scene.sightings import Sightings
from tests.networks import network

QUADRATURE = 4001


@pytest.fixture(scope="module")
def sightings() -> Sightings:
    return adjust(network(faces=2, seed=1)[0]).sightings


def by_hand(s: Sightings, name: str, how: str, constant: float) -> np.ndarray:
    """A state pointing by pointing, as it is defined."""
    x, values = s.covariate_values[name], np.zeros(len(s))
    for station in range(len(s.station_names)):
        rows = [row for row in s.measurement_order if s.station[row] == station]
        now = 0.0
        for number, (before, row) in enumerate(pairwise(rows), start=1):
            gap = s.time[row] - s.time[before]
            released = {
                "after face": s.face[row] != s.face[before],
                "after seating": s.target[row] != s.target[before],
                "after azimuth": s.approach_signs[row, 0] != s.approach_signs[before, 0],
                "after pause": gap > constant,
                "after tip": abs(s.covariate_values["move-elevation"][row]) > constant,
                FIXED_COUNT_RESET_FUNCTION: number % constant == 0,
            }.get(how, False)
            decay = {
                TIME_DECAY_FUNCTION: np.exp(-gap / constant),
                POINTING_DECAY_FUNCTION: np.exp(-1.0 / constant),
            }.get(how, 1.0)
            now = 0.0 if released else decay * (now + x[row] - x[before])
            values[row] = now
    return values - values.mean()


@pytest.mark.parametrize("name", ["station-time", "count", "work-elevation", "wound-azimuth"])
@pytest.mark.parametrize(
    ("how", "constant"),
    [
        (TIME_DECAY_FUNCTION, 120.0),
        (POINTING_DECAY_FUNCTION, 3.0),
        (FIXED_COUNT_RESET_FUNCTION, 7.0),
        ("after face", 1.0),
        ("after seating", 1.0),
        ("after azimuth", 1.0),
        ("after pause", 25.0),
        ("after tip", 0.2),
    ],
)
def test_a_state_is_what_its_definition_gives(sightings: Sightings, name: str, how: str, constant: float) -> None:
    np.testing.assert_allclose(
        accumulation_column(sightings, name, how, constant), by_hand(sightings, name, how, constant), atol=1e-9
    )


def test_candidate_states_differ_and_are_cached(sightings: Sightings) -> None:
    tried = candidate_accumulation_keys(sightings, ACCUMULATED_COVARIATES)
    assert len(set(tried)) == len(tried) > 100
    columns = np.stack([sightings.derived_cache[key] for key in tried], axis=1)
    assert np.isfinite(columns).all() and (columns.std(axis=0) > 0.0).all()
    again = np.stack(
        [
            by_hand(sightings, *key)
            for key in tried[::40]
            if key[1] in (TIME_DECAY_FUNCTION, POINTING_DECAY_FUNCTION, FIXED_COUNT_RESET_FUNCTION)
        ],
        axis=1,
    )
    states = np.stack(
        [
            sightings.derived_cache[key]
            for key in tried[::40]
            if key[1] in (TIME_DECAY_FUNCTION, POINTING_DECAY_FUNCTION, FIXED_COUNT_RESET_FUNCTION)
        ],
        axis=1,
    )
    np.testing.assert_allclose(again, states, atol=1e-9)


def test_a_latch_holds_between_its_thresholds(sightings: Sightings) -> None:
    for name, above, below in candidate_latch_keys(sightings, ("distance", "elevation")):
        x = sightings.covariate_values[name]
        on = latch_regressor(name, above, below).columns(sightings)[:, 0] > 0.0
        assert on[x > above].all() and not on[x < below].any()
        between = (x <= above) & (x >= below) & (sightings.previous_pointing_indices >= 0)
        np.testing.assert_array_equal(on[between], on[sightings.previous_pointing_indices[between]])


def test_a_switch_is_on_between_two_edges(sightings: Sightings) -> None:
    start, end, again = np.quantile(sightings.time, (0.2, 0.5, 0.8))
    column = switch_regressor([scalar_regressor("time", "step", edge) for edge in (start, end, again)]).columns(
        sightings
    )[:, 0]
    on = ((sightings.time > start) & (sightings.time <= end)) | (sightings.time > again)
    np.testing.assert_array_equal(column > 0.0, on)
    assert np.sqrt(np.mean(column**2)) == pytest.approx(1.0)


def test_what_stands_in_the_hall_temporary_regions_acts_on_the_lines_that_pass_it_then(sightings: Sightings) -> None:
    drivers = list(temporary_region_regressors(sightings))
    assert drivers
    for driver in drivers[::5]:
        region, gate = driver.factors
        column = driver.columns(sightings)[:, 0]
        on = gate.columns(sightings)[:, 0] > 0.0
        np.testing.assert_array_equal(column[~on], 0.0)
        path = region.columns(sightings)[:, 0][on]
        np.testing.assert_allclose(
            column[on] * np.linalg.norm(path), path * np.linalg.norm(column), rtol=1e-9, atol=1e-300
        )
        assert np.sqrt(np.mean(column**2)) == pytest.approx(1.0)
        law = EmpiricalLaw(response=RESPONSE_AND_DESIGN_BY_NAME["distance"][0], regressor=driver)
        assert law.without_time_limit().regressor == region
        assert all(other.regressor.factors[1] == gate for other in law.neighbours(sightings))


def test_edges_of_a_switch_move_separately(sightings: Sightings) -> None:
    times = np.quantile(sightings.time, (0.2, 0.5))
    law = EmpiricalLaw(
        response=RESPONSE_AND_DESIGN_BY_NAME["distance"][0],
        regressor=switch_regressor([scalar_regressor("time", "step", float(t)) for t in times]),
    )
    finer = law.neighbours(sightings)
    moved = [[f.constant for f in other.regressor.factors] for other in finer]
    assert len(finer) > 4 and all(sum(a != b for a, b in zip(edges, times, strict=True)) <= 1 for edges in moved)
    assert {other.regressor.kind for other in finer} == {"switch"}


@pytest.mark.parametrize("axes", REGION_SHAPES)
def test_the_lever_of_a_region_is_its_integral(sightings: Sightings, axes: str) -> None:
    """Integral of w (d - s) / d along each line of sight by the trapezoidal rule."""
    middle = sightings.target_points.mean(axis=0)
    at = ["xyz".index(axis) for axis in axes]
    region = HallRegion(axes, tuple((middle[at] + 0.3).tolist()), 0.6)
    length = sightings.range_
    s = np.linspace(0.0, 1.0, QUADRATURE)[None] * length[:, None]
    beam = sightings.beam_vectors[0]
    places = sightings.station_positions[sightings.station][:, None] + s[:, :, None] * beam[:, None]
    gap = places[:, :, at] - np.array(region.centre)
    w = np.exp(-0.5 * np.sum(gap**2, axis=2) / region.width**2)
    expected = np.trapezoid(w * (1.0 - s / length[:, None]), s, axis=1)
    np.testing.assert_allclose(region.lever_weighted_path_lengths(sightings), expected, rtol=1e-5, atol=1e-6)
    path = path_lengths_in_regions(sightings, axes, np.array([region.centre]), region.width)
    np.testing.assert_allclose(
        lever_weighted_path_lengths_in_regions(sightings, axes, np.array([region.centre]), region.width, path)[0],
        expected,
        rtol=1e-5,
        atol=1e-6,
    )


def test_nearness_falls_with_the_distance_of_the_target(sightings: Sightings) -> None:
    region = HallRegion("xy", (1.0, 2.0), 0.5)
    gap = np.hypot(*(sightings.target_points[sightings.target][:, :2] - (1.0, 2.0)).T)
    np.testing.assert_allclose(region.target_weights(sightings), np.exp(-2.0 * gap**2), atol=1e-12)


def test_a_place_has_several_targets_near_it_wherever_it_is_moved(sightings: Sightings) -> None:
    """A region at one target alone would be an error of that target in other words."""
    tried = candidate_regressors(sightings)["near"]
    assert tried and all(contains_several_targets(driver.region, sightings) for driver in tried)
    law = EmpiricalLaw(
        response=RESPONSE_AND_DESIGN_BY_NAME["distance"][0],
        regressor=min(tried, key=lambda d: d.region.n_effective_targets(sightings)),
    )
    assert all(contains_several_targets(other.regressor.region, sightings) for other in law.neighbours(sightings))
    alone = HallRegion("xyz", tuple(sightings.target_points[0].tolist()), 0.02)
    assert alone.n_effective_targets(sightings) == pytest.approx(1.0, abs=1e-6)
    assert not contains_several_targets(alone, sightings)
