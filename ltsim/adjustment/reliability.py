"""Reliability of readings: redundancy numbers, normalised residuals, outlier tests, detection probability."""

from functools import lru_cache

import numpy as np
from scipy import special

from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.significance import (
    FAMILY_WISE_LEVEL,
    MIN_CHECKED_REDUNDANCY,
    MIN_DOF_FOR_ESTIMATED_NOISE,
    MIN_EQUIVALENT_SQUARED_CORRELATION,
    SINGLE_TEST_LEVEL,
    TEST_POWER,
)
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.probability import TWO_SIDED_GLOBAL_TEST_LEVEL
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.physics.model.measurement import NetworkState
from ltsim.solve.design import robust_sigma
from ltsim.solve.elimination import FactorisedNormals
from ltsim.solve.gauss_newton import Solution

MAX_SIGMA0_FOR_DECLARED_NOISE = 1.25
"""Limit of a robust estimate of sigma0. Below it, residuals are tested with the declared noise; above it, with the
estimated noise."""
MIN_NOISY_SCATTER_RATIO = 2.0
"""Limit of the scatter at a target, divided by the scatter at the other targets. A target with a larger ratio counts as
noisy."""


def redundancy_numbers(problem: NetworkProblem, normal_equations: FactorisedNormals) -> Floats:
    """Redundancy numbers (n, 3) of the readings of n pointings; NaN for unused readings.

    A redundancy number, 0 to 1, is the part of an error of a reading that its residual shows.
    """
    share = np.full(problem.is_used_reading.shape, np.nan)
    share[problem.is_used_reading] = 1.0 - normal_equations.leverage()[: int(problem.is_used_reading.sum())]
    return share


def normalise_residuals(problem: NetworkProblem, residuals: Floats, redundancy: Floats) -> Floats:
    """Normalised residuals (n, 3) of n pointings: `residuals` (n, 3) divided by their standard deviations.

    The standard deviation of a residual is that of its reading times the square root of its redundancy number
    (`redundancy` (n, 3)). The result is 0 for readings that no other observation checks, and NaN for unused readings.
    """
    is_checked = problem.is_used_reading & (redundancy > NORMAL_EQUATIONS_TOLERANCE)
    w = np.where(problem.is_used_reading, 0.0, np.nan)
    w[is_checked] = residuals[is_checked] / (problem.reading_sigmas[is_checked] * np.sqrt(redundancy[is_checked]))
    return w


def noise_factor_from_residuals(normalised_residuals: Floats, redundancy: Floats) -> float:
    """Factor on the declared noise, a robust estimate from normalised residuals; 1 if the estimate is at most 1.25.

    `normalised_residuals` and `redundancy` numbers (n, 3) are those of n pointings. The factor is never below 1, so
    that a reading that is consistent with the declared noise is no outlier.
    """
    scale = robust_sigma(normalised_residuals[np.nan_to_num(redundancy) > MIN_CHECKED_REDUNDANCY])
    return scale if scale > MAX_SIGMA0_FOR_DECLARED_NOISE else 1.0


def noise_factor(problem: NetworkProblem, solution: Solution[NetworkState]) -> float:
    """Factor, at least 1, by which the declared noise is multiplied in all tests of an adjustment.

    It is 1 if the adjustment passes the global test, or if only single readings contradict the declared noise.
    Otherwise it is the smaller of sigma0 and the robust estimate `noise_factor_from_residuals`.
    """
    dof, chi2 = problem.dof, solution.sum_of_squares
    if solution.factor is None or dof <= 0 or special.chdtrc(dof, chi2) >= TWO_SIDED_GLOBAL_TEST_LEVEL / 2:
        return 1.0
    redundancy = redundancy_numbers(problem, solution.factor)
    residuals = problem.reading_residuals(problem.model.predict(solution.x))
    scale = noise_factor_from_residuals(normalise_residuals(problem, residuals, redundancy), redundancy)
    return max(1.0, min(scale, float(np.sqrt(chi2 / dof))))


def detect_noisy_targets(normalised_residuals: Floats, redundancy: Floats, target: Ints) -> tuple[Ints, float, float]:
    """Indices (k,) of k noisy targets, scatter of the readings to these targets, and scatter of all other readings.

    A target is noisy if its readings scatter `MIN_NOISY_SCATTER_RATIO` times more than those to the other targets. A
    scatter is a robust standard deviation of normalised residuals. `normalised_residuals` and `redundancy` numbers
    (n, 3) belong to n pointings; `target` (n,) is the target index of each.
    """
    testable = np.where(np.nan_to_num(redundancy) > MIN_CHECKED_REDUNDANCY, normalised_residuals, np.nan)

    def group_scatter(is_in_group: Bools) -> float:
        return robust_sigma(testable[is_in_group][np.isfinite(testable[is_in_group])])

    n_testable = np.bincount(target, np.isfinite(testable).sum(axis=1))
    scatter_of = {
        t: group_scatter(target == t) for t in np.flatnonzero(n_testable >= MIN_DOF_FOR_ESTIMATED_NOISE).tolist()
    }
    named: list[int] = []
    for t in sorted(scatter_of, key=lambda t: -scatter_of[t])[: len(scatter_of) - 1]:
        if not scatter_of[t] > MIN_NOISY_SCATTER_RATIO * group_scatter(~np.isin(target, [*named, t])):
            break
        named.append(t)
    is_member = np.isin(target, named)
    return np.array(named, dtype=np.int64), group_scatter(is_member) if named else 1.0, group_scatter(~is_member)


def critical_normalised_residual(n_readings: int, alpha: float = FAMILY_WISE_LEVEL) -> float:
    """Critical value of the absolute normalised residual |w| if `n_readings` readings are tested (Sidak).

    `alpha` is the false-alarm rate of all these tests together.
    """
    return float(-special.ndtri(0.5 * level_of_single_test(n_readings, alpha)))


def p_value_of_tau(tau: Floats, dof: Floats, n_readings: int) -> Floats:
    """p-value of tau = |w| / sigma0: probability that the largest tau of `n_readings` correct readings exceeds `tau`.

    w is a normalised residual, `dof` the degrees of freedom of the estimated sigma0; infinite for the declared noise
    (sigma0 = 1).

    References
    ----------
    Pope, The statistics of residuals and the detection of outliers, NOAA TR NOS 65 NGS 1 (1976):
    tau = sqrt(f) t / sqrt(f - 1 + t^2), t of Student with f - 1 degrees of freedom.
    """
    finite_dof = np.where(np.isfinite(dof), np.maximum(dof, 2.0), 2.0)
    t = tau * np.sqrt((finite_dof - 1.0) / np.maximum(finite_dof - tau**2, 1e-300))
    p_single = 2.0 * np.where(np.isfinite(dof), special.stdtr(finite_dof - 1.0, -t), special.ndtr(-tau))
    p_single = np.where(dof < 2, 1.0, p_single)
    return np.asarray(-np.expm1(n_readings * np.log1p(-np.minimum(p_single, 1.0 - 1e-16))))


def iterative_snooping(
    residuals: Floats, redundancy_matrix: Floats, noise_factors: Floats, dof: Floats, n_readings: int, alpha: float
) -> list[tuple[int, float, float, float]]:
    """Outliers among k readings, the most significant first: index, estimated error, normalised residual w, p-value.

    `residuals` (k,) and the estimated errors are in standard deviations of the readings. Element (i, j) of
    `redundancy_matrix` (k, k) is the change of residual i by a unit error of reading j. Outliers are removed one after
    another; readings that cannot be distinguished from an outlier follow it in the list. `noise_factors` (k,) multiply
    the declared noise, and `dof` (k,) are the degrees of freedom of their estimates. `n_readings` is the number of
    tested readings, `alpha` the false-alarm rate of all tests together.
    """
    outliers, redundancy = list[tuple[int, float, float, float]](), np.diag(redundancy_matrix).copy()
    while (redundancy > NORMAL_EQUATIONS_TOLERANCE).any():
        w = np.where(
            redundancy > NORMAL_EQUATIONS_TOLERANCE,
            residuals / np.sqrt(np.maximum(redundancy, NORMAL_EQUATIONS_TOLERANCE)),
            0.0,
        )
        chance, k = (
            p_value_of_tau(np.abs(w) / noise_factors, dof, n_readings),
            int(np.argmax(np.abs(w) / noise_factors)),
        )
        if not chance[k] < alpha:
            break
        is_equivalent = (
            redundancy_matrix[k] ** 2
            > MIN_EQUIVALENT_SQUARED_CORRELATION * redundancy_matrix[k, k] * np.diag(redundancy_matrix)
        ) & (redundancy > NORMAL_EQUATIONS_TOLERANCE)
        equivalents = [i for i in np.flatnonzero(is_equivalent & (chance < alpha)).tolist() if i != k]
        outliers += [(i, float(residuals[i] / redundancy[i]), float(w[i]), float(chance[i])) for i in (k, *equivalents)]
        residuals, redundancy_matrix = (
            residuals - redundancy_matrix[k] * residuals[k] / redundancy[k],
            redundancy_matrix - np.outer(redundancy_matrix[k], redundancy_matrix[k]) / redundancy[k],
        )
        redundancy = np.where(
            is_equivalent | (redundancy <= NORMAL_EQUATIONS_TOLERANCE), 0.0, np.diag(redundancy_matrix)
        )
    return outliers


def level_of_single_test(n_tests: int, family_wise_level: float) -> float:
    """Significance level of each of `n_tests` tests whose family-wise level is `family_wise_level` (Sidak)."""
    return float(-np.expm1(np.log1p(-family_wise_level) / max(n_tests, 1)))


@lru_cache
def noncentrality(dof: int = 1, *, alpha: float = SINGLE_TEST_LEVEL, n_tests: int = 1) -> float:
    """Noncentrality of chi-square at which a test detects an error with the probability `TEST_POWER` (80 %).

    The noncentrality is the squared length of the whitened residuals that the error causes.

    Parameters
    ----------
    dof : int
        Degrees of freedom of the test; 1 for a two-sided test of a normal variable.
    alpha : float
        False-alarm rate of all tested hypotheses together.
    n_tests : int
        Number of hypotheses that share the false-alarm rate (Sidak).

    References
    ----------
    Baarda, A testing procedure for use in geodetic networks (1968); Teunissen, Testing theory (2006), chapter 4.
    """
    limit = special.chdtri(dof, level_of_single_test(n_tests, alpha))
    return float(special.chndtrinc(limit, dof, 1.0 - TEST_POWER))


def neg_log_p_chi2(chi2_drop: Floats | float, rank: Ints | int) -> Floats:
    """Negative logarithm of the p-value of a decrease of chi-square, `chi2_drop`, with `rank` degrees of freedom.

    It is 0 for rank 0. For p-values below the range of floating-point numbers, the incomplete gamma function of
    a = `rank` / 2 and x = `chi2_drop` / 2 is approximated by Gamma(a, x) ~ x^(a - 1) e^-x (1 + (a - 1) / x).
    """
    a, x = np.maximum(rank, 1) / 2.0, np.maximum(chi2_drop, 0.0) / 2.0
    is_far = x > 300.0
    tail_x = np.where(is_far, x, 301.0)
    tail = tail_x - (a - 1) * np.log(tail_x) + special.gammaln(a) - np.log1p((a - 1) / tail_x)
    near_value = -np.log(special.gammaincc(a, np.where(is_far, 0.0, x)))
    return np.asarray(np.where(np.asarray(rank) > 0, np.where(is_far, tail, near_value), 0.0))
