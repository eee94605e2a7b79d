"""Least-squares fits of displacements of points between two epochs, and the search for the points that moved.

All quantities are whitened: with the differences d of N points in `a` axes, the covariance C of d and a root R of the
inverse of C (R C R^T = 1), the model is R d = R (F m + E s) + noise, where F m are free motions of all points and E s
the displacements of the moved points. A point is added to the model by its residual design: its columns of R without
their part in the space of the columns that the model already has. The cost of one addition is that of one product of R
with a block of `a` columns, so that the cost of the search for any number of moved points is that of a decomposition of
R.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE, SQRT_MACHINE_EPSILON

MIN_EIGENVALUE = float(np.square(NORMAL_EQUATIONS_TOLERANCE))
"""Limit of an eigenvalue of the scaled normal equations of a point. Above it, the displacement of the point is
determined in the direction of the eigenvector. The normal equations are scaled by the norms of the point's columns
before the elimination of other unknowns; the limit is the square of the smallest fraction of a column that must remain.
"""


@dataclass(frozen=True)
class WhitenedDifferences:
    """Coordinate differences of N points in `n_axes` axes, whitened by the root of their inverse covariance."""

    whitening_root: Floats
    """Root R of the inverse covariance, shape (m, N axes); m is the rank of the covariance."""
    differences: Floats
    """Coordinate differences, second minus first epoch, point by point, shape (N axes,) [m]."""
    free_motions: Floats
    """Displacements of the points by a unit of each free motion (rigid motion of all points that an epoch does not
    determine), shape (N axes, free motions)."""
    n_axes: int
    """Number of compared axes."""

    @cached_property
    def observations(self) -> Floats:
        """Whitened coordinate differences R d, shape (m,); m is the rank of their covariance."""
        return self.whitening_root @ self.differences

    @cached_property
    def motion_design(self) -> Floats:
        """Whitened derivatives (m, motions) of the differences by the free motions (rigid motions of all points)."""
        return self.whitening_root @ self.free_motions

    def point_coordinate_indices(self, points: Sequence[int]) -> Ints:
        """Indices, in the vector of all coordinates, of the coordinates of the points with the indices `points`."""
        return coordinate_indices(points, self.n_axes)

    def blocks_by_point(self, columns: Floats) -> Floats:
        """Columns (m, N axes) of a design matrix, rearranged as one block for each of N points, shape (N, axes, m)."""
        return columns.T.reshape(-1, self.n_axes, len(columns))

    def fit(self, moved: Sequence[int]) -> "DisplacementFit":
        """Least-squares fit of free rigid motions of all points, and of displacements of `moved` (point indices)."""
        return DisplacementFit(self, tuple(moved))

    def find_moved_points(self, tested: Sequence[int], limit: float, max_moved: int) -> list[int]:
        """Indices of the points with a displacement, among at most `max_moved` of the `tested` ones.

        The point whose displacement reduces the sum of squared residuals most is added, as long as the reduction is at
        least `limit`. Afterwards each added point is tested again, with the displacements of the other added points in
        the model.
        """
        start = self.fit(())
        tests, basis, moved = start.point_tests, start.basis, list[int]()
        is_open = np.isin(np.arange(len(tests.right_sides)), tested)
        while len(moved) < min(len(tested), max_moved):
            drops = np.where(is_open, tests.chi2_drops, -np.inf)
            best = int(np.argmax(drops))
            if drops[best] < limit:
                break
            moved.append(best)
            is_open[best] = False
            added = self._residual_basis(basis, best, tests.column_norms[best])
            basis = np.hstack([basis, added])
            change = (added.T @ self.whitening_root).reshape(added.shape[1], -1, self.n_axes)
            tests = PointTests(
                tests.normal_equations - np.einsum("bna,bnc->nac", change, change),
                tests.right_sides - np.einsum("bna,b->na", change, added.T @ self.observations),
                tests.column_norms,
            )
        return self._without_insignificant_displacements(moved, limit)

    def _residual_basis(self, basis: Floats, point: int, column_norms: Floats) -> Floats:
        """Orthonormal basis (m, k) of the k columns of a point without their part in the space of `basis` (m, q)."""
        columns = self.whitening_root[:, self.point_coordinate_indices([point])] / np.where(
            column_norms > 0, column_norms, np.inf
        )
        for _ in range(2):  # a second time for rounding errors of the first
            columns = columns - basis @ (basis.T @ columns)
        vectors, sizes, _ = np.linalg.svd(columns, full_matrices=False)
        return np.asarray(vectors[:, sizes > NORMAL_EQUATIONS_TOLERANCE])

    def _without_insignificant_displacements(self, moved: list[int], limit: float) -> list[int]:
        """Points of `moved` whose displacement reduces the sum of squared residuals by at least `limit`.

        The points are tested one by one, with the displacements of the others in the model; the least significant
        displacement is removed first.
        """
        values, covariance = self.fit(moved).displacements
        remaining_points = list(moved)
        for point in moved:
            point_rows = self.point_coordinate_indices([remaining_points.index(point)])
            others = np.setdiff1d(np.arange(len(values)), point_rows)
            weight = np.linalg.pinv(covariance[np.ix_(point_rows, point_rows)], hermitian=True)
            if values[point_rows] @ weight @ values[point_rows] < limit:
                gain = covariance[np.ix_(others, point_rows)] @ weight
                values = values[others] - gain @ values[point_rows]
                covariance = covariance[np.ix_(others, others)] - gain @ covariance[np.ix_(point_rows, others)]
                remaining_points.remove(point)
        return remaining_points


@dataclass(frozen=True)
class PointTests:
    """Test of each of N points: fit with a displacement of this point as further unknown, against a fit without."""

    normal_equations: Floats
    """Normal equations of the displacement of each point after elimination of the unknowns of the fit, shape (N, axes,
    axes)."""
    right_sides: Floats
    """Right sides of the normal equations of the points, shape (N, axes): products of the residuals of the fit with the
    design columns of each point, after projection of these columns onto the residuals."""
    column_norms: Floats
    """Norm of the design column of each coordinate after elimination of the free motions, shape (N, axes); 0 for an
    undetermined coordinate."""

    @cached_property
    def _eigensystem(self) -> tuple[Floats, Floats, Floats]:
        """Eigenvalues (N, axes), eigenvectors (N, axes, axes) and scales (N, axes) of the scaled normal equations."""
        scale = np.divide(1.0, self.column_norms, out=np.zeros_like(self.column_norms), where=self.column_norms > 0)
        return (*np.linalg.eigh(self.normal_equations * scale[:, :, None] * scale[:, None, :]), scale)

    @property
    def are_determined(self) -> Bools:
        """Mask (N,) of the points whose displacement is determined in all directions."""
        return np.asarray(self._eigensystem[0].min(axis=1) > MIN_EIGENVALUE)

    @cached_property
    def _covariance_root(self) -> Floats:
        """Matrices S with S S^T = covariance of the displacement, shape (N, axes, axes)."""
        values, vectors, scale = self._eigensystem
        root = np.where(values > MIN_EIGENVALUE, 1.0 / np.sqrt(np.maximum(values, MIN_EIGENVALUE)), 0.0)
        return np.asarray(scale[:, :, None] * vectors * root[:, None, :])

    @cached_property
    def chi2_drops(self) -> Floats:
        """Reductions of the sum of squared residuals by an additional displacement of each point, shape (N,)."""
        return np.square(np.einsum("nab,na->nb", self._covariance_root, self.right_sides)).sum(axis=1)

    @cached_property
    def covariances(self) -> Floats:
        """Covariance of the displacement of each point, shape (N, axes, axes); 0 along undetermined directions."""
        return self._covariance_root @ self._covariance_root.transpose(0, 2, 1)

    @cached_property
    def displacements(self) -> Floats:
        """Estimated displacement [m] of each point, shape (N, axes)."""
        return np.einsum("nab,nb->na", self.covariances, self.right_sides)


@dataclass(frozen=True)
class DisplacementFit:
    """Least-squares fit of free rigid motions of all points, and of the displacements of the points `moved`."""

    data: WhitenedDifferences
    moved: tuple[int, ...]

    @cached_property
    def _scaled_design(self) -> tuple[Floats, Floats]:
        """Whitened design, free motions first, with columns of norm 1, (m, q), and the norms of its columns, (q,)."""
        moved_columns = self.data.whitening_root[:, self.data.point_coordinate_indices(self.moved)]
        design = np.hstack([self.data.motion_design, moved_columns])
        norms = np.linalg.norm(design, axis=0)
        return design / norms, norms

    @cached_property
    def _qr_factors(self) -> tuple[Floats, Floats] | None:
        """Orthonormal and triangular factor of the scaled design; None if it has not full rank."""
        design, _ = self._scaled_design
        if design.shape[1] > len(design):
            return None
        basis, triangle = np.linalg.qr(design)
        return (basis, triangle) if (np.abs(np.diag(triangle)) > SQRT_MACHINE_EPSILON).all() else None

    @cached_property
    def basis(self) -> Floats:
        """Orthonormal basis of the column space of the whitened design, shape (m, rank)."""
        if self._qr_factors is not None:
            return self._qr_factors[0]
        return np.asarray(scipy.linalg.orth(self._scaled_design[0]))

    @property
    def sum_of_squares(self) -> float:
        """Weighted sum of the squared residuals."""
        observed = self.data.observations
        return float(observed @ observed - np.sum((self.basis.T @ observed) ** 2))

    @cached_property
    def estimate(self) -> tuple[Floats, Floats]:
        """Estimates (q,) of the free motions and then of the displacements, and their covariance (q, q)."""
        design, norms = self._scaled_design
        if self._qr_factors is None:
            values, covariance = _shortest_estimate(design, self.data.observations)
            return values / norms, covariance / np.outer(norms, norms)
        basis, triangle = self._qr_factors
        root = scipy.linalg.solve_triangular(triangle, np.eye(len(triangle))) / norms[:, None]
        return root @ (basis.T @ self.data.observations), root @ root.T

    @property
    def displacements(self) -> tuple[Floats, Floats]:
        """Estimates (k axes,) of the displacements of the k moved points, and their covariance."""
        n_motions = self.data.free_motions.shape[1]
        values, covariance = self.estimate
        return values[n_motions:], covariance[n_motions:, n_motions:]

    @cached_property
    def point_tests(self) -> PointTests:
        """Tests of a displacement of each point in addition to the fit; undefined for the points `moved`."""
        root, axes = self.data.whitening_root, self.data.n_axes
        residual_design = root - self.basis @ (self.basis.T @ root)
        blocks = self.data.blocks_by_point(residual_design)
        residuals = self.data.observations - self.basis @ (self.basis.T @ self.data.observations)
        norms = np.linalg.norm(residual_design, axis=0)
        norms[norms < NORMAL_EQUATIONS_TOLERANCE * np.linalg.norm(root, axis=0)] = 0.0
        return PointTests(blocks @ blocks.transpose(0, 2, 1), blocks @ residuals, norms.reshape(-1, axes))

    def displacement(self, point: int) -> tuple[Floats, Floats, float]:
        """Displacement (axes,) [m] of a point, its covariance, and the reduction of the sum of squared residuals by it.

        A point that is not in the fit is added to it. If a direction is undetermined, the estimates of all
        points and motions together are those of smallest norm, in units of their standard deviations.
        """
        if point not in self.moved:
            tests = self.point_tests
            drop = float(tests.chi2_drops[point])
            if not tests.are_determined[point]:
                return (*self.data.fit([*self.moved, point]).displacement(point)[:2], drop)
            return tests.displacements[point], tests.covariances[point], drop
        values, covariance = self.displacements
        point_rows = self.data.point_coordinate_indices([self.moved.index(point)])
        block = covariance[np.ix_(point_rows, point_rows)]
        return (
            values[point_rows],
            block,
            float(values[point_rows] @ np.linalg.pinv(block, hermitian=True) @ values[point_rows]),
        )


def _shortest_estimate(design: Floats, observations: Floats) -> tuple[Floats, Floats]:
    """Least-squares estimate (q,) of smallest norm for a design (m, q) without full rank, and its covariance (q, q)."""
    basis, triangle, order = scipy.linalg.qr(design, mode="economic", pivoting=True)
    rank = int((np.abs(np.diag(triangle)) > SQRT_MACHINE_EPSILON).sum())
    root = scipy.linalg.solve_triangular(triangle[:rank, :rank], np.eye(rank))
    undetermined = np.zeros((design.shape[1], design.shape[1] - rank))
    undetermined[order[:rank]] = -root @ triangle[:rank, rank:]
    undetermined[order[rank:]] = np.eye(design.shape[1] - rank)
    free = np.linalg.qr(undetermined)[0]
    inverse = np.zeros((design.shape[1], rank))
    inverse[order[:rank]] = root
    inverse -= free @ (free.T @ inverse)
    return inverse @ (basis[:, :rank].T @ observations), inverse @ inverse.T


def coordinate_indices(points: Sequence[int] | Ints, n_axes: int) -> Ints:
    """Indices of the coordinates of `points` (point indices) in a vector that lists the coordinates point by point.

    `n_axes` is the number of coordinates per point.
    """
    return (n_axes * np.asarray(points, dtype=np.int64)[:, None] + np.arange(n_axes)).ravel()
