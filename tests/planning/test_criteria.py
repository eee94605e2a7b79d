"""Each criterion against its definition, reached by another way."""

from __future__ import annotations

from importlib import import_module

import numpy as np
import pytest

from ltsim.planning.objective import a_criterion, d_criterion, e_criterion

g_criterion = import_module("experiments.10_layout_search.run").g_criterion
RNG = np.random.default_rng(3)
DESIGN = RNG.normal(size=(40, 5)) * [1.0, 3.0, 0.2, 1.0, 0.5]
COVARIANCE = np.linalg.inv(DESIGN.T @ DESIGN)


def quadratic(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Covariance of a quadratic regression with observations of some weights."""
    rows = np.stack([np.ones_like(points), points, points**2], axis=1)
    return np.linalg.inv((rows * weights[:, None]).T @ rows)


def test_d_is_the_volume_of_the_confidence_ellipsoid() -> None:
    """The image of the unit ball under the covariance's root has its volume times d^p: hits counted in a box."""
    draws = np.random.default_rng(8).uniform(-1, 1, size=(400_000, 5)) * np.sqrt(np.diag(COVARIANCE))
    inside = np.einsum("ni,ij,nj->n", draws, DESIGN.T @ DESIGN, draws) <= 1
    box = 2**5 * np.prod(np.sqrt(np.diag(COVARIANCE)))
    ball = np.pi**2.5 / 3.3233509704478426
    assert d_criterion(COVARIANCE) ** 5 == pytest.approx(inside.mean() * box / ball, rel=0.01)


def test_a_is_the_expected_size_of_the_error_and_not_the_trace_of_the_information() -> None:
    noise = np.random.default_rng(4).normal(size=(40, 100_000))
    errors = np.linalg.lstsq(DESIGN, noise, rcond=None)[0]
    assert a_criterion(COVARIANCE) == pytest.approx(np.sqrt(np.mean(errors**2)), rel=0.01)
    assert a_criterion(COVARIANCE) != pytest.approx(np.sqrt(5 / np.trace(DESIGN.T @ DESIGN)), rel=0.1)


def test_e_is_the_largest_deviation_over_all_unit_combinations() -> None:
    unit = np.random.default_rng(5).normal(size=(200_000, 5))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    largest = np.sqrt(np.einsum("ni,ij,nj->n", unit, COVARIANCE, unit).max())
    assert largest <= e_criterion(COVARIANCE) <= 1.01 * largest


def test_g_is_the_worst_prediction() -> None:
    wanted = RNG.normal(size=(17, 5))
    each = np.array([np.sqrt(row @ COVARIANCE @ row) for row in wanted])
    assert g_criterion(COVARIANCE, wanted) == pytest.approx(each.max(), rel=1e-12)


def test_equivalence_theorem_of_d_and_g() -> None:
    """Kiefer and Wolfowitz: for a quadratic on [-1, 1] the D-optimum is (-1, 0, 1), equal weights, with G = sqrt(3)."""
    grid = np.linspace(-1, 1, 21)
    optimal = quadratic(np.array([-1.0, 0.0, 1.0]), np.full(3, 1 / 3))
    rows = np.stack([np.ones(201), np.linspace(-1, 1, 201), np.linspace(-1, 1, 201) ** 2], axis=1)
    assert g_criterion(optimal, rows) == pytest.approx(np.sqrt(3), rel=1e-9)
    for seed in range(50):
        weights = np.random.default_rng(seed).dirichlet(np.ones(21))
        other = quadratic(grid, weights)
        assert d_criterion(other) > d_criterion(optimal)
        assert g_criterion(other, rows) > np.sqrt(3)


@pytest.mark.parametrize("criterion", [d_criterion, a_criterion, e_criterion])
def test_an_observation_more_never_hurts_and_batches_agree(criterion) -> None:  # type: ignore[no-untyped-def]
    row = np.array([[0.3, -1.0, 0.5, 2.0, 0.1]])
    more = np.linalg.inv(DESIGN.T @ DESIGN + row.T @ row)
    both = criterion(np.stack([COVARIANCE, more]))
    assert both[1] <= both[0]
    assert both == pytest.approx([criterion(COVARIANCE), criterion(more)], rel=1e-12)
