"""Laws for tuning, by somebody who knows the search: stands, targets and constants of the instrument that vary."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Floats
from ltsim.scene.sightings import Sightings

from .law import Law, Words, level, share, turn

UP = np.array([0.0, 0.0, 1.0])
TURNS = ("azimuth", "elevation")


def _swing(s: Sightings, name: str) -> Floats:
    """A column (n,) about its mean in units of its own spread; 0 where the recording lacks it."""
    column = np.asarray(s.covariates.get(name, np.zeros(len(s))), dtype=np.float64)
    return (column - column.mean()) / max(float(column.std()), 1e-12)


def _load(s: Sightings) -> Floats:
    return _swing(s, "table_load_kg")


def _turned(s: Sightings, axis: Floats, amount: Floats) -> Floats:
    """Displacement (n, 3) [m/rad] of what a stand that turns about an axis by an amount (n,) sees."""
    return np.cross(s.arm, axis) * amount[:, None] / 4.0


def _late(s: Sightings, u: float) -> Floats:
    """Share (n,) of a motion that comes to rest after each set-up."""
    return 1.0 - np.exp(-s.station_time / (150.0 + 500.0 * u))


def _lean_with_load(s: Sightings, u: Floats) -> Floats:
    return _turned(s, level(u[0]), _load(s))


def _rocking(s: Sightings, u: Floats) -> Floats:
    return _turned(s, level(u[0]), np.sin(turn((1.5 + 2.0 * u[1]) * share(s) * 4 + u[2])))


def _lean_everywhere(s: Sightings, u: Floats) -> Floats:
    return _turned(s, level(u[0]), _late(s, u[1]))


def _creep(s: Sightings, u: Floats) -> Floats:
    return np.sqrt(s.station_time / 600.0)[:, None] * level(u[0])


def _sinks(s: Sightings, u: Floats) -> Floats:
    return np.log1p(s.station_time / (100.0 + 200.0 * u[0]))[:, None] * UP


def _kicked(s: Sightings, u: Floats) -> Floats:
    """Halfway through a visit the stand is pushed aside, and turns with it."""
    long = s.station_time > np.quantile(s.station_time, 0.3 + 0.4 * u[0])
    return level(u[1]) * long[:, None]


def _bend(s: Sightings, u: Floats) -> Floats:
    """A beam that carries the targets bows as the day goes on."""
    along = s.points @ level(u[0])
    along = (along - along.mean()) / np.ptp(along) * 2
    return ((along**2)[s.target] * share(s))[:, None] * UP


def _wall(s: Sightings, u: Floats) -> Floats:
    """A wall leans with the load on a table beside it."""
    way = level(u[0])
    off = s.points @ way
    near = off > np.quantile(off, 0.6)
    return (near[s.target] * _load(s) * (s.points[s.target, 2] - s.points[:, 2].min()) / 4.0)[:, None] * way


def _nests(s: Sightings, u: Floats) -> Floats:
    """Adaptors of plastic grow with the air's temperature."""
    return _swing(s, "air_temperature_c")[:, None] * np.nan_to_num(s.nest_normal[s.target])


def _group_sways(s: Sightings, u: Floats) -> Floats:
    return np.sin(turn((2.0 + 3.0 * u[0]) * share(s) + u[1]))[:, None] * level(u[2])


def _jumps(s: Sightings, u: Floats) -> Floats:
    """Index of the vertical circle: jumps at three times."""
    state = sum(np.sign(k - 1.5) * (1 + k / 3) * (share(s) > u[k]) for k in range(4))
    return s.face_sign * state / 2.0


def _walk(s: Sightings, u: Floats) -> Floats:
    """The azimuth of a visit wanders."""
    steps = np.random.default_rng(int(1e6 * u[0])).standard_normal(len(s))
    walk = np.zeros(len(s))
    walk[s.order] = np.cumsum(steps)
    return (walk - walk.mean()) / walk.std()


LAWS: dict[str, tuple[str, tuple[str, ...], Law]] = {
    "stand leans with a load": ("place", ("table_load_kg",), _lean_with_load),
    "stand rocks": ("place", ("time",), _rocking),
    "stands lean after each set-up": ("place", ("time",), _lean_everywhere),
    "stand creeps aside": ("place", ("time",), _creep),
    "stands sink ever slower": ("place", ("time",), _sinks),
    "stands give way at once": ("place", ("time",), _kicked),
    "targets bow": ("place", ("time", "place"), _bend),
    "wall leans with a load": ("place", ("table_load_kg", "place"), _wall),
    "nests grow with the air": ("place", ("temperature",), _nests),
    "neighbours sway": ("place", ("time",), _group_sways),
    "index jumps": ("elevation", ("time",), _jumps),
    "index by load": ("elevation", ("table_load_kg",), lambda s, u: s.face_sign * _load(s)),
    "lateral beam offset by air": ("azimuth", ("temperature",), lambda s, u: _swing(s, "air_temperature_c") / s.range_),
    "transit tilt runs away": ("azimuth", ("time",), lambda s, u: s.face_sign * np.tan(s.elevation) * share(s) ** 2),
    "azimuth wanders": ("azimuth", ("time",), _walk),
    "range offset settles": ("distance", ("time",), lambda s, u: np.sqrt(s.station_time / 600.0)),
    "range by elevation and load": (
        "distance",
        ("elevation", "table_load_kg"),
        lambda s, u: np.sin(s.elevation) * _load(s),
    ),
    "elevation by nearness": ("elevation", ("distance",), lambda s, u: 2.0 / s.range_),
}
WORDS = {
    "stand leans with a load": Words("stand", "table_load_kg", "one station", TURNS),
    "stand rocks": Words("stand", "time", "one station", TURNS),
    "stands lean after each set-up": Words("stand", "time", "", TURNS),
    "stand creeps aside": Words("stand", "time", "one station"),
    "stands sink ever slower": Words("stand", "time"),
    "stands give way at once": Words("stand", "time"),
    "targets bow": Words("targets", "time"),
    "wall leans with a load": Words("targets", "table_load_kg", "a group"),
    "nests grow with the air": Words("targets", "temperature"),
    "neighbours sway": Words("targets", "time", "a group"),
}
AT_A_STATION = {"stand leans with a load", "stand rocks", "stand creeps aside"}
OF_NEIGHBOURS = {"neighbours sway"}
