"""A third set of invented laws: memory, loads that act late, paths through the room, wear of the drives."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.geometry.polar import wrap
from ltsim.scene.sightings import Sightings

from .law import Law, level, share, turn

DOWN = np.array([0.0, 0.0, -1.0])


def _visits(s: Sightings) -> list[Ints]:
    """Rows of each station in the order of the work."""
    return [s.order[s.station[s.order] == station] for station in range(len(s.station_names))]


def _before(s: Sightings) -> Ints:
    """Row (n,) of the pointing before at the same station; a station's first one is its own."""
    before = np.arange(len(s))
    for rows in _visits(s):
        before[rows[1:]] = rows[:-1]
    return before


def _late(s: Sightings, values: Floats, constant: float) -> Floats:
    """Values (n,) as something slow follows them, with a time constant [s]."""
    late, order = values.copy(), s.order
    for last, row in pairwise(order):
        kept = np.exp(-(s.time[row] - s.time[last]) / constant)
        late[row] = kept * late[last] + (1.0 - kept) * values[row]
    return late


def _column(s: Sightings, name: str) -> Floats:
    return np.asarray(s.covariates.get(name, np.zeros(len(s))), dtype=np.float64)


def _tired(s: Sightings, u: Floats) -> Floats:
    """A receiver that strong returns have tired recovers slowly."""
    tired = np.zeros(len(s))
    for rows in _visits(s):
        since = s.time[rows][:, None] - s.time[rows]
        fresh = np.where(since > 0, np.exp(-np.maximum(since, 0.0) / (20.0 + 60.0 * u[0])), 0.0)
        tired[rows] = fresh @ s.range_[rows] ** -2.0
    return 4.0 * tired


def _weak(s: Sightings, u: Floats) -> Floats:
    """Echoes that slant and range have weakened beyond a threshold are timed late."""
    power = np.cos(np.nan_to_num(s.incidence)) ** (8.0 + 6.0 * u[0]) / s.range_**2
    return (power < np.quantile(power, 0.25 + 0.4 * u[1])).astype(np.float64)


def _curtain(s: Sightings, u: Floats) -> Floats:
    """A curtain of warm air across the room."""
    normal = level(u[0])
    place = float((s.position @ normal).mean()) + 0.8 * (u[1] - 0.5)
    through = (s.position[s.station] @ normal > place) != (s.points[s.target] @ normal > place)
    return through / np.maximum(np.abs(s.unit_vectors[0] @ normal), 0.2)


def _ringing(s: Sightings, u: Floats) -> Floats:
    """A heater's regulator overshoots after the set-up."""
    wave = np.cos(2 * np.pi * s.station_time / (120.0 + 240.0 * u[1]) + turn(u[2]))
    return np.exp(-s.station_time / (150.0 + 250.0 * u[0])) * wave


def _turnover(s: Sightings, u: Floats) -> Floats:
    """A quartz has its highest frequency at one temperature and is slower on either side."""
    air = _column(s, "air_temperature_c")
    return (air - air.min() - (0.4 + 0.2 * u[0]) * np.ptp(air)) ** 2 * s.range_ / 4.0


def _puddle(s: Sightings, u: Floats) -> Floats:
    """A second path by way of the shining floor."""
    floor = s.points[:, 2].min() - 0.1
    heights = s.position[s.station, 2] + s.points[s.target, 2] - 2 * floor
    detour = np.hypot(s.range_ * np.cos(s.elevation), heights) - s.range_
    return np.sin(2 * np.pi * detour / (1.2 + 1.4 * u[0]) + turn(u[1])) * s.range_ / (s.range_ + detour)


def _reversing(s: Sightings, u: Floats) -> Floats:
    """The gear has play only where the drive turns round, from one target to the next."""
    gives = np.zeros(len(s))
    for rows in _visits(s):
        last = 0.0
        for before, row in pairwise(rows):
            move = float(wrap(s.azimuth[row] - s.azimuth[before]))
            if s.target[row] == s.target[before]:
                gives[row] = gives[before]
                continue
            gives[row] = np.sign(move) if move * last < 0 else 0.0
            last = move
    return gives


def _latch(s: Sightings, u: Floats) -> Floats:
    """The level axle tips over at one direction, and back only well behind it."""
    tipped, gap, width = np.zeros(len(s)), wrap(s.raw[:, 1] - s.raw[int(u[0] * len(s)), 1]), 0.2 + 0.4 * u[1]
    for rows in _visits(s):
        state = 0.0
        for row in rows:
            state = state if abs(gap[row]) < width else float(gap[row] > 0)
            tipped[row] = state
    return tipped * np.tan(s.elevation)


def _warm_wall(s: Sightings, u: Floats) -> Floats:
    """A beam that ends close to a warm wall is bent off it, one way or the other."""
    normal = level(u[0])
    off = (s.points @ normal).max() - s.points[s.target] @ normal
    beam = s.unit_vectors[0]
    return (beam[:, 0] * normal[1] - beam[:, 1] * normal[0]) * s.range_ / 4.0 * np.exp(-off / (0.3 + 0.6 * u[1]))


def _running_down(s: Sightings, u: Floats) -> Floats:
    """A machine beside the station runs down, ever slower, and shakes it along one line."""
    return np.sin(turn((1.5 + 2.5 * u[0]) * np.log1p(s.station_time / 200.0))) * np.cos(s.azimuth - turn(u[1]))


def _belt(s: Sightings, u: Floats) -> Floats:
    """Teeth of a belt, felt where the scope's weight pulls at it."""
    return np.sin((10 + np.floor(8 * u[0])) * s.raw[:, 1] + turn(u[1])) * np.sin(s.elevation) ** 2 * 2.0


def _swing(s: Sightings, u: Floats) -> Floats:
    """The motors are warm after a long swing from one target to the next, and soon no warmer."""
    warm = np.zeros(len(s))
    for rows in _visits(s):
        for before, row in pairwise(rows):
            swing = np.arccos(np.clip(s.unit_vectors[0][row] @ s.unit_vectors[0][before], -1.0, 1.0))
            same = s.target[row] == s.target[before]
            warm[row] = warm[before] if same else 1.0 - np.exp(-((swing / (0.4 + 0.8 * u[0])) ** 2))
    return warm


def _slosh(s: Sightings, u: Floats) -> Floats:
    """The liquid of the level still swings from the last turn of the head."""
    before = _before(s)
    since, turned = s.time - s.time[before], np.abs(wrap(s.raw[:, 1] - s.raw[before, 1]))
    soon = since - since[since > 0].min(initial=np.inf)
    wave = np.cos(2 * np.pi * since / (12.0 + 12.0 * u[0]) + turn(u[1]))
    return np.where(since > 0, turned * wave * np.exp(-np.maximum(soon, 0.0) / 10.0), 0.0)


def _cold_core(s: Sightings, u: Floats) -> Floats:
    """The skin of the yoke follows the air, its core comes later."""
    air = _column(s, "air_temperature_c")
    return 4.0 * (air - _late(s, air, 900.0 + 1800.0 * u[0])) * np.cos(s.elevation)


def _door(s: Sightings, u: Floats) -> Floats:
    """Every time a door opens, warm air spreads before the targets beside it and thins out."""
    since = share(s)[:, None] - (np.arange(4) + u[:4]) / 4.0
    pulses = np.where(since > 0, np.exp(-np.maximum(since, 0.0) / (0.03 + 0.1 * u[4])), 0.0)
    return pulses.sum(axis=1) * s.range_ / 4.0


def _astigmatic(s: Sightings, u: Floats) -> Floats:
    """A slanting reflector returns an oval spot, whose long axis lies askew."""
    slant, way = np.nan_to_num(s.incidence), np.nan_to_num(s.incidence_direction)
    return 8.0 * np.sin(slant) ** 2 * np.sin(2 * way + turn(u[0])) / s.range_


def _crane(s: Sightings, u: Floats) -> Floats:
    """A crane travels to and fro, and the floor with all that stands on it dips below."""
    along = s.points @ level(u[0])
    path = np.abs(2.0 * ((share(s) * (1.3 + 2.0 * u[1]) + u[2]) % 1.0) - 1.0)
    gap = along[s.target] - along.min() - path * np.ptp(along)
    return np.exp(-((gap / (0.8 + 0.8 * u[3])) ** 2))[:, None] * DOWN


def _ratchet(s: Sightings, u: Floats) -> Floats:
    """A bracket sticks and slips in steps that become rarer or more frequent."""
    steps = 3.0 + np.floor(4 * u[2])
    return np.floor(steps * share(s) ** (0.5 + u[3]))[:, None] / steps * (level(u[0]) + (u[1] - 0.5) * DOWN)


def _rubber(s: Sightings, u: Floats) -> Floats:
    """A table on rubber feet sinks late under its load and pulls down what is fixed beside it."""
    load = _column(s, "table_load_kg")
    late = _late(s, load, 300.0 + 900.0 * u[0])
    off = np.linalg.norm(s.points - s.points[int(u[1] * len(s.points))], axis=1)
    return ((late - load.mean()) / 30.0 * np.exp(-off / 1.5)[s.target])[:, None] * DOWN


LAWS: dict[str, tuple[str, tuple[str, ...], Law]] = {
    "range after strong returns": ("distance", ("time", "distance"), _tired),
    "range by weakness of the return": ("distance", ("incidence", "distance"), _weak),
    "range through a curtain": ("distance", ("place",), _curtain),
    "range rings after the set-up": ("distance", ("time",), _ringing),
    "range by air on either side of a turning point": ("distance", ("temperature", "distance"), _turnover),
    "range by a path over the floor": ("distance", ("height", "distance"), _puddle),
    "range in teeth of a saw": (
        "distance",
        ("distance",),
        lambda s, u: 2.0 * ((s.range_ * (0.9 + 2.0 * u[0]) + u[1]) % 1.0) - 1.0,
    ),
    "azimuth where the drive turns round": ("azimuth", ("approach",), _reversing),
    "azimuth tips over and comes back late": ("azimuth", ("azimuth", "elevation", "approach"), _latch),
    "azimuth along a warm wall": ("azimuth", ("place", "distance"), _warm_wall),
    "azimuth swings ever slower": ("azimuth", ("time", "azimuth"), _running_down),
    "azimuth by teeth of a belt": ("azimuth", ("azimuth", "elevation"), _belt),
    "elevation by the length of the last swing": ("elevation", ("approach",), _swing),
    "elevation still swings": ("elevation", ("time", "approach"), _slosh),
    "elevation by late warmth": ("elevation", ("temperature", "elevation"), _cold_core),
    "elevation of neighbours after a door opens": ("elevation", ("time", "distance"), _door),
    "elevation by twice the direction of the slant": ("elevation", ("incidence", "distance"), _astigmatic),
    "targets dip as something passes": ("place", ("place", "time"), _crane),
    "neighbours move in steps": ("place", ("place", "time"), _ratchet),
    "targets sink late under a load": ("place", ("table_load_kg", "place"), _rubber),
}
AT_A_STATION = {"range rings after the set-up", "azimuth swings ever slower"}
OF_NEIGHBOURS = {"elevation of neighbours after a door opens", "neighbours move in steps"}
