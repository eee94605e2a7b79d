"""Stations, targets and times at which a search lets an effect act, from the pointings; base class of drifts."""

from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.effects.effect import Effect, Parameter, ShapeParameter
from ltsim.scene.sightings import Sightings

MAX_CANDIDATE_CHANGE_TIMES = 140
"""Largest number of times at which a diagnosis tries a sudden change, summed over all stations of a network."""
N_NEIGHBOURING_GAPS = 6
"""Number of gaps between pointings, before and after the time of a sudden change, to which a local search shifts the
change."""


def candidate_change_times(times: Floats, *, min_pointings: int, max_n_times: int) -> list[float]:
    """Times [s] at which a diagnosis tries a sudden change: midpoints between n pointings at sorted `times` (n,) [s].

    At least `min_pointings` pointings are before and after each change. At most `max_n_times` times are returned,
    spread evenly over the measurement.
    """
    ordered = np.sort(times)
    middle, gap = 0.5 * (ordered[1:] + ordered[:-1]), np.diff(ordered)
    allowed_range = slice(min_pointings - 1, max(len(middle) - min_pointings + 1, min_pointings - 1))
    middles = middle[allowed_range][gap[allowed_range] > 0]
    if len(middles) > max_n_times:
        middles = middles[np.unique(np.linspace(0, len(middles) - 1, max_n_times).round().astype(int))]
    return [float(t) for t in middles]


def candidate_station_change_times(sightings: Sightings, *, min_pointings: int) -> list[tuple[str, float]]:
    """Times of sudden changes that a diagnosis tries during the occupation of each station: pairs (station, time [s]).

    At least `min_pointings` pointings of the station are before and after each change.
    """
    max_times = max(2, MAX_CANDIDATE_CHANGE_TIMES // max(len(sightings.station_names), 1))
    return [
        (name, time)
        for s, name in enumerate(sightings.station_names)
        for time in candidate_change_times(
            sightings.time[sightings.station == s], min_pointings=min_pointings, max_n_times=max_times
        )
    ]


def candidate_times_between_occupations(sightings: Sightings, target_index: int, *, max_n_times: int) -> list[float]:
    """Times [s] at which a diagnosis tries a sudden motion of a target, at most `max_n_times`.

    The times are midpoints between the pointings to the target from two successive stations, or, if only one station
    measured the target, from this station. `target_index` is the index of the target.
    """
    target_rows = sightings.measurement_order[sightings.target[sightings.measurement_order] == target_index]
    times, stations = sightings.time[target_rows], sightings.station[target_rows]
    if len(np.unique(stations)) < 2:
        return candidate_change_times(times, min_pointings=2, max_n_times=max_n_times)
    change_rows = np.flatnonzero(np.diff(stations))
    middles = 0.5 * (times[change_rows] + times[change_rows + 1])
    if len(middles) > max_n_times:
        middles = middles[np.linspace(0, len(middles) - 1, max_n_times).round().astype(int)]
    return [float(t) for t in np.unique(middles)]


def neighbouring_gap_times(effect: Effect, sightings: Sightings, time: float) -> list[float]:
    """Midpoints [s] of the gaps, near `time` [s], between successive pointings on which `effect` acts.

    There are up to `N_NEIGHBOURING_GAPS` of these gaps before `time`, and as many after it.
    """
    ordered = np.unique(sightings.time[effect.pointing_indicator(sightings) > 0])
    midpoints = 0.5 * (ordered[1:] + ordered[:-1])
    index = int(np.searchsorted(midpoints, time))
    return [float(t) for t in midpoints[max(index - N_NEIGHBOURING_GAPS, 0) : index + N_NEIGHBOURING_GAPS + 1]]


def station_target_pairs(sightings: Sightings) -> list[tuple[str, str]]:
    """Pairs (name of station, name of target) with at least one pointing."""
    index_pairs = np.unique(np.stack([sightings.station, sightings.target], axis=1), axis=0)
    return [(sightings.station_names[s], sightings.target_names[t]) for s, t in index_pairs]


def recording_start_time(sightings: Sightings) -> float:
    """Time [s] of the first pointing of a recording."""
    return float(sightings.time.min(initial=np.inf))


TimeLaw = Literal["visit", "linear", "exponential"]
"""Name of the function of time that a drift follows: ``visit`` (linear from the first pointing of each station),
``linear`` (from the first pointing of the recording) or ``exponential``."""

WARM_UP_TIME_CONSTANT_PARAMETER = ShapeParameter(
    "time_constant", "min", "time constant of the warm-up", 600.0, 14_400.0, has_logarithmic_grid=True, n_grid_values=6
)
"""Shape parameter for the time constant of a warm-up, with the bounds [s] between which a diagnosis tries values."""


MAX_TIME_CONSTANT_TO_DURATION_RATIO = 2.0
"""Largest time constant of a warm-up that a diagnosis tries, divided by the duration of the recording. A warm-up with a
larger time constant is nearly linear in time."""
SHORT_RECORDING_TIME_CONSTANT_FRACTIONS = (0.3, 1.0)
"""Time constants of warm-ups that a diagnosis tries in a short recording, as fractions of its duration. A recording is
short if all other time constants exceed `MAX_TIME_CONSTANT_TO_DURATION_RATIO`."""


@dataclass(frozen=True)
class MotionDrift(Effect):
    """Base class of drifts: an error of the kinematic chain (such as `azimuth`) that changes with time."""

    law: TimeLaw = "linear"
    """Function of time that the drift follows. ``visit``: rate times the time since the station's first pointing;
    ``linear``: rate times the time t since the recording's first pointing; ``exponential``: amplitude times exp(-t /
    time_constant)."""
    time_constant: float = 3600.0
    """Time constant [s] of the function ``exponential``."""

    covariates = ("time",)
    shape_parameters = (WARM_UP_TIME_CONSTANT_PARAMETER,)
    chain_error_key: ClassVar[str]
    """Key of the error of the kinematic chain that drifts, such as `azimuth`."""
    rate_parameter: ClassVar[Parameter]
    """Parameter of the linear functions of time (``visit`` and ``linear``): rate of the correction."""
    decay_amplitude_parameter: ClassVar[Parameter]
    """Parameter of the function ``exponential``: correction at the start."""
    candidate_linear_time_laws: ClassVar[tuple[TimeLaw, ...]]
    """Linear functions of time that a diagnosis tries at all stations together: ``visit`` (time since the station's
    first pointing) or ``linear`` (time since the recording's first pointing). With one station, only the first of them
    is tried."""
    tries_single_stations: ClassVar[bool] = False
    """True if a diagnosis also tries drifts at single stations, in proportion to the time since the station's first
    pointing."""

    def __post_init__(self) -> None:
        parameter = self.decay_amplitude_parameter if self.law == "exponential" else self.rate_parameter
        object.__setattr__(self, "parameters", (parameter,))

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Drifts that a diagnosis tries: linear drifts at all stations or at one, and exponential warm-ups.

        Warm-ups with a time constant far above the duration of the measurement are omitted, because they are nearly
        linear. In a recording without times, row numbers replace the time.
        """
        span = float(np.ptp(sightings.time))
        times = [
            t
            for t in WARM_UP_TIME_CONSTANT_PARAMETER.grid_values().tolist()
            if t <= MAX_TIME_CONSTANT_TO_DURATION_RATIO * span
        ] or [share * span for share in SHORT_RECORDING_TIME_CONSTANT_FRACTIONS]
        names = sightings.station_names if len(sightings.station_names) > 1 else ()
        linear = [
            cls(law=law) for law in (cls.candidate_linear_time_laws if names else cls.candidate_linear_time_laws[:1])
        ]
        single_station_drifts = [cls((name,), law="visit") for name in names if cls.tries_single_stations]
        warm_ups = [cls(law="exponential", time_constant=t) for t in times if t > 0.0]
        return [*linear, *single_station_drifts, *warm_ups]

    def time_law_values(self, sightings: Sightings) -> Floats:
        """Factor (n,) by which the drift's parameter is multiplied in each of n pointings.

        For a linear function of time it is a time [s], for an exponential one it is dimensionless.
        """
        if self.law == "visit":
            return sightings.time_since_station_start
        time_since_start = sightings.time - recording_start_time(sightings)
        return time_since_start if self.law == "linear" else np.asarray(np.exp(-time_since_start / self.time_constant))

    def design(self, sightings: Sightings) -> Floats:
        drift_per_unit = self.pointing_indicator(sightings) * self.time_law_values(sightings)
        column: Floats = sightings.reading_change_by_error_key[self.chain_error_key] * drift_per_unit[:, None]
        return column[:, :, None]
