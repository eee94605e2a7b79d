"""Eq. 9 solved as printed: its own gradient vanishes at the answer, in both norms, and nothing lies below."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

import ltsim as lt
from ltsim.adjustment.prior import prior_sigmas
from ltsim.calibration.distance_solver import (
    mean_deviation_comparisons,
    pair_difference_comparisons,
    solve_all_combinations,
    solve_determined_combinations,
)
from ltsim.calibration.objective import DistanceProblem
from ltsim.physics.model.construction import misalignment_construction
from tests.families import family
from tests.networks import drawn, network

BUILT = misalignment_construction()


def problem_of(seed: int, faces: int = 1) -> DistanceProblem:
    recording = network(seed=seed, faces=faces, values=drawn(BUILT, seed))[0]
    return DistanceProblem(recording, BUILT, prior_sigmas(recording, BUILT))


def slope(problem: DistanceProblem, unknowns: np.ndarray) -> np.ndarray:
    """Gradient of eq. 9's sum of squares, over its usual size by chance at each unknown."""
    rows = mean_deviation_comparisons(problem, problem.distances_at(unknowns))
    gradient = rows.derivatives_by_unknowns.T @ rows.residuals
    return gradient / (np.linalg.norm(rows.derivatives_by_unknowns, axis=0) * np.linalg.norm(rows.residuals))


@pytest.mark.parametrize("seed", family(range(100), 10))
def test_the_gradient_of_the_squares_vanishes(seed: int) -> None:
    problem = problem_of(seed)
    combinations = solve_all_combinations(problem, "squares")
    assert combinations.has_converged
    assert np.max(np.abs(slope(problem, combinations.unknowns))) < 1e-7
    assert combinations.objective_value < solve_determined_combinations(problem, "squares").objective_value


def least_subgradient(problem: DistanceProblem, unknowns: np.ndarray) -> float:
    """Largest component of the smallest subgradient of the absolute values: rows that are met pull as they like."""
    rows = pair_difference_comparisons(problem, problem.distances_at(unknowns))
    scaled = rows.derivatives_by_unknowns / np.abs(rows.derivatives_by_unknowns).sum(axis=0)
    met = np.argsort(np.abs(rows.residuals))[: 2 * len(unknowns)]
    rest = np.setdiff1d(np.arange(len(rows.residuals)), met)
    pull, free = np.sign(rows.residuals[rest]) @ scaled[rest], scaled[met].T
    size = len(unknowns)
    matrix = np.block([[free, -np.ones((size, 1))], [-free, -np.ones((size, 1))]])
    cost = np.concatenate([np.zeros(len(met)), [1.0]])
    bounds = [*[(-1.0, 1.0)] * len(met), (0.0, None)]
    return float(linprog(cost, A_ub=matrix, b_ub=np.concatenate([-pull, pull]), bounds=bounds).fun)


def check_absolute(seed: int) -> None:
    problem = problem_of(seed)
    combinations = solve_all_combinations(problem, "absolute")
    truncated = solve_determined_combinations(problem, "absolute")
    assert combinations.has_converged
    assert least_subgradient(problem, combinations.unknowns) < 1e-6
    assert least_subgradient(problem, truncated.unknowns) > 1e-4
    assert combinations.objective_value < truncated.objective_value


@pytest.mark.parametrize("seed", range(10))
def test_zero_is_a_subgradient_of_the_absolute_values(seed: int) -> None:
    check_absolute(seed)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(10, 100))
def test_zero_is_a_subgradient_of_the_absolute_values_for_many_seeds(seed: int) -> None:
    check_absolute(seed)


@pytest.mark.parametrize("norm", family(["squares", "absolute"]))
def test_in_a_box_no_unknown_leaves_it_and_nothing_in_it_lies_below(norm: str) -> None:
    problem, box = problem_of(3), 0.8
    combinations = solve_all_combinations(problem, norm, bound_in_prior_sigmas=box)
    assert np.max(np.abs(combinations.unknowns)) <= box + 1e-9
    assert np.any(np.abs(combinations.unknowns) > box - 1e-6)
    assert combinations.objective_value >= solve_all_combinations(problem, norm).objective_value
    rng = np.random.default_rng(1)
    rows = mean_deviation_comparisons if norm == "squares" else pair_difference_comparisons
    for _ in range(20):
        near = np.clip(combinations.unknowns + 1e-3 * rng.standard_normal(16), -box, box)
        residuals = rows(problem, problem.distances_at(near)).residuals
        assert (
            residuals @ residuals if norm == "squares" else np.abs(residuals).sum()
        ) >= combinations.objective_value * (1 - 1e-9)


def test_both_are_reported() -> None:
    recording = network(seed=3, values=drawn(BUILT, 3))[0]
    truncated = lt.calibrate(recording, method="distance")
    assert any("(Sensors 2021, 21, 7479, eq. 9)" in note and "Its minimum is" in note for note in truncated.notes)
    whole = lt.calibrate(recording, method="equation-9", advise=False)
    assert whole.method == "equation-9"
    assert np.all(whole.sigma > 0)
    boxed = lt.calibrate(recording, method="equation-9", box=1.0, advise=False)
    assert np.all(np.abs(boxed.estimates) <= boxed.prior_sigma * (1 + 1e-9))
