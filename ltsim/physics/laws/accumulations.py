"""Accumulated quantities of a set-up: sums over the pointings that decay, or that events reset; and latches.

In the order of measurement of a set-up, an accumulated quantity is s_i = k_i (s_(i-1) + u_i). The input u_i is the
change of a covariate since the previous pointing: the time, the number of pointings, or the total rotation of an axis.
The factor k_i is 1 for a plain sum. It is less than 1 if the quantity decays with time or with the number of pointings,
and 0 if an event resets it. Such events are a change of face or of the target, an axis that turns back, a pause, a long
motion, or a fixed number of pointings.

A latch has the values 1 and 0: it is set when a covariate rises above one threshold and released when the covariate
falls below a lower one (a relay; Krasnosel'skii and Pokrovskii, Systems with hysteresis, 1989).
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.core.rounding import SQRT_MACHINE_EPSILON
from ltsim.scene.sightings import Sightings

ACCUMULATED_COVARIATES = ("station-time", "count", "work-azimuth", "work-elevation", "work-distance", "wound-azimuth")
"""Names of the covariates whose changes from pointing to pointing are accumulated."""
RESET_EVENTS = ("face", "seating", "azimuth", "elevation")
"""Names of events that reset an accumulated quantity (sum of the changes of a covariate) to zero: a change of the face,
of the target (`seating`), or of the direction of motion in azimuth or in elevation."""
RESET_LIMIT_QUANTITIES = ("pause", "slew", "tip")
"""Names of quantities that reset an accumulated quantity (sum of the changes of a covariate) if they exceed a limit:
the time since the previous pointing (`pause`), the motion in azimuth (`slew`), and the motion in elevation (`tip`)."""
TIME_DECAY_FUNCTION = "fades"
"""Name of the exponential decay of an accumulated quantity (sum of the changes of a covariate) with time."""
POINTING_DECAY_FUNCTION = "forgets"
"""Name of the exponential decay of an accumulated quantity (sum of the changes of a covariate) with the number of
pointings."""
FIXED_COUNT_RESET_FUNCTION = "every"
"""Name of the reset of an accumulated quantity (sum of the changes of a covariate) after a fixed number of
pointings."""
CANDIDATE_RESET_LIMIT_QUANTILES = (0.6, 0.8, 0.92)
"""Limits of pause, azimuth motion and elevation motion that a diagnosis tries for the reset of an accumulated quantity
(sum of the changes of a covariate), as quantiles in the recording."""
CANDIDATE_DECAY_TIME_FRACTIONS = np.array([0.03, 0.1, 0.3, 1.0])
"""Time constants of decays that a diagnosis tries, as fractions of the span of the time. For accumulated quantities
(sum of the changes of a covariate) only the first three are tried, as fractions of the median duration of a set-up. Any
time constant between two of them differs from one of them by less than a factor of two."""
CANDIDATE_DECAY_POINTINGS = (2.0, 4.0, 8.0)
"""Decay constants that a diagnosis tries for accumulated quantities (sum of the changes of a covariate): numbers of
pointings in which they decay by a factor of e."""
FIXED_COUNT_RESET_COVARIATES = ("station-time", "count")
"""Names of the covariates that a diagnosis accumulates (sum of the changes of a covariate) with a reset after a fixed
number of pointings."""
CANDIDATE_POINTINGS_BETWEEN_RESETS = range(3, 31)
"""Numbers of pointings between two resets of an accumulated quantity (sum of the changes of a covariate) that a
diagnosis tries."""
CANDIDATE_LATCH_QUANTILES = (0.2, 0.35, 0.5, 0.65, 0.8)
"""Thresholds of latches (on above one threshold of a covariate, until below another) that a diagnosis tries, as
quantiles of the covariate in the recording."""
MIN_ACCUMULATION_RESETS = 2
"""Smallest number of pointings with a reset, and smallest number without one, for which a diagnosis tries an
accumulated quantity (sum of the changes of a covariate). The first pointing of a set-up counts as neither. With fewer
resets the quantity is nearly a plain sum."""
AccumulationKey = tuple[str, str, float]
"""Key of an accumulated quantity (sum of the changes of a covariate): name of the covariate, name of the decay or
reset, and its constant (a time constant [s], a number of pointings, or a limit)."""


def candidate_accumulation_keys(sightings: Sightings, inputs: Sequence[str]) -> list[AccumulationKey]:
    """Keys of the accumulated quantities that a diagnosis tries; `inputs` are the names of the covariates.

    An accumulated quantity is the sum of the changes of a covariate over the pointings. Their values in the pointings
    are stored in the cache of the sightings.
    """
    functions = list(_candidate_decays_and_resets(sightings))
    states = [
        (name, how, k)
        for name in inputs
        for how, k in functions
        if how != FIXED_COUNT_RESET_FUNCTION or name in FIXED_COUNT_RESET_COVARIATES
    ]
    _cache_accumulations(sightings, states)
    min_spans = {name: SQRT_MACHINE_EPSILON * float(np.ptp(sightings.covariate_values[name])) for name in inputs}
    return [key for key in states if np.ptp(sightings.derived_cache[key]) > min_spans[key[0]]]


def _candidate_decays_and_resets(sightings: Sightings) -> Iterator[tuple[str, float]]:
    """Iterator over pairs of the name of a decay or reset of an accumulated quantity, and its constant.

    An accumulated quantity is the sum of the changes of a covariate over the pointings. A reset is omitted if too few
    pointings have it, or too few pointings do not have it.
    """
    setup_duration = float(
        np.median([np.ptp(sightings.time[sightings.station == s]) for s in np.unique(sightings.station)])
    )
    yield from (
        (TIME_DECAY_FUNCTION, setup_duration * share)
        for share in CANDIDATE_DECAY_TIME_FRACTIONS[:-1]
        if setup_duration > 0.0
    )
    yield from ((POINTING_DECAY_FUNCTION, number) for number in CANDIDATE_DECAY_POINTINGS)
    reset_functions = [(f"after {name}", 1.0) for name in RESET_EVENTS]
    for name in RESET_LIMIT_QUANTITIES:
        x = _limit_quantity(sightings, name)
        reset_functions += (
            [(f"after {name}", float(k)) for k in np.unique(np.quantile(x[x > 0.0], CANDIDATE_RESET_LIMIT_QUANTILES))]
            if x.any()
            else []
        )
    reset_functions += [(FIXED_COUNT_RESET_FUNCTION, float(number)) for number in CANDIDATE_POINTINGS_BETWEEN_RESETS]
    for how, k in reset_functions:
        n_resets = int(_is_reset(sightings, how, k).sum())
        if (
            MIN_ACCUMULATION_RESETS
            <= n_resets
            < len(sightings) - len(np.unique(sightings.station)) - MIN_ACCUMULATION_RESETS
        ):
            yield how, k


def accumulation_column(sightings: Sightings, covariate: str, function_name: str, constant: float) -> Floats:
    """Values (n,) in n pointings of an accumulated quantity (a sum that decays or is reset), minus their mean.

    The quantity accumulates the changes of `covariate`. `function_name` is the name of the decay or reset, `constant`
    its constant.
    """
    key: AccumulationKey = covariate, function_name, constant
    _cache_accumulations(sightings, [key])
    values: Floats = sightings.derived_cache[key]
    return values


def latch_column(sightings: Sightings, covariate: str, set_threshold: float, release_threshold: float) -> Floats:
    """Values (n,) in n pointings of a latch (1 or 0, depending on two thresholds of a covariate), minus their mean.

    The latch is 1 after the covariate rises above `set_threshold`, until it falls below `release_threshold`.
    """
    x, rows = sightings.covariate_values[covariate], sightings.pointing_order_by_station
    event = np.where(x > set_threshold, 1.0, np.where(x < release_threshold, 0.0, np.nan))[rows]
    is_first_pointing = sightings.previous_pointing_indices[rows] < 0
    event = np.where(
        is_first_pointing & np.isnan(event),
        (x[rows] > 0.5 * (set_threshold + release_threshold)).astype(np.float64),
        event,
    )
    last_events = np.maximum.accumulate(np.where(np.isnan(event), 0, np.arange(len(rows))))
    latch_values = np.empty(len(rows))
    latch_values[rows] = event[last_events]
    return latch_values - latch_values.mean()


def candidate_latch_keys(sightings: Sightings, covariates: Iterable[str]) -> list[tuple[str, float, float]]:
    """Latches that a diagnosis tries, each as a tuple of the covariate, its upper threshold and its lower threshold.

    A latch is on once a covariate exceeds a threshold, and off once it is below a lower one.
    """
    latches = []
    for name in covariates:
        thresholds = np.unique(np.quantile(sightings.covariate_values[name], CANDIDATE_LATCH_QUANTILES))
        latches += [(name, float(above), float(below)) for below, above in combinations(thresholds, 2)]
    return latches


def _limit_quantity(sightings: Sightings, quantity_name: str) -> Floats:
    """Absolute values (n,) in n pointings of a time [s] or motion [rad] that resets an accumulated quantity.

    An accumulated quantity is the sum of the changes of a covariate over the pointings. `quantity_name` is the time
    since the previous pointing (`pause`), or the motion in azimuth (`slew`) or elevation (`tip`).
    """
    quantity = {"pause": "lapse", "slew": "move-azimuth", "tip": "move-elevation"}[quantity_name]
    return np.abs(sightings.covariate_values[quantity])


def _is_reset(sightings: Sightings, function_name: str, constant: float) -> Bools:
    """Mask (n,) of the pointings at which an accumulated quantity is reset, except the first pointing of a set-up.

    An accumulated quantity is the sum of the changes of a covariate over the pointings. `function_name` is the name of
    the reset, `constant` its limit or its number of pointings.
    """
    has_previous = sightings.previous_pointing_indices >= 0
    before = np.where(has_previous, sightings.previous_pointing_indices, 0)
    name = function_name.removeprefix("after ")
    if function_name in (TIME_DECAY_FUNCTION, POINTING_DECAY_FUNCTION):
        return np.zeros(len(sightings), dtype=bool)
    if function_name == FIXED_COUNT_RESET_FUNCTION:
        return has_previous & (np.remainder(sightings.covariate_values["count"], round(constant)) == 0.0)
    if name in RESET_LIMIT_QUANTITIES:
        return has_previous & (_limit_quantity(sightings, name) > constant)
    quantity = {
        "face": sightings.face,
        "seating": sightings.target,
        "azimuth": sightings.approach_signs[:, 0],
        "elevation": sightings.approach_signs[:, 1],
    }[name]
    return np.asarray(has_previous & (quantity != quantity[before]))


def _cache_accumulations(sightings: Sightings, state_keys: Sequence[AccumulationKey]) -> None:
    """Computation of several accumulated quantities in one pass; the values minus their mean, (n,), are cached.

    An accumulated quantity is the sum of the changes of a covariate over the pointings.
    """
    state_keys = [key for key in state_keys if key not in sightings.derived_cache]
    if not state_keys:
        return
    row_order = sightings.pointing_order_by_station
    inputs = {name: _increments(sightings, name)[row_order] for name in {name for name, _, _ in state_keys}}
    factors = {key: _remaining_fraction(sightings, *key)[row_order] for key in {(how, k) for _, how, k in state_keys}}
    increments = np.stack([inputs[name] for name, _, _ in state_keys], axis=1)
    factor = np.stack([factors[how, k] for _, how, k in state_keys], axis=1)
    state_values = np.empty_like(increments)
    present_values = np.zeros(len(state_keys))
    for i in range(len(row_order)):
        present_values = factor[i] * (present_values + increments[i])
        state_values[i] = present_values
    state_values -= state_values.mean(axis=0)
    for key, column in zip(state_keys, state_values.T, strict=True):
        sightings.derived_cache[key] = np.empty(len(row_order))
        sightings.derived_cache[key][row_order] = column


def _increments(sightings: Sightings, covariate: str) -> Floats:
    """Change (n,) of a covariate from the previous pointing of the set-up to each of n pointings; 0 for the first."""
    x = sightings.covariate_values[covariate]
    return np.where(sightings.previous_pointing_indices >= 0, x - x[sightings.previous_pointing_indices], 0.0)


def _remaining_fraction(sightings: Sightings, function_name: str, constant: float) -> Floats:
    """Fraction (n,) of an accumulated quantity that remains at each of n pointings from the previous pointing.

    An accumulated quantity is the sum of the changes of a covariate over the pointings. It is 0 at a reset and at the
    first pointing of a set-up. `function_name` is the name of the decay or reset, `constant` its constant: a time [s],
    a number of pointings, or the limit of a pause or motion.
    """
    has_previous = (sightings.previous_pointing_indices >= 0).astype(np.float64)
    if function_name == TIME_DECAY_FUNCTION:
        return has_previous * np.exp(-sightings.covariate_values["lapse"] / constant)
    if function_name == POINTING_DECAY_FUNCTION:
        return has_previous * np.exp(-1.0 / constant)
    return has_previous * ~_is_reset(sightings, function_name, constant)
