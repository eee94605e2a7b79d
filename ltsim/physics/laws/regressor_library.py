"""Library of the regressors that a search tries: functions of base quantities and of the order of the pointings.

Base quantities are readings and position of a pointing, the time, and additional columns of the recording. Operators
make further regressors: the value at the previous pointing, the change since then, accumulated changes, a lag, and a
value per station or previous target. Each operator, and each product, multiplies the prior odds by `ODDS_PER_OPERATOR`.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.rounding import SQRT_MACHINE_EPSILON
from ltsim.physics.laws.accumulations import (
    ACCUMULATED_COVARIATES,
    CANDIDATE_DECAY_TIME_FRACTIONS,
    TIME_DECAY_FUNCTION,
    candidate_accumulation_keys,
    candidate_latch_keys,
)
from ltsim.physics.laws.columns import N_CURVE_MODES, N_PRODUCT_CURVE_MODES
from ltsim.physics.laws.places import MIN_GROUP_TARGETS
from ltsim.physics.laws.regressors import (
    CLOCK_COVARIATES,
    CONSTANT_REGRESSOR,
    DEFLECTION_FUNCTION,
    Regressor,
    accumulation_regressor,
    group_amounts_regressor,
    latch_regressor,
    name_without_memory_prefix,
    nearness_regressor,
    path_length_regressor,
    piecewise_regressor,
    scalar_regressor,
    smooth_regressor,
    switch_regressor,
    with_position_dependence,
)
from ltsim.scene.regions import HallRegion, candidate_regions, is_passed_by_part_of_sights
from ltsim.scene.sightings import Sightings

RAW_READING_NAMES = ("azimuth", "elevation", "distance")
"""Names of the three raw readings as covariates."""
MEMORYLESS_COVARIATES = (*RAW_READING_NAMES, "time", "station-time", "height", "bearing", "x", "y")
"""Names of the covariates that do not depend on earlier pointings."""
_CIRCLE_COVARIATES = ("circle", "vertical-circle")
"""Names of the covariates that are readings of a circle, which differ between the faces."""
_NEST_COVARIATES = ("incidence", "nest-direction")
"""Names of the covariates that need the normals of the nests."""
_SIGN_COVARIATES = ("face", "approach-azimuth", "approach-elevation", "parity", "seating-parity", "repeat")
"""Names of covariates with few values, such as the face. Only errors in proportion to these values are tried."""
ACCUMULATED_ROTATIONS = ("work-azimuth", "work-elevation")
"""Names of the covariates that are the total rotation of an axis since the set-up began."""
MEMORY_OPERATOR_PREFIXES = ("last", "move", "work")
"""Prefixes of covariates: value at the previous pointing (`last`), change since (`move`), sum of changes (`work`)."""
MEMORY_COVARIATES = (
    "wound-azimuth",
    "lapse",
    "count",
    *(f"{how}-{name}" for how in MEMORY_OPERATOR_PREFIXES for name in RAW_READING_NAMES),
)
"""Names of the covariates that depend on earlier pointings."""
BUILTIN_COVARIATES = tuple(
    dict.fromkeys(
        (*MEMORYLESS_COVARIATES, "z", *_CIRCLE_COVARIATES, *_NEST_COVARIATES, *_SIGN_COVARIATES, *MEMORY_COVARIATES)
    )
)
"""Names of the covariates that follow from the pointings; columns of the recording are further covariates."""
_HEAD_COVARIATES = (
    *("azimuth", "elevation", *_CIRCLE_COVARIATES, *_SIGN_COVARIATES),
    *(n for n in MEMORY_COVARIATES if not n.endswith("distance")),
)
"""Names of the covariates that are angles or motions of the tracker head."""
PERMITTED_COVARIATES_BY_AFFECTED_PART: dict[str, tuple[str, ...]] = {
    "instrument": (
        *(*CLOCK_COVARIATES, *_HEAD_COVARIATES, "distance", "height"),
        *("move-distance", "last-distance", "work-distance"),
    ),
    "circle": (*CLOCK_COVARIATES, "lapse", *_SIGN_COVARIATES[3:]),
    "stand": (
        *(*CLOCK_COVARIATES, "azimuth", "elevation", *_CIRCLE_COVARIATES, "distance"),
        *("wound-azimuth", "work-azimuth", "work-elevation", "lapse", "count", "last-target"),
    ),
    "target": ("time", "station", "distance", "height", *_SIGN_COVARIATES[3:], *_NEST_COVARIATES),
    "reflector": ("time", "lapse", "last-target", *_SIGN_COVARIATES[3:], *_NEST_COVARIATES),
    "air": CLOCK_COVARIATES,
}
"""Names of the covariates on which a response (changed quantity) can depend, by `Response.changed_part`. It can also
depend on additional columns of the recording. The position of a wall cannot depend on the direction in which a tracker
points. The position of a stand can, because a head is not balanced exactly."""
MIN_EFFECTIVE_TARGETS_IN_REGION = 2.5
"""Smallest effective number (sum w)^2 / sum(w^2) of targets with weights w in a region whose errors are tried."""
NEARNESS_REGION_SHAPES = ("xyz", "xy")
"""Axes along which regions are bounded, for errors that depend on the distance of a target from a position."""
TEMPORARY_REGION_SHAPES = ("xy", "x", "y", "z")
"""Axes along which regions are bounded that may act during a part of the measurement."""
CANDIDATE_TIME_PART_COUNTS = (2, 4)
"""Numbers of equal parts of the duration of a recording; a region of the hall may act in one part only."""
CANDIDATE_HYSTERESIS_HALF_WIDTHS = np.array([0.05, 0.15, 0.3])
"""Half-widths of hysteresis loops that a diagnosis tries, as fractions of the span of the covariate."""
CANDIDATE_DEAD_BAND_QUANTILES = (0.15, 0.3, 0.5)
"""Limits of dead bands (long motions of an axis have no effect), as quantiles of the motions between pointings."""
CANDIDATE_LAG_TIME_CONSTANTS = (60.0, 300.0, 1000.0, 3000.0)
"""Time constants [s] of lags that a diagnosis tries, typical of detectors, instruments, stands, walls and floors."""
MAX_SEPARATE_AMOUNTS = 12
"""Largest number of set-ups, instruments or targets with separate values in an error law (more would fit any errors),
and largest number of times at which a diagnosis tries a step."""
MAX_SEPARATE_TARGET_AMOUNTS = 60
"""Largest number of targets for which a diagnosis tries errors with a separate value per target."""
WAVE_FREQUENCY_STEP = 0.6
"""Spacing of the frequencies of the waves that a diagnosis tries, in cycles over the span of the covariate."""
MAX_CANDIDATE_WAVE_CYCLES = 60
"""Largest number of cycles, over the span of the covariate, of a wave that a diagnosis tries."""
MIN_POINTINGS_PER_CYCLE = 8
"""Smallest number of pointings per cycle of a wave that a diagnosis tries."""
ODDS_PER_OPERATOR = 1.0 / 3.0
"""Factor on the prior odds of a function of covariates per operator (such as a lag), and per factor after the first."""
N_OPERATORS_BY_REGRESSOR_KIND = {
    "constant": 0,
    "sign": 0,
    "curve": 0,
    "clock": 0,
    "step": 0,
    "decay": 0,
    "wave": 0,
    "memory": 1,
    "lag": 1,
    "amounts": 1,
    "shape": 1,
    "passage": 1,
    "lever": 1,
    "passage for a time": 2,
    "lever for a time": 2,
    "near": 1,
    "latch": 1,
    "state": 2,
    "room": 1,
    "product": 2,
}
"""Number of operators (such as a lag) plus further factors, by kind of function: exponent of `ODDS_PER_OPERATOR`."""


def varying_column_names(sightings: Sightings) -> list[str]:
    """Names of the additional columns of the recording whose values vary."""
    covariates = sightings.covariates.items()
    return [name for name, values in covariates if np.isfinite(values).any() and np.nanstd(values) > 0]


def _varying_covariates(sightings: Sightings, covariates: Iterable[str]) -> list[str]:
    """Names of the given `covariates` with values that vary in these sightings."""
    has_nests, faces = np.isfinite(sightings.incidence_angle).any(), np.ptp(sightings.face) > 0
    asked = [
        n for n in covariates if (has_nests or n not in _NEST_COVARIATES) and (faces or n not in _CIRCLE_COVARIATES)
    ]
    floor = {n: SQRT_MACHINE_EPSILON * (name_without_memory_prefix(n) not in sightings.covariates) for n in asked}
    return [n for n in asked if np.ptp(sightings.covariate_values[n]) > floor[n]]


def is_physically_possible(changed_part: str, regressor: Regressor, sightings: Sightings) -> bool:
    """True if an error in the part `changed_part` of the measurement can physically depend on `regressor`."""
    names = [*regressor.covariates, *(n for f in regressor.factors if f.kind != "field" for n in f.covariates)]
    permitted_names = PERMITTED_COVARIATES_BY_AFFECTED_PART.get(changed_part, ())
    return changed_part == "reading" or all(
        n in permitted_names or name_without_memory_prefix(n) in sightings.covariates for n in names
    )


def candidate_regressors(sightings: Sightings, n_modes: int = N_CURVE_MODES) -> dict[str, list[Regressor]]:
    """Functions of covariates (regressors) that a diagnosis tries, by kind; smooth curves have `n_modes` modes."""
    s, columns = sightings, varying_column_names(sightings)
    base = _varying_covariates(s, (*MEMORYLESS_COVARIATES, *columns, *_CIRCLE_COVARIATES, *_NEST_COVARIATES))
    remembered = [f"{prefix}-{name}" for prefix in MEMORY_OPERATOR_PREFIXES for name in columns]
    before = _varying_covariates(s, (*MEMORY_COVARIATES, *remembered))
    turning = [n for n in base if n not in CLOCK_COVARIATES]  # time never decreases
    signs = [n for n in _varying_covariates(s, _SIGN_COVARIATES) if n != "seating-parity" or _alternations_differ(s)]
    return {
        "constant": [CONSTANT_REGRESSOR],
        "sign": [scalar_regressor(name, "power") for name in signs],
        "curve": [smooth_regressor(name, n_modes) for name in base],
        "clock": regressors_for_single_targets(s),
        "decay": [
            scalar_regressor(n, "decay", float(t))
            for n in CLOCK_COVARIATES
            if n in base
            for t in np.ptp(s.covariate_values[n]) * CANDIDATE_DECAY_TIME_FRACTIONS
        ],
        "memory": [
            *(smooth_regressor(name, n_modes) for name in before),
            *(scalar_regressor(name, "abs") for name in before if name.startswith("move-")),
        ],
        "lag": lag_regressors(s, (*columns, "elevation", "distance", "move-azimuth", "move-elevation")),
        "amounts": [*per_setup_regressors(s, MIN_GROUP_TARGETS + 1), *_per_previous_target_regressors(s)],
        "wave": list(wave_regressors(s)),
        "room": [
            *with_position_dependence(_slow_wave_regressors(s), 1),
            *with_position_dependence(regressors_for_single_targets(s), 2),
        ],
        "shape": [
            *(
                scalar_regressor(n, "hysteresis", float(k))
                for n in turning
                for k in np.ptp(s.covariate_values[n]) * CANDIDATE_HYSTERESIS_HALF_WIDTHS
            ),
            *dead_band_regressors(s),
        ],
        "passage": [path_length_regressor(region) for region in candidate_regions(s)],
        "lever": [path_length_regressor(region, DEFLECTION_FUNCTION) for region in candidate_regions(s)],
        "passage for a time": list(temporary_region_regressors(s)),
        "lever for a time": list(temporary_region_regressors(s, DEFLECTION_FUNCTION)),
        "near": [
            nearness_regressor(region)
            for region in candidate_regions(s, NEARNESS_REGION_SHAPES)
            if contains_several_targets(region, s)
        ],
        "state": [
            accumulation_regressor(*made)
            for made in candidate_accumulation_keys(s, _varying_covariates(s, ACCUMULATED_COVARIATES))
        ],
        "latch": [
            latch_regressor(*made)
            for made in candidate_latch_keys(s, _varying_covariates(s, (*RAW_READING_NAMES, *columns)))
        ],
        "product": list(product_regressors(s)),
    }


def dead_band_regressors(sightings: Sightings) -> list[Regressor]:
    """Functions of covariates for causes that act only in short motions of an axis; zero in long motions."""
    return [
        scalar_regressor(name, how, float(k))
        for name in _varying_covariates(sightings, ("move-azimuth", "move-elevation"))
        for k in np.unique(np.quantile(np.abs(sightings.covariate_values[name]), CANDIDATE_DEAD_BAND_QUANTILES))
        for how in ("within", "stuck")
        if k > SQRT_MACHINE_EPSILON
    ]


def contains_several_targets(region: HallRegion, sightings: Sightings) -> bool:
    """True if the effective number of targets in a region exceeds `MIN_EFFECTIVE_TARGETS_IN_REGION`."""
    return region.n_effective_targets(sightings) > MIN_EFFECTIVE_TARGETS_IN_REGION


def temporary_region_regressors(sightings: Sightings, function: str = "") -> Iterator[Regressor]:
    """Functions of covariates for regions of the hall that act during a part of the time, of a given `function`."""
    time, regions = np.unique(sightings.time), candidate_regions(sightings, TEMPORARY_REGION_SHAPES)
    if len(time) < MAX_SEPARATE_AMOUNTS or not regions:
        return
    passing = np.stack([region.path_lengths(sightings) > region.width for region in regions])
    for parts in CANDIDATE_TIME_PART_COUNTS:
        at = np.linspace(0, len(time) - 1, parts + 1).round().astype(int)
        ends = [*(0.5 * (time[at[1:-1]] + time[at[1:-1] - 1])).tolist(), np.inf]
        for begin, end in zip([-np.inf, *ends[:-1]], ends, strict=True):
            gate = switch_regressor([scalar_regressor("time", "step", edge) for edge in (begin, end) if edge < np.inf])
            during = (sightings.time > begin) & (sightings.time <= end)
            for i in np.flatnonzero(is_passed_by_part_of_sights(passing & during, sightings)):
                yield Regressor("product", factors=(path_length_regressor(regions[i], function), gate))


def regressors_for_single_targets(sightings: Sightings) -> list[Regressor]:
    """Functions that errors at single targets may follow: of time, or of additional columns of the recording."""
    names = _varying_covariates(sightings, ("time", *varying_column_names(sightings)))
    straight = [scalar_regressor(name, "power") for name in names]
    return [
        *straight,
        *(smooth_regressor(name, N_PRODUCT_CURVE_MODES) for name in names),
        *lag_regressors(sightings, varying_column_names(sightings)),
    ]


def regressors_for_target_groups(sightings: Sightings) -> dict[str, list[Regressor]]:
    """Functions that motions of a group of targets may follow, by kind: `step`, `curve`, `amounts` and others."""
    local, steps = regressors_for_single_targets(sightings), _time_step_regressors(sightings)
    each = per_setup_regressors(sightings, 2)
    return {
        "constant": [CONSTANT_REGRESSOR],
        "sign": [scalar_regressor(name, "power") for name in _varying_covariates(sightings, _SIGN_COVARIATES[3:])],
        "curve": [
            smooth_regressor(name, N_PRODUCT_CURVE_MODES)
            for name in _varying_covariates(sightings, _NEST_COVARIATES[:1])
        ],
        "clock": local,
        "step": steps,
        "amounts": each,
        "wave": _slow_wave_regressors(sightings),
        "room": with_position_dependence([*local, *each, *steps], 1),
    }


def _time_step_regressors(sightings: Sightings) -> list[Regressor]:
    """Step functions of time (regressors), at `MAX_SEPARATE_AMOUNTS` times spread evenly over the pointings."""
    clock = np.unique(sightings.time)
    if len(clock) < MAX_SEPARATE_AMOUNTS:
        return []
    step_indices = np.linspace(0, len(clock) - 1, MAX_SEPARATE_AMOUNTS + 2).round().astype(int)[1:-1]
    return [
        piecewise_regressor([scalar_regressor("time", "step", float(0.5 * (clock[i] + clock[i + 1])))])
        for i in step_indices
    ]


def _alternations_differ(sightings: Sightings) -> bool:
    """True if a sign that alternates with each target differs from a sign that alternates with each pointing."""
    parity, seating = (sightings.covariate_values[name] for name in ("parity", "seating-parity"))
    return abs(float(parity @ seating)) < len(parity)


def per_setup_regressors(sightings: Sightings, min_setups: int) -> list[Regressor]:
    """List with a function that has a value per set-up; empty for fewer than `min_setups` or too many set-ups."""
    n_stations = len(np.unique(sightings.station))
    return [group_amounts_regressor("station", n_stations)] if min_setups <= n_stations <= MAX_SEPARATE_AMOUNTS else []


def _per_previous_target_regressors(sightings: Sightings) -> list[Regressor]:
    """List of one function with a separate value for each previous target; empty if there are too many targets."""
    n_targets = len(sightings.target_names)
    return [group_amounts_regressor("last-target", n_targets)] if 1 < n_targets <= MAX_SEPARATE_TARGET_AMOUNTS else []


def lag_regressors(sightings: Sightings, covariates: Iterable[str]) -> list[Regressor]:
    """Regressors that follow a covariate with a first-order lag, one for each of `CANDIDATE_LAG_TIME_CONSTANTS`."""
    varying = _varying_covariates(sightings, covariates)
    return [
        Regressor("lagging", (name,), constant=t)
        for t in CANDIDATE_LAG_TIME_CONSTANTS
        if np.ptp(sightings.time) > t
        for name in varying
    ]


def product_regressors(sightings: Sightings) -> Iterator[Regressor]:
    """Iterator over products of two functions that a diagnosis tries, such as the sign of the face times a curve."""
    extra = varying_column_names(sightings)
    names = _varying_covariates(sightings, (*MEMORYLESS_COVARIATES[:7], *extra, *_CIRCLE_COVARIATES, *_NEST_COVARIATES))
    trackers = len(np.unique(sightings.instrument))
    if 1 < trackers <= MAX_SEPARATE_AMOUNTS:
        by_instrument = group_amounts_regressor("instrument", trackers)
        yield from (
            Regressor("product", factors=(smooth_regressor(name, N_PRODUCT_CURVE_MODES), by_instrument))
            for name in names
        )
    for sign in _varying_covariates(sightings, _SIGN_COVARIATES[:3]):
        yield from (
            Regressor(
                "product", factors=(scalar_regressor(sign, "power"), smooth_regressor(name, N_PRODUCT_CURVE_MODES))
            )
            for name in names
        )
    weights = [scalar_regressor("distance", "power"), scalar_regressor("elevation", "power")]
    for name in _varying_covariates(sightings, ACCUMULATED_ROTATIONS):  # heat from the drives
        state_keys = candidate_accumulation_keys(sightings, (name,))
        fading = [accumulation_regressor(*key) for key in state_keys if key[1] == TIME_DECAY_FUNCTION]
        yield from (Regressor("product", factors=(heat, weight)) for heat in fading for weight in weights)
    weights += (
        [smooth_regressor("lapse", N_PRODUCT_CURVE_MODES)] if np.ptp(sightings.covariate_values["lapse"]) > 0 else []
    )  # the effect of a motion may decay
    for move in _varying_covariates(sightings, [f"move-{name}" for name in RAW_READING_NAMES]):
        lengths = (scalar_regressor(move, how) for how in ("abs", "power"))
        yield from (Regressor("product", factors=(length, weight)) for length in lengths for weight in weights)
    for first, second in combinations(names, 2):
        if {first, second} not in (
            {"time", "station-time"},
            {"azimuth", "bearing"},
        ) and second not in _CIRCLE_COVARIATES:
            yield Regressor(
                "product",
                factors=(
                    smooth_regressor(first, N_PRODUCT_CURVE_MODES),
                    smooth_regressor(second, N_PRODUCT_CURVE_MODES),
                ),
            )


def wave_frequencies(sightings: Sightings, covariate: str, max_cycles: float) -> Floats:
    """Angular frequencies [rad per unit of the covariate] of waves with 1 to `max_cycles` cycles over its span."""
    span = float(np.ptp(sightings.covariate_values[covariate]))
    cycles = np.arange(1.0, max_cycles, WAVE_FREQUENCY_STEP)
    return 2 * np.pi * cycles / span if span > SQRT_MACHINE_EPSILON else np.zeros(0)


def wave_regressors(
    sightings: Sightings,
    covariates: Sequence[str] = ("time", *RAW_READING_NAMES, "x", "y", "z", "station-time", *ACCUMULATED_ROTATIONS),
    n_parts: int = 1,
) -> Iterator[Regressor]:
    """Iterator over waves in the given covariates, with frequencies that 1 / `n_parts` of the pointings can resolve."""
    max_waves = min(len(sightings) / MIN_POINTINGS_PER_CYCLE, MAX_CANDIDATE_WAVE_CYCLES) / n_parts
    for name in covariates:
        for rate in wave_frequencies(sightings, name, max_waves):
            yield Regressor("wave", (name,), constant=float(rate))


N_SLOW_WAVE_FREQUENCIES = 18
"""Number of the lowest frequencies of waves in time that a diagnosis tries for motions of targets."""


def _slow_wave_regressors(sightings: Sightings) -> list[Regressor]:
    """Waves in time with the `N_SLOW_WAVE_FREQUENCIES` lowest frequencies."""
    return list(wave_regressors(sightings, ("time",)))[:N_SLOW_WAVE_FREQUENCIES]
