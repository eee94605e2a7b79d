"""The block solver against dense linear algebra."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from ltsim.core.randomness import random_stream
from ltsim.solve.elimination import BlockSystem, FactorisedNormals, SingularSystemError
from ltsim.solve.gauss_newton import TerminationStatus, solve


def random_system(seed: int, n_reduced: int = 7, blocks: int = 5) -> tuple[BlockSystem, np.ndarray]:
    """Rows that see all kept unknowns and one block each, columns of very different size."""
    rng = random_stream(seed, "system")
    rows = np.zeros((12 * blocks, n_reduced + 3 * blocks))
    for i in range(len(rows)):
        block = i % blocks
        rows[i, :n_reduced] = rng.standard_normal(n_reduced)
        rows[i, n_reduced + 3 * block : n_reduced + 3 * block + 3] = rng.standard_normal(3)
    rows *= 10.0 ** rng.uniform(-6, 6, rows.shape[1])
    return BlockSystem(rows, rng.standard_normal(len(rows)), n_reduced), rows


@pytest.mark.parametrize("kind", [np.array, sp.csr_array])
@pytest.mark.parametrize("seed", range(3))
def test_step_covariance_and_leverage_equal_dense_ones(seed, kind):
    system, dense = random_system(seed)
    factor = FactorisedNormals(replace(system, design=kind(dense)))
    scale = 1 / np.linalg.norm(dense, axis=0)
    inverse = np.linalg.inv((dense * scale).T @ (dense * scale)) * np.outer(scale, scale)
    np.testing.assert_allclose(factor.step(), inverse @ dense.T @ system.whitened_residuals, rtol=1e-8)
    np.testing.assert_allclose(factor.retained_covariance(), inverse[:7, :7], rtol=1e-8)
    for e, block in enumerate(factor.eliminated_covariances()):
        at = slice(7 + 3 * e, 10 + 3 * e)
        np.testing.assert_allclose(block, inverse[at, at], rtol=1e-8)
    hat = np.einsum("mi,ij,mj->m", dense, inverse, dense)
    np.testing.assert_allclose(factor.leverage(), hat, rtol=1e-8)
    directions = np.eye(len(inverse))[:, [0, 9]]
    np.testing.assert_allclose(factor.multiply_by_covariance(directions), inverse[:, [0, 9]], rtol=1e-8)
    assert factor.multiply_by_covariance(directions[:, :0]).shape == (len(directions), 0)


@pytest.mark.parametrize("kind", [np.array, sp.csr_array])
def test_undetermined_unknowns_are_refused_whatever_their_unit(kind):
    system, dense = random_system(1)
    for unit in (1e-9, 1.0, 1e9):
        dense[:, 0] = unit * dense[:, 1]
        with pytest.raises(SingularSystemError):
            FactorisedNormals(BlockSystem(kind(dense), system.whitened_residuals, 7))


class Valley:
    """Rosenbrock's valley as a least-squares problem without blocks."""

    def __init__(self, stiffness: float) -> None:
        self.stiffness = stiffness

    def residual(self, x):
        return np.array([1 - x[0], self.stiffness * (x[1] - x[0] ** 2)])

    def linearise(self, x):
        design = np.array([[1.0, 0.0], [2 * self.stiffness * x[0], -self.stiffness]])
        return BlockSystem(design, self.residual(x), 2)

    def retract(self, x, step):
        return x + step


def test_the_loop_finds_the_bottom_of_a_bent_valley():
    solution = solve(Valley(10.0), np.array([-1.2, 1.0]), max_iterations=200)
    assert solution.status is TerminationStatus.CONVERGED
    np.testing.assert_allclose(solution.x, [1.0, 1.0], atol=1e-6)


def test_the_cap_is_a_status_and_not_an_endless_loop():
    solution = solve(Valley(1e4), np.array([-1.2, 1.0]), max_iterations=2)
    assert solution.status is TerminationStatus.MAX_ITERATIONS_REACHED
    assert solution.n_iterations == 2


class Bent:
    """A slightly bent line that meets its observations but for noise."""

    def __init__(self) -> None:
        self.at, self.looks = np.linspace(-1, 1, 20), 0
        self.observed = self._predicted(np.array([40.0, 10.0])) + random_stream(0, "bent").standard_normal(20)

    def _predicted(self, x):
        return x[0] + x[1] * self.at + 1e-6 * x[1] ** 2

    def residual(self, x):
        self.looks += 1
        return self.observed - self._predicted(x)

    def linearise(self, x):
        design = np.stack([np.ones(20), self.at + 2e-6 * x[1]], axis=1)
        return BlockSystem(design, self.observed - self._predicted(x), 2)

    def retract(self, x, step):
        return x + step


def test_a_next_step_that_would_be_nothing_is_not_looked_at():
    problem = Bent()
    solution = solve(problem, np.zeros(2))
    assert (solution.status, solution.n_iterations, problem.looks) == (TerminationStatus.CONVERGED, 2, 0)
    there = problem.linearise(solution.x)
    assert np.linalg.norm(there.design @ FactorisedNormals(there).step()) < 1e-6
    np.testing.assert_allclose(solution.system.whitened_residuals, there.whitened_residuals, atol=1e-6)
    assert solution.sum_of_squares == pytest.approx(there.sum_of_squares, rel=1e-9)


class Coarse:
    """A line fitted to points whose predictions are rounded, as with coordinates of thousands of kilometres."""

    def __init__(self, grain: float) -> None:
        self.grain = grain
        self.at = np.linspace(-1, 1, 9)
        self.observed = 3.0 * self.at + 0.1 * random_stream(0, "line").standard_normal(9)

    def residual(self, x):
        predicted = np.round((x[0] + x[1] * self.at) / self.grain) * self.grain
        return self.observed - predicted

    def linearise(self, x):
        return BlockSystem(np.stack([np.ones(9), self.at], axis=1), self.residual(x), 2)

    def retract(self, x, step):
        return x + step


def test_steps_of_rounding_errors_end_the_loop():
    solution = solve(Coarse(2e-4), np.array([40.0, -10.0]))
    assert solution.status is TerminationStatus.CONVERGED
    assert solution.n_iterations < 8
    np.testing.assert_allclose(solution.x, [0, 3], atol=0.2)


def test_short_steps_under_heavy_damping_are_no_convergence():
    class Wall(Valley):
        """A valley whose derivative is wrong: no step of the design lowers the sum of squares."""

        def linearise(self, x):
            system = super().linearise(x)
            return BlockSystem(-1.0 * system.design, system.whitened_residuals, 2)

    assert solve(Wall(10.0), np.array([-1.2, 1.0]), max_iterations=60).status is not TerminationStatus.CONVERGED
