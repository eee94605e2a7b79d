"""A fifth set of invented laws: stands, wear, the order of the work, moving air, lists that slipped, chance."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.geometry.polar import wrap
from ltsim.scene.sightings import Sightings
from ltsim.units import DEGREE

from .law import Law, Words, hours, level, share, turn

UP = np.array([0.0, 0.0, 1.0])


def _visits(s: Sightings) -> list[Ints]:
    """Rows of each station in the order of the work."""
    return [s.order[s.station[s.order] == station] for station in range(len(s.station_names))]


def _chance(u: float) -> np.random.Generator:
    """Dice that fall the same way whenever a law with this constant is asked."""
    return np.random.default_rng(int(1e9 * u))


def _air(s: Sightings) -> Floats:
    """Temperature (n,) [K] about its mean; 0 where the recording lacks it."""
    air = np.asarray(s.covariates.get("air_temperature_c", np.zeros(len(s))), dtype=np.float64)
    return (air - air.mean()) * bool(np.ptp(air) > 0.0)


def _along(s: Sightings, way: Floats) -> Floats:
    """Coordinate (T,) of the targets along a level direction, 0 to 1 over the room."""
    along = s.points @ way
    return np.asarray((along - along.min()) / np.ptp(along))


def _lean(s: Sightings, axis: Floats) -> Floats:
    """Displacement (n, 3) as seen from a stand that leans about `axis` (n, 3), per 1/3 rad."""
    return np.cross(axis, s.arm) / 3.0


def _squared_field(s: Sightings, u: Floats) -> Floats:
    """A magnetic field from the hall's rails pulls the laser's frequency by the square of its part along the tube.

    The tube turns with the head; even in the field, so that forward and backward count alike.
    """
    return s.range_ * (s.unit_vectors[0] @ level(u[0])) ** 2 / 4.0


def _homing(s: Sightings, u: Floats) -> Floats:
    """The zero of the range creeps, and is set again in the bird bath after every so many pointings."""
    every, since = 7 + int(9 * u[0]), np.zeros(len(s))
    for rows in _visits(s):
        home = rows[np.arange(len(rows)) // every * every]
        since[rows] = s.time[rows] - s.time[home]
    return since / 150.0


def _rest(s: Sightings, u: Floats) -> Floats:
    """After a swing the gain of the receiver is still coming down; who waits longer reads less wrong."""
    lapse = np.where(s.previous >= 0, s.time - s.time[s.previous], np.inf)
    return np.exp(-np.maximum(lapse - 10.0, 0.0) / (2.0 + 4.0 * u[0]))


def _front(s: Sightings, u: Floats) -> Floats:
    """Cold air comes in by a gate; its steep front walks across the hall, and beams are longer or shorter behind it."""
    way = level(u[0])
    near, far = (s.position @ way)[s.station], (s.points @ way)[s.target]
    walked = np.minimum(share(s) / (0.5 + 0.5 * u[1]), 1.0)
    high, low = float((s.points @ way).max()), float((s.points @ way).min())
    edge = high - (high - low) * walked
    gone = np.where(np.abs(far - near) > 1e-6, far - near, 1e-6)
    return s.range_ * (np.maximum(far - edge, 0.0) - np.maximum(near - edge, 0.0)) / gone / 4.0


def _buffered(s: Sightings, u: Floats) -> Floats:
    """The program takes the correction for air from the range that is still in its buffer, the one before."""
    return np.where(s.previous >= 0, s.range_ - s.range_[s.previous], 0.0) / 4.0


def _swollen_glue(s: Sightings, u: Floats) -> Floats:
    """Glue behind the mirrors of reflectors that are left in their nests swells; slanting beams feel it."""
    slant = np.sin(np.nan_to_num(s.incidence)) ** 2
    return 4.0 * share(s) ** (0.6 + 0.8 * u[0]) * slant * ~s.reaimed[s.target]


def _slipped_list(s: Sightings, u: Floats) -> Floats:
    """Two kinds of adaptors; from some set-up on, every target is given the constant of the next line of the list."""
    thick = (_chance(u[0]).random(len(s.points)) < 0.5).astype(np.float64)
    wrong = np.roll(thick, -1) - thick
    first = 1 + int(u[1] * (len(s.station_names) - 1))
    return wrong[s.target] * (s.station >= first)


def _half_done(s: Sightings, u: Floats) -> Floats:
    """The thickness of some adaptors was put into the list of the front face only."""
    return (s.face == 2).astype(np.float64)


def _yielding(s: Sightings, u: Floats) -> Floats:
    """Rubber feet yield to the torque of every swing of the head and creep back: swings add up, old ones fade."""
    twist, constant = np.zeros(len(s)), 40.0 + 120.0 * u[0]
    for row in s.order:
        before = s.previous[row]
        if before >= 0:
            swing = float(wrap(s.azimuth[row] - s.azimuth[before]))
            twist[row] = twist[before] * np.exp(-(s.time[row] - s.time[before]) / constant) + swing / np.pi
    return twist


def _slipping_clamp(s: Sightings, u: Floats) -> Floats:
    """The clamp of one tripod's head holds badly, and the head wanders in its thread as people walk by."""
    walk, dice = np.zeros(len(s)), _chance(u[0])
    for rows in _visits(s):
        steps = np.sqrt(np.diff(s.time[rows], prepend=s.time[rows[:1]]) / 200.0)
        walk[rows] = np.cumsum(steps * dice.standard_normal(len(rows)))
    return walk


def _moved_circle(s: Sightings, u: Floats) -> Floats:
    """At a knock the azimuth circle slips on its hub and is off its centre another way from then on."""
    return (share(s) > 0.3 + 0.4 * u[0]) * np.cos(s.raw[:, 1] - turn(u[1]))


def _carried(s: Sightings, u: Floats) -> Floats:
    """One bearing of the transit axis gives a little each time the tracker is carried on: the axis tilts by set-ups."""
    begun = [s.time[rows].min() if len(rows) else np.inf for rows in _visits(s)]
    number = np.argsort(np.argsort(begun))
    return s.face_sign * np.tan(s.elevation) * (number[s.station] / max(len(begun) - 1.0, 1.0)) ** (0.7 + 0.6 * u[0])


def _sinking_carriage(s: Sightings, u: Floats) -> Floats:
    """The carriage of the beam's last lens was jerked in carrying; it sinks back after every set-up."""
    return 2.0 * s.face_sign / s.range_ * np.exp(-s.station_time / (150.0 + 350.0 * u[0]))


def _smudge(s: Sightings, u: Floats) -> Floats:
    """A fingerprint on the elevation circle: lines before it are read too early, lines behind it too late."""
    width = (4.0 + 5.0 * u[1]) * DEGREE
    off = (s.raw[:, 2] - s.raw[int(u[0] * len(s)), 2]) / width + 2.0 * u[2] - 1.0
    return off * np.exp(0.5 - 0.5 * off**2)


def _hot_strip(s: Sightings, u: Floats) -> Floats:
    """A heating pipe glows under a strip of the floor; low beams that cross the strip are bent.

    The sum over the way of the beam of the air's warmth, which falls off with height, weighted by the way that is left.
    """
    across, part = level(u[0]), (np.arange(24) + 0.5) / 24
    way = s.position[s.station][:, None, :] + part[None, :, None] * s.arm[:, None, :]
    beside = (way - s.points.mean(axis=0)) @ across - 2.0 * (u[1] - 0.5)
    height = way[:, :, 2] - s.points[:, 2].min()
    warm = np.exp(-((beside / 0.7) ** 2) - height / (0.5 + 0.7 * u[2]))
    return 3.0 * s.range_ * np.cos(s.elevation) * (warm * (1.0 - part)).mean(axis=1)


def _sunny_leg(s: Sightings, u: Floats) -> Floats:
    """The leg on the sunny side grows from the set-up on, and the sunny side goes round with the clock."""
    sun = turn(u[0]) - 15.0 * DEGREE * hours(s)
    grown = 1.0 - np.exp(-s.station_time / (250.0 + 650.0 * u[1]))
    return _lean(s, grown[:, None] * np.stack([-np.sin(sun), np.cos(sun), 0.0 * sun], axis=1))


def _gantry(s: Sightings, u: Floats) -> Floats:
    """A gantry goes to and fro, waits at either end, and tips the floor, more near its rails."""
    beat = 2.0 / np.pi * np.arcsin(np.sin(2 * np.pi * s.time / (500.0 + 1000.0 * u[0]) + turn(u[1])))
    rails, middle = level(u[2]), s.points[int(u[3] * len(s.points))]
    off = np.abs((s.position - middle) @ np.cross(UP, rails))
    tip = np.clip(1.8 * beat, -1.0, 1.0) * np.exp(-off / 2.5)[s.station]
    return _lean(s, tip[:, None] * rails)


def _jolts(s: Sightings, u: Floats) -> Floats:
    """A forging hammer beside the hall: with each blow, weak or strong, the feet of the stand sink a little."""
    dice, end = _chance(u[0]), float(s.time.max() - s.time.min())
    blows = np.sort(dice.uniform(0.0, end, int(end / (80.0 + 150.0 * u[1])) + 1))
    deep = np.concatenate([[0.0], np.cumsum(dice.exponential(0.5, len(blows)))])
    since = s.time - s.time.min()
    sunk = deep[np.searchsorted(blows, since)] - deep[np.searchsorted(blows, since - s.station_time)]
    return sunk[:, None] * UP


def _still_air(s: Sightings, u: Floats) -> Floats:
    """For some time the fans stand: warm air rises, beams bend and ranges change together, until the fans run again.

    A uniform gradient G and the weather sensor at the head: half of G times the squared range, up by the cosine of
    the elevation and inward by its sine.
    """
    off = (share(s) - 0.1 - 0.35 * u[0]) / 0.12
    back = off - (2.0 + 2.0 * u[1])
    gradient = (off > 0) * -np.expm1(-np.maximum(off, 0.0)) * np.exp(-3.0 * np.maximum(back, 0.0))
    beam, _, up = s.unit_vectors
    bent = np.cos(s.elevation)[:, None] * up - np.sin(s.elevation)[:, None] * beam
    return (gradient * s.range_**2 / 8.0)[:, None] * bent


def _bowed_girder(s: Sightings, u: Floats) -> Floats:
    """Through a gap of the clouds the sun warms one side of the girders, which bow and come straight again."""
    way = level(u[0])
    place = _along(s, way)
    bow = 4.0 * place * (1.0 - place) * (s.points[:, 2] - s.points[:, 2].min()) / 6.0
    gap = np.exp(-(((share(s) - 0.25 - 0.5 * u[1]) / (0.12 + 0.15 * u[2])) ** 2))
    return (gap * bow[s.target])[:, None] * np.cross(UP, way)


def _leaf(s: Sightings, u: Floats) -> Floats:
    """A part of the wall is the leaf of a gate: shut, then pushed open, later drawn half to; it turns on its hinge."""
    way, when = level(u[0]), share(s)
    arm = np.maximum(_along(s, way) - 0.45 - 0.15 * u[1], 0.0)
    angle = 2.0 * (when > 0.2 + 0.2 * u[2]) - 1.0 * (when > 0.55 + 0.25 * u[3])
    return (angle * arm[s.target])[:, None] * np.cross(UP, way)


def _notches(s: Sightings, u: Floats) -> Floats:
    """One ball is carried from nest to nest and turned by a notch each time; its vertex lies beside its centre."""
    seated = np.zeros(len(s))
    for rows in _visits(s):
        seated[rows] = np.cumsum(np.diff(s.target[rows], prepend=-1) != 0)
    roll = seated * (35.0 + 60.0 * u[0]) * DEGREE + turn(u[1])
    _, left, up = s.unit_vectors
    return np.cos(roll)[:, None] * left + np.sin(roll)[:, None] * up


def _worn_nests(s: Sightings, u: Floats) -> Floats:
    """Soft seats of some new nests are pressed in each time the ball is put back, at first more than later."""
    times: Ints = np.zeros(len(s), dtype=np.int64)
    for target in range(len(s.points)):
        rows = s.order[s.target[s.order] == target]
        other = np.diff(s.station[rows], prepend=-1) | np.diff(s.repeat[rows], prepend=-1)
        times[rows] = np.cumsum(other != 0)
    depth = 1.5 * np.exp(-times / (1.0 + 3.0 * u[0]))
    return depth[:, None] * np.nan_to_num(s.nest_normal[s.target])


def _warm_fork(s: Sightings, u: Floats) -> Floats:
    """The fork grows askew with the air, and the transit axis moves away from the standing axis."""
    beam = s.unit_vectors[0]
    forward = (beam - (beam @ UP)[:, None] * UP) / np.cos(s.elevation)[:, None]
    return (s.face_sign * _air(s) / 0.5)[:, None] * forward


LAWS: dict[str, tuple[str, tuple[str, ...], Law]] = {
    "range by the square of a field": ("distance", ("azimuth", "distance"), _squared_field),
    "range from homing to homing": ("distance", ("time",), _homing),
    "range by the rest before the reading": ("distance", ("time", "approach"), _rest),
    "range behind a front that walks": ("distance", ("place", "time"), _front),
    "range by the range before": ("distance", ("distance", "approach"), _buffered),
    "range by slant, more and more": ("distance", ("incidence", "time"), _swollen_glue),
    "range by a list that slipped": ("distance", ("place", "time"), _slipped_list),
    "range by adaptors on one face": ("distance", ("face", "place"), _half_done),
    "azimuth as the stand yields": ("azimuth", ("approach", "time"), _yielding),
    "azimuth wanders at a station": ("azimuth", ("time",), _slipping_clamp),
    "azimuth by a circle that slipped": ("azimuth", ("azimuth", "time"), _moved_circle),
    "azimuth by the number of set-ups": ("azimuth", ("elevation", "time", "face"), _carried),
    "elevation by a carriage that sinks": ("elevation", ("distance", "time", "face"), _sinking_carriage),
    "elevation over a smudge": ("elevation", ("elevation",), _smudge),
    "elevation over a hot strip": ("elevation", ("place",), _hot_strip),
    "stands lean after the sun": ("place", ("time",), _sunny_leg),
    "stands lean as a gantry goes": ("place", ("time",), _gantry),
    "stands sink in jolts": ("place", ("time",), _jolts),
    "light bends while fans stand": ("place", ("time", "height", "distance"), _still_air),
    "girders bow for a while": ("place", ("place", "time"), _bowed_girder),
    "a leaf turns on its hinge": ("place", ("place", "time"), _leaf),
    "a ball is turned by notches": ("place", ("time",), _notches),
    "nests wear by seatings": ("place", ("time", "place"), _worn_nests),
    "axes part with the air": ("place", ("temperature", "face"), _warm_fork),
}
AT_A_STATION = {"azimuth wanders at a station"}
OF_NEIGHBOURS = {"range by adaptors on one face", "nests wear by seatings"}

ANGLES = ("azimuth", "elevation")
RISE = ("distance", "elevation")
ALL_THREE = ("distance", "azimuth", "elevation")
NEAR, HIGHER = "everywhere, near stands more", "everywhere, high targets more"
WORDS: dict[str, Words] = {
    "range by the square of a field": Words("range scale", "squared cosine of the beam's bearing"),
    "range from homing to homing": Words("range zero", "ramp since the last homing, every so many pointings"),
    "range by the rest before the reading": Words("range zero", "decay since the pointing before"),
    "range behind a front that walks": Words("air's index on a part of the path", "place, moving with time"),
    "range by the range before": Words("range reading", "range of the pointing before less the own one"),
    "range by slant, more and more": Words("reflector constant", "incidence times growing time"),
    "range by a list that slipped": Words("reflector constants", "target by target", "later set-ups"),
    "range by adaptors on one face": Words("reflector constant", "face", "neighbouring targets"),
    "azimuth as the stand yields": Words("turn of the station about the vertical", "fading sum of the moves"),
    "azimuth wanders at a station": Words("turn of the station about the vertical", "random walk", "one station"),
    "azimuth by a circle that slipped": Words("azimuth eccentricity", "step in time"),
    "azimuth by the number of set-ups": Words("transit tilt", "growth with the number of the set-up"),
    "elevation by a carriage that sinks": Words("vertical beam offset", "decay since the set-up"),
    "elevation over a smudge": Words("elevation reading", "a window of the elevation circle"),
    "elevation over a hot strip": Words("elevation reading, bending of the light", "place of the beam"),
    "stands lean after the sun": Words("lean of the station", "growth since the set-up, time", "", ANGLES),
    "stands lean as a gantry goes": Words("lean of the station", "wave in time with rests", NEAR, ANGLES),
    "stands sink in jolts": Words("height of the station", "random steps in time since the set-up", "", RISE),
    "light bends while fans stand": Words("gradient of the air", "window of the clock", "", RISE),
    "girders bow for a while": Words("bow of the targets", "bell in time", HIGHER, ALL_THREE),
    "a leaf turns on its hinge": Words("turn of a group of targets", "two steps in time", "one side", ALL_THREE),
    "a ball is turned by notches": Words("reflector's centring", "wave in the number of seatings", "", ANGLES),
    "nests wear by seatings": Words(
        "target along its nest's normal", "decay with the number of its seatings", "neighbouring targets", ALL_THREE
    ),
    "axes part with the air": Words("transit offset", "air temperature", "", RISE),
}
