"""Where and when an effect may act, read from a recording's pointings: change points, pairs of station and target."""

import numpy as np

from ltsim.arrays import Floats
from ltsim.scene.sightings import Sightings

MOST_CHANGES = 140
"""Change points tried over all stations of a network together."""


def change_times(times: Floats, *, least: int, most: int) -> list[float]:
    """Middles of the gaps between pointings at `times` [s] with `least` pointings on either side.

    At most `most` of them, spread evenly over the work.
    """
    ordered = np.sort(times)
    middle, gap = 0.5 * (ordered[1:] + ordered[:-1]), np.diff(ordered)
    inner = slice(least - 1, max(len(middle) - least + 1, least - 1))
    found = middle[inner][gap[inner] > 0]
    if len(found) > most:
        found = found[np.unique(np.linspace(0, len(found) - 1, most).round().astype(int))]
    return [float(t) for t in found]


def station_change_times(sightings: Sightings, *, least: int) -> list[tuple[str, float]]:
    """(station, time [s]) of every change point inside a station's visit that is worth a trial."""
    most = max(2, MOST_CHANGES // max(len(sightings.station_names), 1))
    return [
        (name, time)
        for s, name in enumerate(sightings.station_names)
        for time in change_times(sightings.time[sightings.station == s], least=least, most=most)
    ]


def visit_change_times(sightings: Sightings, target: int, *, most: int) -> list[float]:
    """Times [s] between two visits to a target from different stations; between all pointings if only one sees it."""
    rows = sightings.order[sightings.target[sightings.order] == target]
    times, stations = sightings.time[rows], sightings.station[rows]
    if len(np.unique(stations)) < 2:
        return change_times(times, least=2, most=most)
    moved = np.flatnonzero(np.diff(stations))
    middles = 0.5 * (times[moved] + times[moved + 1])
    if len(middles) > most:
        middles = middles[np.linspace(0, len(middles) - 1, most).round().astype(int)]
    return [float(t) for t in np.unique(middles)]


def gaps_near(times: Floats, time: float, *, reach: int = 6) -> list[float]:
    """Middles [s] of the `reach` gaps between pointings at `times` on either side of `time`."""
    ordered = np.unique(times)
    middle = 0.5 * (ordered[1:] + ordered[:-1])
    at = int(np.searchsorted(middle, time))
    return [float(t) for t in middle[max(at - reach, 0) : at + reach + 1]]


def visited_pairs(sightings: Sightings) -> list[tuple[str, str]]:
    """(station, target) of every pair with a pointing."""
    pairs = np.unique(np.stack([sightings.station, sightings.target], axis=1), axis=0)
    return [(sightings.station_names[s], sightings.target_names[t]) for s, t in pairs]


def start_time(sightings: Sightings) -> float:
    """Time [s] of the first pointing."""
    return float(sightings.time.min(initial=np.inf))
