"""Stations, targets and times at which an effect may act, determined from the pointings; base class of drifts."""

from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.effects.effect import Effect, Parameter, ShapeParameter
from ltsim.scene.sightings import Sightings

MAX_CHANGE_POINTS = 140
"""Largest number of candidate change points over all stations of a network."""
N_NEIGHBOUR_GAPS = 6
"""Number of gaps between pointings, on either side of a change point, to which a local search shifts the change."""


def candidate_change_times(times: Floats, *, min_pointings: int, max_n_times: int) -> list[float]:
    """Candidate change points [s]: midpoints of the gaps between n pointings at the times `times` (n,) [s].

    At least `min_pointings` pointings are on either side of a change point. At most `max_n_times` change points are
    returned, spread evenly over the measurement.
    """
    ordered = np.sort(times)
    middle, gap = 0.5 * (ordered[1:] + ordered[:-1]), np.diff(ordered)
    allowed_range = slice(min_pointings - 1, max(len(middle) - min_pointings + 1, min_pointings - 1))
    middles = middle[allowed_range][gap[allowed_range] > 0]
    if len(middles) > max_n_times:
        middles = middles[np.unique(np.linspace(0, len(middles) - 1, max_n_times).round().astype(int))]
    return [float(t) for t in middles]


def candidate_station_change_times(sightings: Sightings, *, min_pointings: int) -> list[tuple[str, float]]:
    """Candidate change points during the occupation of each station: pairs (station, time [s]).

    At least `min_pointings` pointings of the station are before and after each change point.
    """
    max_times = max(2, MAX_CHANGE_POINTS // max(len(sightings.station_names), 1))
    return [
        (name, time)
        for s, name in enumerate(sightings.station_names)
        for time in candidate_change_times(
            sightings.time[sightings.station == s], min_pointings=min_pointings, max_n_times=max_times
        )
    ]


def times_between_visits(sightings: Sightings, target_index: int, *, max_n_times: int) -> list[float]:
    """Candidate times [s] of a motion of a target: midpoints between its pointings from two successive stations.

    There are at most `max_n_times`. If only one station measured the target, they are midpoints between pointings of
    this station.
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


def neighbouring_gap_times(times: Floats, time: float) -> list[float]:
    """Midpoints [s] of the gaps between n pointings at `times` (n,) [s] that are near `time` [s].

    There are up to `N_NEIGHBOUR_GAPS` of these gaps before `time`, and as many after it.
    """
    ordered = np.unique(times)
    midpoints = 0.5 * (ordered[1:] + ordered[:-1])
    index = int(np.searchsorted(midpoints, time))
    return [float(t) for t in midpoints[max(index - N_NEIGHBOUR_GAPS, 0) : index + N_NEIGHBOUR_GAPS + 1]]


def station_target_pairs(sightings: Sightings) -> list[tuple[str, str]]:
    """Pairs (name of station, name of target) with at least one pointing."""
    index_pairs = np.unique(np.stack([sightings.station, sightings.target], axis=1), axis=0)
    return [(sightings.station_names[s], sightings.target_names[t]) for s, t in index_pairs]


def first_pointing_time(sightings: Sightings) -> float:
    """Time [s] of the first pointing of a recording."""
    return float(sightings.time.min(initial=np.inf))


TimeLaw = Literal["visit", "linear", "exponential"]
"""Name of the law of time of a drift, see `MotionDrift.law`."""

WARM_UP_TIME_CONSTANT_PARAMETER = ShapeParameter(
    "time_constant", "min", "time constant of the warm-up", 600.0, 14_400.0, has_logarithmic_grid=True, n_grid_values=6
)
"""Time constant of a warm-up, with the bounds [s] of a search for it."""


MAX_TIME_CONSTANT_RATIO = 2.0
"""Largest time constant of a warm-up that a search tries, divided by the duration of the measurement."""
SHORT_RECORDING_TIME_CONSTANT_FRACTIONS = (0.3, 1.0)
"""Time constants of warm-ups, divided by the duration of the measurement, that a search tries if all other time
constants exceed `MAX_TIME_CONSTANT_RATIO`."""


@dataclass(frozen=True)
class MotionDrift(Effect):
    """Base class of drifts: corrections of one motion of the kinematic chain that depend on time."""

    law: TimeLaw = "linear"
    """Law of time. ``visit``: rate times the time since the station's first pointing; ``linear``: rate times the time t
    since the recording's first pointing; ``exponential``: amplitude times exp(-t / time_constant).
    """
    time_constant: float = 3600.0
    """Time constant [s] of the exponential law."""

    covariates = ("time",)
    shape_parameters = (WARM_UP_TIME_CONSTANT_PARAMETER,)
    chain_error: ClassVar[str]
    """Key of the error of the kinematic chain that drifts, such as `azimuth`."""
    rate_parameter: ClassVar[Parameter]
    """Parameter of the laws of time that are linear (``visit`` and ``linear``): correction per time."""
    decay_amplitude_parameter: ClassVar[Parameter]
    """Parameter of the law ``exponential``: correction at the start."""
    candidate_laws_linear_in_time: ClassVar[tuple[TimeLaw, ...]]
    """Linear laws of time that a search tries at all stations together: ``visit`` (time since the station's first
    pointing) or ``linear`` (time since the recording's first pointing). With one station only the first law is tried.
    """
    tries_single_stations: ClassVar[bool] = False
    """True if a search also tries, at single stations, a drift in proportion to the time since the station's first
    pointing."""

    def __post_init__(self) -> None:
        parameter = self.decay_amplitude_parameter if self.law == "exponential" else self.rate_parameter
        object.__setattr__(self, "parameters", (parameter,))

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Drifts that a diagnosis tries: linear drifts at all stations or at one, and exponential warm-ups.

        Warm-ups with time constants far above the duration of the measurement are omitted, because they are constant or
        linear. In a recording without times, row numbers replace time.
        """
        span = float(np.ptp(sightings.time))
        times = [
            t for t in WARM_UP_TIME_CONSTANT_PARAMETER.grid_values().tolist() if t <= MAX_TIME_CONSTANT_RATIO * span
        ] or [share * span for share in SHORT_RECORDING_TIME_CONSTANT_FRACTIONS]
        names = sightings.station_names if len(sightings.station_names) > 1 else ()
        linear = [
            cls(law=law)
            for law in (cls.candidate_laws_linear_in_time if names else cls.candidate_laws_linear_in_time[:1])
        ]
        single_station_drifts = [cls((name,), law="visit") for name in names if cls.tries_single_stations]
        warm_ups = [cls(law="exponential", time_constant=t) for t in times if t > 0.0]
        return [*linear, *single_station_drifts, *warm_ups]

    def time_law_values(self, sightings: Sightings) -> Floats:
        """Factor (n,) of the drift's parameter at each of n pointings: a time [s], or dimensionless for a decay."""
        if self.law == "visit":
            return sightings.time_since_station_start
        time_since_start = sightings.time - first_pointing_time(sightings)
        return time_since_start if self.law == "linear" else np.asarray(np.exp(-time_since_start / self.time_constant))

    def design(self, sightings: Sightings) -> Floats:
        drift_per_unit = self.pointing_indicator(sightings) * self.time_law_values(sightings)
        column: Floats = sightings.reading_change_by_error_key[self.chain_error] * drift_per_unit[:, None]
        return column[:, :, None]
