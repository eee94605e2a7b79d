"""Targets after a diagnosis: what an unknown law does to them is taken off as far as it is safe."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.averaging import (
    MAX_PROBABILITY_OF_LARGER_ERROR_INCREASE,
    MAX_RELATIVE_COORDINATE_ERROR_INCREASE,
    alternative_probabilities_and_reading_changes,
    average_over_explanations,
    expected_reading_change,
    first_order_reading_change,
    max_subtracted_shift_fraction,
    reading_change_by_combined_hypotheses,
)
from ltsim.diagnosis.hypotheses import Hypothesis, HypothesisRanking
from ltsim.diagnosis.selection_state import SelectionState
from ltsim.geometry.rigid import remove_rigid_motion
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.regressors import smooth_regressor
from ltsim.physics.laws.responses import RESPONSE_AND_DESIGN_BY_NAME
from ltsim.physics.laws.variance import VarianceFunction
from tests.networks import network


@pytest.mark.parametrize("size", [0.01, 0.1, 1.0, 10.0])
@pytest.mark.parametrize("along", [0.02, 0.3])
def test_coordinates_become_much_worse_as_rarely_as_reported(size, along):
    """The error is drawn of which nothing is known but its covariance; a share of it lies along the change."""
    count, spread = 60, size * along
    share = max_subtracted_shift_fraction(size, spread, 1.0)
    rng = random_stream(8, "safe")
    error = rng.standard_normal((20_000, count)) * np.sqrt([along, *np.full(count - 1, (1.0 - along) / (count - 1))])
    shift = np.zeros(count)
    shift[0] = np.sqrt(size)
    before, after = (np.sum((error + part * shift) ** 2, axis=1) for part in (1.0, 1.0 - share))
    harmed = float(np.mean(after > (1.0 + MAX_RELATIVE_COORDINATE_ERROR_INCREASE) ** 2 * before))
    assert harmed < 2.5 * MAX_PROBABILITY_OF_LARGER_ERROR_INCREASE  # e'e is taken to be its expectation
    if 0.05 < share < 1.0 and along < 0.1:
        assert harmed > 0.5 * MAX_PROBABILITY_OF_LARGER_ERROR_INCREASE


def test_a_law_that_does_much_is_taken_off_whole():
    assert max_subtracted_shift_fraction(100.0, 1.0, 1.0) == 1.0
    assert max_subtracted_shift_fraction(0.0, 0.0, 1.0) == 1.0
    assert max_subtracted_shift_fraction(1.0, 1.0, 1.0) < 0.5


def test_what_two_laws_that_share_much_do_to_the_targets_is_what_a_refit_with_both_does():
    baseline = adjust(network(faces=1, seed=3)[0])
    case = SelectionState.from_adjustment(baseline, baseline.problem.is_used_reading, 0)
    elevation = RESPONSE_AND_DESIGN_BY_NAME["elevation"][0]
    laws = [EmpiricalLaw((), (), elevation, smooth_regressor(name)) for name in ("time", "station-time")]
    fitted = case.refit(laws, case.reading_sigmas)
    model = case.searcher.model_with([Hypothesis(law, 0.0, 0.0, "unknown") for law in laws])
    points = baseline.state.target_points
    basis = points - points.mean(axis=0)
    linear = -case.searcher.residual_space.target_shifts(first_order_reading_change(case.searcher, model))
    expected, shift = (
        remove_rigid_motion(change.reshape(-1, 1), basis, baseline.problem.free_motions)
        for change in (fitted.adjustment.state.target_points - points, linear)
    )
    assert np.linalg.norm(expected) > 1e-5
    np.testing.assert_allclose(shift, expected, atol=0.01 * np.abs(expected).max())
    targets, change = average_over_explanations(
        case.searcher, model, [HypothesisRanking(model.hypotheses, 0.0)] * 2, fitted
    )
    refitted = np.zeros_like(change)
    refitted[case.is_used_reading] = (
        first_order_reading_change(case.searcher, model)[: int(case.is_used_reading.sum())]
        * case.reading_sigmas[case.is_used_reading]
    )
    assert np.linalg.norm((refitted + change) / case.reading_sigmas) < np.linalg.norm(refitted / case.reading_sigmas)
    assert np.linalg.norm(targets.points - points) < np.linalg.norm(expected)


def test_noise_moves_no_target() -> None:
    """The probability of a change of the noise is not that of a shift."""
    baseline = adjust(network(faces=1, seed=3)[0])
    case = SelectionState.from_adjustment(baseline, baseline.problem.is_used_reading, 0)
    law = Hypothesis(
        EmpiricalLaw((), (), RESPONSE_AND_DESIGN_BY_NAME["elevation"][0], smooth_regressor("time")), 0.0, 5.0, "unknown"
    )
    noise = Hypothesis(VarianceFunction(("distance",), covariates=("distance",)), 0.0, 5.0 + np.log(19.0), "unknown")
    ranking = HypothesisRanking((noise, law), 8.0)
    weights, changes = alternative_probabilities_and_reading_changes(
        case.searcher, case.searcher.empty_model, law, ranking, 1.0
    )
    assert weights.sum() == pytest.approx(1.0)
    moving = np.any(changes != 0.0, axis=1)
    assert weights[moving].sum() == pytest.approx(np.exp(5.0) / (1.0 + 20.0 * np.exp(5.0)), rel=1e-6)


def _elevation_law(covariate: str, log_evidence: float, observable: str = "elevation") -> Hypothesis:
    response = RESPONSE_AND_DESIGN_BY_NAME[observable][0]
    return Hypothesis(EmpiricalLaw((), (), response, smooth_regressor(covariate)), 0.0, log_evidence, "unknown")


def test_a_change_that_follows_two_hypotheses_is_predicted_by_both_together() -> None:
    """The average of two hypotheses, of which each explains half of the change, would predict half of it."""
    recording = network(faces=1, seed=3)[0]
    laws = [_elevation_law(name, 20.0) for name in ("time", "distance")]
    sightings = adjust(recording).sightings
    true_change = np.zeros(recording.readings.shape)
    true_change[:, 2] = sum(law.effect.columns(sightings)[:, 1] for law in laws) * 6.0
    true_change *= recording.reading_sigmas()
    baseline = adjust(recording.replace(readings=recording.readings + true_change))
    case = SelectionState.from_adjustment(baseline, baseline.problem.is_used_reading, 0)
    searcher, space, none = case.searcher, case.residual_space, case.searcher.empty_model
    other = _elevation_law("time", 60.0, "azimuth")
    ranking = HypothesisRanking((other, *laws), 60.0)
    combined = reading_change_by_combined_hypotheses(searcher, none, laws[0], ranking, 1.0)
    average = sum(0.5 * expected_reading_change(searcher, none, law) for law in laws)
    truth = space.whiten(true_change[:, :, None])[:, 0]
    unexplained = [np.linalg.norm(space.project(truth - change)) for change in (combined, average)]
    assert unexplained[0] < 0.6 * unexplained[1]
    alone = reading_change_by_combined_hypotheses(searcher, none, laws[0], HypothesisRanking((other,), 60.0), 1.0)
    np.testing.assert_allclose(alone, expected_reading_change(searcher, none, laws[0]), atol=0.05 * np.abs(alone).max())
