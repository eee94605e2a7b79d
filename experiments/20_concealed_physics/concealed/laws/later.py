"""A second set of invented laws, made after the first had been looked at: for examinations of what nobody has seen."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Bools, Floats
from ltsim.scene.sightings import Sightings
from ltsim.units import DEGREE

from .law import Law, hours, turn


def _duration(s: Sightings) -> float:
    return float(np.ptp(s.time)) / 3600.0


def _ramp(values: Floats, low: float) -> Floats:
    return np.maximum(values - np.quantile(values, low), 0.0)


def _heights(s: Sightings) -> Floats:
    return s.points[s.target, 2]


def _direction(u: Floats) -> Floats:
    """A unit vector (3,), rather level than steep."""
    way = np.array([np.cos(turn(u[0])), np.sin(turn(u[0])), u[1] - 0.5])
    return np.asarray(way / np.linalg.norm(way))


def _is_fixed(s: Sightings) -> Bools:
    return np.asarray(~s.reaimed[s.target])


def _leaning_floor(s: Sightings, u: Floats) -> Floats:
    """A loaded table tips the floor under all stations, each its own way as it is turned."""
    load = s.covariates.get("table_load_kg", np.zeros(len(s)))
    return (load - load.mean()) / 30.0 * np.sin(s.azimuth + turn(u[0]))


def _warm_yoke(s: Sightings, u: Floats) -> Floats:
    """The two sides of the yoke follow the air unequally."""
    air = s.covariates.get("air_temperature_c", np.zeros(len(s)))
    return (air - air[0]) * np.sin(2 * s.elevation)


def _switching(s: Sightings, u: Floats) -> Floats:
    """A machine that runs for part of every cycle."""
    cycle = 0.25 * 4.0 ** u[0]
    return ((hours(s) / cycle + u[1]) % 1.0 < 0.25 + 0.5 * u[2]).astype(np.float64)


def _clipped(s: Sightings, u: Floats) -> Floats:
    """The rim of the nest cuts off one side of a slanting beam."""
    beyond = _ramp(s.incidence, 0.3 + 0.3 * u[0]) * np.sign(np.cos(s.incidence_direction))
    return beyond * 10.0 / (s.range_ * np.cos(s.elevation))


def _echo(s: Sightings, u: Floats) -> Floats:
    """A second path over a surface: the detour falls with the inverse distance."""
    return np.sin(2 * np.pi * (3.0 + 6.0 * u[0]) / s.range_ + turn(u[1]))


def _gain(s: Sightings, u: Floats) -> Floats:
    """The receiver changes to another amplification."""
    return (s.range_ > np.quantile(s.range_, 0.35 + 0.4 * u[0])).astype(np.float64)


def _oil(s: Sightings, u: Floats) -> Floats:
    """A loose ring creeps round under the head."""
    return np.sin(s.azimuth - turn(hours(s) / (0.8 + 2.0 * u[0]) + u[1]))


def _creep(s: Sightings, u: Floats) -> Floats:
    """A panel creeps and springs back."""
    cycle = _duration(s) / (1.3 + 2.5 * u[2])
    return ((hours(s) / cycle + u[3]) % 1.0)[:, None] * _direction(u)


def _ladder(s: Sightings, u: Floats) -> Floats:
    """From some hour on another person seats the reflectors, and has to reach for the high ones."""
    later = hours(s) > (0.25 + 0.5 * u[2]) * _duration(s)
    return (later * np.maximum(_heights(s) - np.median(s.points[:, 2]), 0.0))[:, None] * _direction(u) / 3.0


def _foreign(s: Sightings, u: Floats) -> Floats:
    """Reflectors of another make, whose coating minds the slant of the beam."""
    return _is_fixed(s) * np.sin(s.incidence / (8.0 * DEGREE) + turn(u[0]))


LAWS: dict[str, tuple[str, tuple[str, ...], Law]] = {
    "elevation by load and azimuth": ("elevation", ("table_load_kg", "azimuth"), _leaning_floor),
    "elevation by air and elevation": ("elevation", ("temperature", "elevation"), _warm_yoke),
    "range by approach": ("distance", ("approach",), lambda s, u: s.approach[:, 0]),
    "azimuth by approach of the other axis": (
        "azimuth",
        ("approach", "elevation"),
        lambda s, u: s.approach[:, 1] * np.sin(s.elevation),
    ),
    "azimuth switches on and off": ("azimuth", ("time",), _switching),
    "azimuth by slant and range": ("azimuth", ("incidence", "distance"), _clipped),
    "elevation in stripes of height": (
        "elevation",
        ("height",),
        lambda s, u: np.sin(2 * np.pi * _heights(s) / (1.6 + 1.6 * u[0]) + turn(u[1])),
    ),
    "range ripples closer when near": ("distance", ("distance",), _echo),
    "range steps with range": ("distance", ("distance",), _gain),
    "azimuth of the faces parts with time": (
        "azimuth",
        ("time", "face"),
        lambda s, u: (s.face == 2) * np.sqrt(hours(s)) if (s.face == 2).any() else np.zeros(len(s)),
    ),
    "elevation by azimuth that turns with time": ("elevation", ("azimuth", "time"), _oil),
    "elevation by three feet": (
        "elevation",
        ("azimuth",),
        lambda s, u: np.sin(3 * s.azimuth + turn(u[0])),
    ),
    "range beyond an elevation": (
        "distance",
        ("elevation",),
        lambda s, u: _ramp(s.elevation, 0.3 + 0.4 * u[0]),
    ),
    "neighbours creep and spring back": ("place", ("place", "time"), _creep),
    "high targets sit otherwise later": ("place", ("height", "time"), _ladder),
    "range of some reflectors by slant": ("distance", ("incidence", "place"), _foreign),
}
AT_A_STATION = {"elevation by three feet", "range beyond an elevation"}
OF_NEIGHBOURS = {"neighbours creep and spring back", "range of some reflectors by slant"}
