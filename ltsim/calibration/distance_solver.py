"""The paper's calibrator: parameters that make distances agree between stations and with the gauge.

Least squares and least absolute deviations, both by Gauss-Newton from zero; a step of the latter is a linear program's
solution. The objective as printed estimates up to 78 parameters without asking whether the data hold them; here the
unknowns are scaled by their priors, the objective's normal matrix is decomposed, and only combinations whose estimate
is more certain than the prior (gain above one half) are estimated. The others stay at zero and keep their prior
uncertainty: nothing is estimated blindly. So this is eq. 9 over part of its unknowns; `equation_9` finds its minimum.

The objective ignores that distances share points, so its own covariance would be too small. The covariance given
here propagates the stated noise of every reading (and of the gauge) through the estimator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.sparse as sp

from ltsim.arrays import Bools, Floats
from ltsim.calibration.objective import DistanceProblem, Distances, centring, set_pairs
from ltsim.errors import NetworkError
from ltsim.remedies.undetermined import DETERMINED, Direction
from ltsim.solve.absolute import least_absolute

CAP = 30
CLOSED = 1e-7
"""Converged when no unknown moves by more than this share of its prior sigma."""


@dataclass(frozen=True)
class Rows:
    """Compared distances: what compares them (R, D), residuals (R,), derivatives (R, q) and noise (R, 3 n + g)."""

    compare: sp.csr_array
    residual: Floats
    by_unknown: Floats
    by_noise: sp.csr_array


@dataclass(frozen=True)
class Estimate:
    """Unknowns in units of their prior sigmas, and how they depend on the noise."""

    unknowns: Floats
    """(q,)."""
    covariance: Floats
    """(q, q): of the error, that of the combinations left at zero included."""
    noise: Floats
    """(q, 3 n + g): covariance of the error with the whitened readings and gauge lengths."""
    left_out: tuple[Direction, ...]
    objective: float
    """[m^2] for least squares, [m] for absolute deviations."""
    iterations: int
    converged: bool


def mean_rows(problem: DistanceProblem, distances: Distances) -> Rows:
    """Rows whose sum of squares is eq. 9 squared: deviations from the mean over sets times the root of their number."""
    centre, count = centring(distances)
    scaled = sp.diags_array(np.sqrt(count)) @ centre
    return _with_gauge(problem, distances, sp.csr_array(scaled))


def pair_rows(problem: DistanceProblem, distances: Distances) -> Rows:
    """The terms of eq. 9 one by one: differences between pairs of sets, then gauge terms."""
    first, second = set_pairs(distances)
    problem._check_size(len(first))
    rows = np.arange(len(first))
    shape = (len(first), len(distances.length))
    plus = sp.coo_array((np.ones(len(rows)), (rows, first)), shape=shape)
    minus = sp.coo_array((np.ones(len(rows)), (rows, second)), shape=shape)
    return _with_gauge(problem, distances, sp.csr_array(plus - minus))


def _with_gauge(problem: DistanceProblem, distances: Distances, compare: sp.csr_array) -> Rows:
    at, which = problem.gauge_matches(distances)
    known = len(problem.gauge)
    pick = sp.csr_array(
        sp.coo_array((np.ones(len(at)), (np.arange(len(at)), at)), shape=(len(at), len(distances.length)))
    )
    # The error of a gauge length shifts all rows that compare with it.
    spread = sp.csr_array(-problem.gauge.spread[which])
    matrix = sp.vstack([compare, pick], format="csr")
    residual = matrix @ distances.length
    residual[compare.shape[0] :] -= problem.gauge.length[which]
    own = sp.vstack([sp.csr_array((compare.shape[0], known)), spread], format="csr")
    noise = sp.hstack([matrix @ distances.by_reading, own], format="csr")
    return Rows(sp.csr_array(matrix), residual, matrix @ distances.by_parameter, sp.csr_array(noise))


def solve_distances(
    problem: DistanceProblem,
    norm: Literal["squares", "absolute"],
    *,
    start: Floats | None = None,
    held: Bools | None = None,
) -> Estimate:
    """Minimise eq. 9 over the combinations that the readings determine: not its own minimum (`equation_9`).

    From zero, or from `start` (q,), where unknowns that are `held` (q,) stay.

    Raises
    ------
    NetworkError
        When no pair of targets was seen from two stations (or faces), and no gauge.
    """
    size = problem.prior_sigma.size
    unknowns: Floats = np.zeros(size) if start is None else start
    rows = mean_rows(problem, problem.at(unknowns))
    if not np.any(rows.by_unknown):
        raise NetworkError("no distance can be compared: stations share no pair of targets, and there is no gauge")
    kept, left_out = determined(rows, None if held is None else ~held)
    moved, iterations = np.inf, 0
    while iterations < CAP and not moved < CLOSED:
        iterations += 1
        rows = compared_rows(problem, unknowns, norm)
        step = kept @ _step(rows.by_unknown @ kept, rows.residual, norm)
        unknowns = unknowns + step
        moved = float(np.max(np.abs(step), initial=0.0))
    spread, noise = uncertainty(rows, kept, norm)
    prior = np.stack([d.vector for d in left_out], axis=1) if left_out else np.zeros((size, 0))
    total = objective(rows, norm)
    return Estimate(unknowns, spread + prior @ prior.T, noise, left_out, total, iterations, moved < CLOSED)


def compared_rows(problem: DistanceProblem, unknowns: Floats, norm: str) -> Rows:
    """The rows whose sum of squares, or of absolute values, is eq. 9."""
    distances = problem.at(unknowns)
    return mean_rows(problem, distances) if norm == "squares" else pair_rows(problem, distances)


def objective(rows: Rows, norm: str) -> float:
    """Eq. 9 [m^2], or its sum of absolute values [m]."""
    return float(np.sum(rows.residual**2) if norm == "squares" else np.sum(np.abs(rows.residual)))


def determined(rows: Rows, free: Bools | None = None) -> tuple[Floats, tuple[Direction, ...]]:
    """Combinations (q, k) of the `free` (q,) unknowns to estimate, and those to leave at zero with their gains."""
    chosen = np.ones(rows.by_unknown.shape[1], dtype=bool) if free is None else free
    strength, own = np.linalg.eigh(rows.by_unknown[:, chosen].T @ rows.by_unknown[:, chosen])
    vectors = np.zeros((len(chosen), len(own)))
    vectors[chosen] = own
    known = strength > 1e-12 * strength[-1]
    carried = np.asarray((rows.by_noise.T @ (rows.by_unknown @ vectors)).T)
    variance = np.full(len(strength), np.inf)
    variance[known] = np.sum(carried[known] ** 2, axis=1) / strength[known] ** 2
    gain = 1.0 / (1.0 + variance)
    keep = gain >= DETERMINED
    left = [Direction(vectors[:, i], float(gain[i])) for i in np.flatnonzero(~keep)]
    return vectors[:, keep], tuple(sorted(left, key=lambda d: d.gain))


def _step(design: Floats, residual: Floats, norm: str) -> Floats:
    """Minimise |residual + design @ step| in the chosen norm."""
    if norm == "squares":
        return -_least_squares(design, residual)
    return -least_absolute(design, residual)


def _least_squares(design: Floats, goal: Floats) -> Floats:
    x = np.linalg.lstsq(design, goal, rcond=None)[0]
    return np.asarray(x, dtype=np.float64)


def uncertainty(rows: Rows, kept: Floats, norm: str) -> tuple[Floats, Floats]:
    """Covariance (q, q) of the estimate and its covariance (q, 3 n + g) with the whitened noise.

    For absolute deviations by the asymptotic law of the median for correlated normal rows: the score is the sign,
    E[sign sign] = 2/pi asin(correlation), taken to first order off the diagonal.
    """
    design = rows.by_unknown @ kept
    if norm == "squares":
        inverse = np.linalg.inv(design.T @ design)
        influence = -inverse @ np.asarray((rows.by_noise.T @ design).T)
        noise = kept @ influence
        return noise @ noise.T, noise
    spread = np.sqrt(np.asarray(rows.by_noise.multiply(rows.by_noise).sum(axis=1)).ravel())
    spread = np.maximum(spread, 1e-12)
    scaled = design / spread[:, None]
    curvature = np.sqrt(2 / np.pi) * (design.T @ scaled)
    carried = np.asarray((rows.by_noise.T @ scaled).T) * np.sqrt(2 / np.pi)
    score = carried @ carried.T + (1 - 2 / np.pi) * (design.T @ design)
    inverse = np.linalg.inv(curvature)
    covariance = kept @ inverse @ score @ inverse.T @ kept.T
    return covariance, kept @ (-inverse @ carried)
