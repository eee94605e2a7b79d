"""Checks of estimates and their declared standard deviations against true values, over many trials.

Mean, standard deviation and coverage of the z-scores (error divided by declared standard deviation) have two-sided
limits. The limits are the margins that ltsim specifies (0.1 for the mean, 5 % for the standard deviation, 1.5 % for the
coverage), widened by the sampling error of a finite number of trials. A correct model thus fails at least one check in
one run of a hundred.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Self

import numpy as np
from scipy import stats

from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError
from ltsim.core.results import Table, model_columns
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat

RECOVERY_FALSE_ALARM_RATE = 0.01
"""Probability that a correct model fails at least one of the checks of a run."""
NOMINAL_COVERAGE = 0.95
"""Nominal fraction of the confidence intervals that contain the true value."""
MIN_RECOVERY_TRIALS = 2
"""Smallest number of trials with a computed standard deviation."""
MEAN_Z_MARGIN = 0.1
"""Permitted deviation of the mean z-score (error / sigma) from 0, in addition to its sampling error."""
STANDARD_DEVIATION_Z_MARGIN = 0.05
"""Permitted deviation of the standard deviation of z-scores (error / sigma) from 1, in addition to its sampling error.
"""
COVERAGE_MARGIN = 0.015
"""Permitted deviation of the coverage of 95 % intervals from 0.95, in addition to its sampling error."""
TOTAL_CHI2_MARGIN = 0.02
"""Permitted relative deviation of the sum of chi-square over all trials from its expectation, in addition to its
sampling error."""
MEAN_SQUARE_Z_MARGIN = 0.05
"""Permitted deviation from 1 of the mean squared z-score of targets and stations, in addition to its sampling error."""
MAX_MEAN_SQUARE_Z_VARIATION_COEFFICIENT = float(np.sqrt(2.0))
"""Largest possible ratio of the standard deviation to the mean of a trial's mean squared z-score. It occurs if all
z-scores of the trial are equal."""


class RecoveryCheck(Entry):
    """Check that a number lies between two limits."""

    subject: str
    """Subject of the check, such as the name of a parameter, chi-square, targets or stations."""
    statistic: str
    """Name of the number that is checked, such as the mean z-score."""
    value: OptionalFloat
    """Value of the checked number."""
    lower_limit: Finite
    """Smallest value that passes the check."""
    upper_limit: Finite
    """Largest value that passes the check."""
    passed: bool
    """True if the number lies between the limits."""

    @classmethod
    def from_value(cls, subject: str, statistic: str, value: float, lower_limit: float, upper_limit: float) -> Self:
        """Check that the `value` of a `statistic` of a `subject`, such as a parameter, lies between two limits.

        The check fails if the value is NaN.
        """
        is_passed = bool(lower_limit <= value <= upper_limit)
        limits = {"lower_limit": lower_limit, "upper_limit": upper_limit}
        return cls(subject=subject, statistic=statistic, value=value, passed=is_passed, **limits)

    def with_limits(self, lower_limit: float, upper_limit: float) -> Self:
        """Copy of this check with the limits `lower_limit` and `upper_limit`."""
        return self.from_value(
            self.subject, self.statistic, math.nan if self.value is None else self.value, lower_limit, upper_limit
        )

    def sentence(self) -> str:
        """Sentence with the result of the check, its value and its limits."""
        verdict, value = "passes" if self.passed else "fails", "unknown" if self.value is None else f"{self.value:.4g}"
        limits = (
            f"required {self.lower_limit:.4g}"
            if self.lower_limit == self.upper_limit
            else f"allowed {self.lower_limit:.4g} to {self.upper_limit:.4g}"
        )
        return f"{self.subject} {verdict}: {self.statistic} = {value} ({limits})"


RECOVERY_CHECKS_TABLE = Table("checks.csv", "numbers that have to lie between two bounds", model_columns(RecoveryCheck))


def recovery_checks(
    estimate: Floats,
    sigma: Floats | None,
    truth: Floats,
    *,
    names: Sequence[str] | None = None,
    tolerance: Mapping[str, float] | None = None,
    alpha: float = RECOVERY_FALSE_ALARM_RATE,
) -> list[RecoveryCheck]:
    """Checks that true values are recovered within declared sigmas, within given tolerances, or both.

    Parameters
    ----------
    estimate, truth : (trials, parameters) float
        Estimates and true values of each parameter in each trial, in any unit.
    sigma : (trials, parameters) float, optional
        Standard deviations that the calibrator declares; without them only tolerances are checked.
    names : sequence of str, optional
        Names of the parameters; default their indices.
    tolerance : mapping of str to float, optional
        Limit, by name of the parameter, within which 95 % of the errors must lie. If any limit is given, only the
        parameters with a limit are checked.
    alpha : float
        Probability that a correct calibrator fails at least one of the checks of sigmas.

    Returns
    -------
    list of RecoveryCheck
        Checks of each parameter: mean, standard deviation and coverage of the z-scores (estimate - truth) / sigma. They
        are standard normal if the true values are distributed as the calibrator assumes and its sigmas are right.

    Raises
    ------
    ModelError
        If the arrays differ in shape or have fewer than two trials, if a tolerance names no parameter, or if neither
        sigmas nor tolerances are given.

    Examples
    --------
    >>> import ltsim as lt
    >>> (check,) = lt.recovery_checks([[1.9], [2.2]], None, [[2.0], [2.0]], names=["a"], tolerance={"a": 0.5})
    >>> check.sentence()
    'a passes: share of errors within 0.5 = 1 (allowed 0.95 to 1)'
    """
    estimate, truth = np.atleast_2d(estimate), np.atleast_2d(truth)
    names_used = [str(k + 1) for k in range(estimate.shape[1])] if names is None else list(names)
    if estimate.shape != truth.shape or len(names_used) != estimate.shape[1]:
        raise ModelError(
            f"estimates have the shape {estimate.shape}, truths {truth.shape}, and there are {len(names_used)} names: "
            "give one truth for each estimate and one name for each parameter"
        )
    if len(estimate) < MIN_RECOVERY_TRIALS:
        raise ModelError(f"there are estimates of {len(estimate)} trials, expected {MIN_RECOVERY_TRIALS} or more")
    if sigma is None and not tolerance:
        raise ModelError("neither sigma nor tolerance is given, so nothing can be checked: give one of them")
    if sigma is not None and np.atleast_2d(sigma).shape != estimate.shape:
        raise ModelError(
            f"sigmas have the shape {np.atleast_2d(sigma).shape}, estimates {estimate.shape}: "
            "give one sigma per estimate"
        )
    if unknown := [name for name in tolerance or () if name not in names_used]:
        raise ModelError(f"tolerance '{unknown[0]}' belongs to none of {', '.join(names_used)}")
    indices = [k for k, name in enumerate(names_used) if not tolerance or name in tolerance]
    checks = []
    for k in indices:
        if sigma is not None:
            z = (estimate[:, k] - truth[:, k]) / np.atleast_2d(sigma)[:, k]
            checks += parameter_checks(names_used[k], z, alpha / (3 * len(indices)))
        if tolerance:
            checks.append(tolerance_check(names_used[k], estimate[:, k] - truth[:, k], tolerance[names_used[k]]))
    return checks


def tolerance_check(name: str, errors: Floats, tolerance: float, tolerance_text: str = "") -> RecoveryCheck:
    """Check that 95 % of the errors (trials,) of the parameter `name` are within a tolerance in the same unit.

    `tolerance_text` is the tolerance with its unit, for the name of the check.
    """
    share = float(np.mean(np.abs(errors) <= tolerance))
    return RecoveryCheck.from_value(
        name, f"share of errors within {tolerance_text or f'{tolerance:g}'}", share, NOMINAL_COVERAGE, 1.0
    )


def parameter_checks(name: str, z_scores: Floats, alpha: float) -> list[RecoveryCheck]:
    """Checks of mean, standard deviation and coverage of the z-scores (trials,) of the parameter `name`.

    `alpha` is the false-alarm rate of each check.
    """
    n_scores = len(z_scores)
    shift = max(MEAN_Z_MARGIN, float(stats.norm.isf(alpha / 2) / np.sqrt(n_scores)))
    tails = stats.chi2.ppf([alpha / 2, 1 - alpha / 2], n_scores - 1) / (n_scores - 1)
    coverage_limits = stats.binom.ppf([alpha / 2, 1 - alpha / 2], n_scores, NOMINAL_COVERAGE) / n_scores
    coverage = float(np.mean(np.abs(z_scores) <= stats.norm.isf(0.5 * (1 - NOMINAL_COVERAGE))))
    deviation = (
        min(1 - STANDARD_DEVIATION_Z_MARGIN, np.sqrt(tails[0])),
        max(1 + STANDARD_DEVIATION_Z_MARGIN, np.sqrt(tails[1])),
    )
    limits = (
        min(NOMINAL_COVERAGE - COVERAGE_MARGIN, coverage_limits[0]),
        max(NOMINAL_COVERAGE + COVERAGE_MARGIN, coverage_limits[1]),
    )
    return [
        RecoveryCheck.from_value(name, "mean z-score", float(z_scores.mean()), -shift, shift),
        RecoveryCheck.from_value(
            name, "standard deviation of the z-scores", float(z_scores.std(ddof=1)), *map(float, deviation)
        ),
        RecoveryCheck.from_value(name, "coverage of 95 % intervals", coverage, *map(float, limits)),
    ]


def fixed_true_value_checks(name: str, z_scores: Floats, alpha: float) -> list[RecoveryCheck]:
    """Checks of z-scores (trials,) of an external calibrator, for a true parameter that is the same in all trials.

    The prior of the calibrator is unknown. A prior may make declared standard deviations larger than the scatter of the
    estimates, but not smaller. Standard deviation and coverage of the z-scores therefore have only one limit each, the
    mean has two. `alpha` is the false-alarm rate of each check.
    """
    mean, spread, coverage = parameter_checks(name, z_scores, alpha)
    return [mean, spread.with_limits(0.0, spread.upper_limit), coverage.with_limits(coverage.lower_limit, 1.0)]


def total_chi2_check(chi2: Floats, expected_chi2: Floats, chi2_sigma: Floats, alpha: float) -> RecoveryCheck:
    """Check of the sum of chi-square over all trials, divided by its expectation.

    `chi2` (trials,) is the chi-square of each trial; `expected_chi2` and `chi2_sigma` (trials,) are its expectation and
    standard deviation. `alpha` is the false-alarm rate of the check. The limits come from a scaled chi-square
    distribution with the same mean and variance (Satterthwaite).
    """
    mean, variance = float(np.sum(expected_chi2)), float(np.sum(chi2_sigma**2))
    freedom = 2 * mean**2 / variance
    tails = stats.chi2.ppf([alpha / 2, 1 - alpha / 2], freedom) / freedom
    low, high = min(1 - TOTAL_CHI2_MARGIN, float(tails[0])), max(1 + TOTAL_CHI2_MARGIN, float(tails[1]))
    return RecoveryCheck.from_value("chi-square", "chi2/dof of all trials", float(np.sum(chi2)) / mean, low, high)


def unit_mean_check(subject: str, statistic: str, trial_values: Floats, alpha: float) -> RecoveryCheck:
    """Check that `trial_values` (trials,), whose expectation is one, have a mean near one.

    `subject` and `statistic` say in the name of the check what the values describe.

    The limits follow from the median absolute deviation divided by the median, so that neither a few outliers nor
    values that are all too large widen them. `alpha` is the false-alarm rate.
    """
    median = float(np.median(trial_values))
    deviation = float(np.median(np.abs(trial_values - median)))
    relative = (
        min(deviation / (stats.norm.ppf(0.75) * median), MAX_MEAN_SQUARE_Z_VARIATION_COEFFICIENT)
        if median > 0
        else MAX_MEAN_SQUARE_Z_VARIATION_COEFFICIENT
    )
    margin = max(
        MEAN_SQUARE_Z_MARGIN,
        float(stats.t.isf(alpha / 2, len(trial_values) - 1)) * relative / np.sqrt(len(trial_values)),
    )
    return RecoveryCheck.from_value(subject, statistic, float(trial_values.mean()), max(1 - margin, 0.0), 1 + margin)
