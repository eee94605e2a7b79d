"""Events in the history of an instrument: changes of a parameter that are outliers among its other changes.

The parameters of a tracker change between calibrations by more than their standard deviations, and such changes are no
events. Their usual size is therefore estimated from the changes (steps) themselves. Each step is tested against the
other steps. The most significant step is removed and the remaining steps are tested again, so that two events do not
mask each other.

If the days between calibrations are known, a fraction g of the variance of usual steps may grow with them (random
walk), and the remainder is the same for each step: s^2 (1 - g + g days / median days). The p-value of a step is the
mean over the values `TIME_GROWING_VARIANCE_FRACTIONS` of g, weighted by the likelihood of the other steps.
"""

import numpy as np
from pydantic import Field
from scipy import special

from ltsim.adjustment.significance import FAMILY_WISE_LEVEL
from ltsim.calibration.calibration_series import CalibrationSeries
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.recordings.result_file import Entry, Finite, NotNegative

MIN_STEPS_FOR_EVENT_TEST = 3
"""Smallest number of steps (changes between successive calibrations) in a test for events. The t-test then has two
degrees of freedom."""
MIN_STEPS_TO_ESTIMATE_USUAL_CHANGES = 5
"""Smallest number of steps (changes between successive calibrations) from which the standard deviation of usual
changes is estimated. The variance of the steps then has four degrees of freedom."""
TIME_GROWING_VARIANCE_FRACTIONS = np.linspace(0.0, 1.0, 5)
"""Fractions of the variance of usual steps that may grow with the days between calibrations. p-values are averaged
over these fractions, weighted by likelihood."""


class EventEntry(Entry):
    """Event: change of one parameter between two calibrations that is an outlier among all changes of the parameter."""

    from_: str = Field(alias="from")
    """Label of the earlier calibration."""
    to: str
    """Label of the later calibration."""
    name: str
    """Name of the parameter."""
    difference: Finite
    """Later minus earlier estimate, in `unit`."""
    sigma: NotNegative
    """Standard deviation of `difference`, in `unit`."""
    usual_step_sigma: NotNegative
    """Standard deviation of all other changes of this parameter between successive calibrations; estimation errors
    are not included."""
    unit: str
    """Unit of `difference`, `sigma` and `usual_step_sigma`."""
    p_value: Finite
    """p-value of the change, corrected for the number of changes and parameters."""


def has_enough_steps_for_event_test(series: CalibrationSeries) -> bool:
    """True if a series has enough changes between calibrations (`MIN_STEPS_FOR_EVENT_TEST`) to test them for events."""
    return len(series) > MIN_STEPS_FOR_EVENT_TEST


def significant_parameter_steps(series: CalibrationSeries) -> tuple[EventEntry, ...]:
    """Significant changes of all parameters in chronological order; empty if there are too few changes for a test.

    p-values are corrected for the number of changes and parameters (Bonferroni).
    """
    if not has_enough_steps_for_event_test(series):
        return ()
    steps = [change.parameters for change in series.successive_changes()]
    difference, sigma = (
        np.array([[getattr(p, key) for p in entries] for entries in steps]) for key in ("difference", "sigma")
    )
    tested_parameters = np.flatnonzero((sigma > 0).all(axis=0)).tolist()
    growth, looks = _relative_step_durations(series), len(steps) * max(len(tested_parameters), 1)
    steps_by_parameter = {
        k: _significant_steps_of(difference[:, k], sigma[:, k], growth, FAMILY_WISE_LEVEL / looks)
        for k in tested_parameters
    }
    significant = sorted((i, k, usual, p) for k, entries in steps_by_parameter.items() for i, usual, p in entries)
    return tuple(
        EventEntry(
            **{"from": series.labels[i], "to": series.labels[i + 1]},
            name=series.construction.parameter_names[k],
            unit=series.construction.parameters[k].unit,
            difference=difference[i, k],
            sigma=sigma[i, k],
            usual_step_sigma=usual,
            p_value=min(1.0, p * looks),
        )
        for i, k, usual, p in significant
    )


def _relative_step_durations(history: CalibrationSeries) -> Floats:
    """Days between successive calibrations divided by their median, shape (steps,); ones if the days are unknown."""
    durations = np.diff(history.days) if history.days is not None else np.zeros(0)
    median = float(np.median(durations)) if len(durations) else 0.0
    return durations / median if median > 0 else np.ones(len(history) - 1)


def _significant_steps_of(
    difference: Floats, sigma: Floats, relative_durations: Floats, alpha: float
) -> list[tuple[int, float, float]]:
    """Significant steps of one parameter: index of the step, standard deviation of usual steps, and p-value.

    A step is a change between successive calibrations. The steps have the sizes `difference`, the standard deviations
    `sigma` and the durations `relative_durations`, each (steps,). `alpha` is the level of the test.
    """
    is_usual: Bools = np.ones(len(difference), dtype=bool)
    significant: list[tuple[int, float, float]] = []
    while is_usual.sum() > MIN_STEPS_FOR_EVENT_TEST - 1:
        steps = np.flatnonzero(is_usual)
        judged = [_step_p_value(difference, sigma, relative_durations, int(i), steps[steps != i]) for i in steps]
        best = int(np.argmin([p for p, _ in judged]))
        p, spread = judged[best]
        if p >= alpha:
            break
        is_usual[steps[best]] = False
        significant.append((int(steps[best]), spread, p))
    return significant


def _step_p_value(
    difference: Floats, sigma: Floats, relative_durations: Floats, step_index: int, other_steps: Ints
) -> tuple[float, float]:
    """Two-sided p-value of one step relative to other steps of its parameter, and standard deviation of usual steps.

    A step is a change between successive calibrations. The steps have the sizes `difference`, the standard deviations
    `sigma` and the durations `relative_durations`, each (steps,). The step `step_index` is tested against the steps
    with the indices `other_steps`.
    """
    likelihood, chance, usual = (
        np.zeros(len(TIME_GROWING_VARIANCE_FRACTIONS)),
        np.zeros(len(TIME_GROWING_VARIANCE_FRACTIONS)),
        np.zeros(len(TIME_GROWING_VARIANCE_FRACTIONS)),
    )
    for n, share in enumerate(TIME_GROWING_VARIANCE_FRACTIONS):
        shape = 1.0 - share + share * relative_durations
        scale = _variance_by_moments(difference[other_steps], sigma[other_steps], shape[other_steps])
        variance = sigma**2 + scale * shape
        gap = difference[other_steps] ** 2 / variance[other_steps] + np.log(
            variance[other_steps] / sigma[other_steps] ** 2
        )
        likelihood[n] = -0.5 * float(np.sum(gap))
        chance[n] = 2.0 * special.stdtr(len(other_steps), -abs(difference[step_index]) / np.sqrt(variance[step_index]))
        usual[n] = scale * shape[step_index]
    weight = np.exp(likelihood - likelihood.max())
    weight /= weight.sum()
    return float(weight @ chance), float(np.sqrt(weight @ usual))


def _variance_by_moments(difference: Floats, sigma: Floats, relative_variances: Floats) -> float:
    """Variance of the usual changes of a parameter between calibrations, by the method of moments; at least 0.

    The steps have the sizes `difference` and the standard deviations `sigma`. The variance of each is multiplied by its
    element of `relative_variances`. All arrays have the shape (steps,).
    """
    from scipy.optimize import brentq  # imported here: it takes a tenth of a second

    def excess(variance: float) -> float:
        return float(np.sum(difference**2 / (sigma**2 + variance * relative_variances))) - len(difference)

    if excess(0.0) <= 0:
        return 0.0
    variance_upper_bound = float(np.sum(difference**2))
    while excess(variance_upper_bound) > 0:  # steps without time between them have no growing variance
        if NORMAL_EQUATIONS_TOLERANCE * variance_upper_bound > float(np.sum(difference**2)):
            return variance_upper_bound  # no finite variance gives the expected chi-square
        variance_upper_bound *= 10.0
    return float(brentq(excess, 0.0, variance_upper_bound, rtol=NORMAL_EQUATIONS_TOLERANCE))
