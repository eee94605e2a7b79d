"""The paper's objective: its matrix form against eq. 9 written out, its solvers, and its declared uncertainty."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.stats import kstest

from ltsim.adjustment.prior import prior_sigmas
from ltsim.calibration.distance import calibrate_distance
from ltsim.calibration.distance_solver import (
    mean_deviation_comparisons,
    pair_difference_comparisons,
    solve_determined_combinations,
)
from ltsim.calibration.network import calibrate_network
from ltsim.calibration.objective import DistanceProblem
from ltsim.core.errors import NetworkError
from ltsim.core.randomness import random_stream
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings.setup import Setup
from tests.families import family


def problem_of(recording) -> DistanceProblem:
    construction = misalignment_construction()
    return DistanceProblem(recording, construction, prior_sigmas(recording, construction))


def equation_9(recording, values: np.ndarray, power: int) -> float:
    """Eq. 9 as printed, in loops; gauge pairs only in its second term."""
    points = misalignment_construction().points_from_readings(recording.readings, values)
    total = 0.0
    place = {(s, t): i for i, (s, t) in enumerate(zip(recording.station, recording.target, strict=True))}

    def length(s: int, k: int, j: int) -> float:
        return float(np.linalg.norm(points[place[s, k]] - points[place[s, j]]))

    for k, j in combinations(range(len(recording.targets)), 2):
        for a, b in combinations(range(len(recording.stations)), 2):
            total += abs(length(a, k, j) - length(b, k, j)) ** power
    names = recording.targets
    for gauge_length in recording.gauge.distance:
        k, j = names.index(gauge_length.from_), names.index(gauge_length.to)
        for s in range(len(recording.stations)):
            total += abs(length(s, k, j) - 1e-3 * gauge_length.length_mm) ** power
    return total


def test_matrix_form_is_equation_9(make, drawn) -> None:
    recording = make(drawn(misalignment_construction(), 2, 0))
    problem = problem_of(recording)
    unknowns = 0.5 * random_stream(1, "x").standard_normal(16)
    values = unknowns * problem.prior_sigma[0]
    distances = problem.distances_at(unknowns)
    assert np.sum(mean_deviation_comparisons(problem, distances).residuals ** 2) == pytest.approx(
        equation_9(recording, values, 2), rel=1e-9
    )
    assert np.sum(np.abs(pair_difference_comparisons(problem, distances).residuals)) == pytest.approx(
        equation_9(recording, values, 1), rel=1e-9
    )


def test_derivatives_equal_differences(make, drawn) -> None:
    recording = make(drawn(misalignment_construction(), 2, 1))
    problem = problem_of(recording)
    at, step = np.full(16, 0.3), 1e-3
    rows = mean_deviation_comparisons(problem, problem.distances_at(at))
    for k in range(16):
        ahead = mean_deviation_comparisons(problem, problem.distances_at(at + step * np.eye(16)[k])).residuals
        back = mean_deviation_comparisons(problem, problem.distances_at(at - step * np.eye(16)[k])).residuals
        slope = (ahead - back) / (2 * step)
        assert np.allclose(rows.derivatives_by_unknowns[:, k], slope, atol=1e-4 * np.abs(slope).max())
    noise = 1e-2 * random_stream(1, "e").standard_normal((len(recording), 3))
    moved = problem_of(recording.with_readings(recording.readings + noise * recording.reading_sigmas()))
    change = mean_deviation_comparisons(moved, moved.distances_at(at)).residuals - rows.residuals
    linear = rows.derivatives_by_noise[:, : noise.size] @ noise.ravel()
    assert np.allclose(change, linear, atol=1e-3 * np.abs(linear).max())


@pytest.mark.parametrize("method", ["distance", "distance-l1"])
def test_solution_minimises_what_it_says(make, drawn, method: str) -> None:
    recording = make(drawn(misalignment_construction(), 2, 2))
    calibration = calibrate_distance(recording, method=method)
    power = 2 if method == "distance" else 1
    least = equation_9(recording, calibration.estimates[0], power)
    combinations = [
        np.array([c.combination.get(n, 0.0) for n in calibration.instrument_parameter_names])
        for c in calibration.undetermined
    ]
    assert combinations  # one face: some combinations are left alone
    rng = random_stream(3, "push")
    for _ in range(5):
        push = rng.standard_normal(16)
        for direction in combinations:
            unit = direction / np.linalg.norm(direction)
            push -= unit * (unit @ push)
        moved = calibration.estimates[0] + 0.05 * push * calibration.prior_sigma[0]
        assert equation_9(recording, moved, power) > least


def test_undetermined_combinations_stay_at_zero_with_their_prior(make) -> None:
    calibration = calibrate_distance(make(np.zeros(16)))
    assert calibration.undetermined[0].gain < 0.1
    direction = np.array(
        [calibration.undetermined[0].combination.get(n, 0.0) for n in calibration.instrument_parameter_names]
    )
    direction /= np.linalg.norm(direction)
    scaled = calibration.covariance / np.outer(calibration.prior_sigma, calibration.prior_sigma)
    assert direction @ scaled @ direction == pytest.approx(1.0, abs=0.05)
    assert abs(direction @ (calibration.estimates[0] / calibration.prior_sigma[0])) < 0.1


def test_two_faces_determine_what_flips(make, drawn) -> None:
    truth = drawn(misalignment_construction(), 2, 3, share=2.0)
    calibration = calibrate_distance(make(truth, faces=(1, 2)))
    index = calibration.instrument_parameter_names.index("vertical-index")
    assert calibration.sigma[0, index] < 0.2 * calibration.prior_sigma[0, index]
    assert abs(calibration.estimates[0, index] - truth[index]) < 4 * calibration.sigma[0, index]
    assert np.all(calibration.sigma > 0.99 * calibrate_network(make(truth, faces=(1, 2))).sigma)


@pytest.mark.parametrize("norm", family(["squares", "absolute"]))
def test_declared_uncertainty_is_the_spread(make, drawn, norm: str) -> None:
    """Errors of 60 calibrations, normalised by the stated covariance of each."""
    trials = 60
    score, total = [], []
    for trial in range(trials):
        truth = drawn(misalignment_construction(), 6, trial)
        problem = problem_of(make(truth, trial=trial))
        combinations = solve_determined_combinations(problem, norm)
        error = combinations.unknowns - truth / problem.prior_sigma[0]
        score.append(error / np.sqrt(np.diag(combinations.covariance)))
        total.append(error @ np.linalg.solve(combinations.covariance, error))
    spread = np.std(score, axis=0)
    # Standard error of a standard deviation: 1/sqrt(2 N) = 0.09; 16 parameters; 4 of them.
    assert np.all(np.abs(spread - 1) < 0.36), spread
    assert np.mean(total) == pytest.approx(16, abs=4 * np.sqrt(2 * 16 / trials) + (0.8 if norm == "absolute" else 0))


@pytest.mark.long
def test_targets_carry_the_uncertainty_of_the_parameters(make, drawn) -> None:
    """Errors of 40 adjusted clouds in the first station's frame, normalised by their stated covariance."""
    scores, wider, chances = [], [], []
    origin = make(np.zeros(16), noise=0.0)
    true = calibrate_network(origin, recommend_measurements=False).target_points
    for trial in range(40):
        recording = make(drawn(misalignment_construction(), 7, trial), trial=trial)
        calibration = calibrate_distance(recording, advise=False)
        sigma = np.sqrt(np.einsum("tii->ti", calibration.target_covariances))
        scores.append((calibration.target_points - true) / sigma)
        chances.append(calibration.fit.p_value)
        best = calibrate_network(recording, recommend_measurements=False, choose_correction=False).target_covariances
        wider.append(np.all(sigma**2 > 0.99 * np.einsum("tii->ti", best)))
    # Coordinates of one cloud err together: about 20 independent numbers a trial.
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1.0, abs=0.15)
    assert all(wider)
    # The parameters are not those of least chi-square, and the stated chance allows for it.
    assert kstest(chances, "uniform").pvalue > 1e-3


def test_missing_comparisons_are_reported(make) -> None:
    recording = make(np.zeros(16))
    alone = recording.select(recording.station == 0).replace(setup=Setup())
    with pytest.raises(NetworkError, match="no distance can be compared"):
        solve_determined_combinations(problem_of(alone), "squares")
