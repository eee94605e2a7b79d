"""The first set of invented laws: periods, fields and steps that no effect of the catalogue has."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Floats
from ltsim.scene.sightings import Sightings

from .law import Law, turn

AT_A_STATION = {"range by squared height at a station"}
OF_NEIGHBOURS: set[str] = set()


def _period(s: Sightings, u: Floats) -> Floats:
    return np.sin(2 * np.pi * s.time / (400.0 * 8.0 ** u[0]) + turn(u[1]))


def _far(s: Sightings, u: Floats) -> Floats:
    return s.range_**2


def _faced(s: Sightings, u: Floats) -> Floats:
    return np.sin(s.elevation) * (s.face == 2) if (s.face == 2).any() else np.sin(3 * s.elevation)


def _dip(s: Sightings, u: Floats) -> Floats:
    gap = np.angle(np.exp(1j * (s.azimuth - turn(u[0]))))
    return np.exp(-((gap / (0.15 + 0.25 * u[1])) ** 2))


def _stop(s: Sightings, u: Floats) -> Floats:
    return (s.elevation > np.quantile(s.elevation, 0.3 + 0.4 * u[0])).astype(np.float64)


def _square(s: Sightings, u: Floats) -> Floats:
    return np.sign(np.sin((1 + np.floor(3 * u[0])) * s.azimuth + turn(u[1])))


def _load(s: Sightings, u: Floats) -> Floats:
    load = s.covariates.get("table_load_kg", np.zeros(len(s)))
    return (load / 40.0) ** 2


LAWS: dict[str, tuple[str, tuple[str, ...], Law]] = {
    "range by azimuth and elevation": (
        "distance",
        ("azimuth", "elevation"),
        lambda s, u: np.sin(2 * s.azimuth + turn(u[0])) * np.sin(2 * s.elevation),
    ),
    "elevation by squared range": ("elevation", ("distance",), _far),
    "range swings with time": ("distance", ("time",), _period),
    "elevation swings with time": ("elevation", ("time",), _period),
    "range by squared height at a station": (
        "distance",
        ("height", "place"),
        lambda s, u: (s.points[s.target, 2] - s.points[:, 2].mean()) ** 2,
    ),
    "range by elevation on one face": ("distance", ("elevation", "face"), _faced),
    "azimuth by range and elevation": (
        "azimuth",
        ("distance", "elevation"),
        lambda s, u: s.range_ * np.sin(2 * s.elevation) / np.cos(s.elevation),
    ),
    "azimuth dips in one direction": ("azimuth", ("azimuth",), _dip),
    "range by inverse squared range": ("distance", ("distance",), lambda s, u: s.range_**-2.0),
    "range by squared tangent of elevation": ("distance", ("elevation",), lambda s, u: np.tan(s.elevation) ** 2),
    "elevation by azimuth and elevation": (
        "elevation",
        ("azimuth", "elevation"),
        lambda s, u: np.sin(s.azimuth + turn(u[0])) * np.sin(2 * s.elevation),
    ),
    "range by place in the room": (
        "distance",
        ("place",),
        lambda s, u: np.sin(1.5 * s.points[s.target, 0] + turn(u[0])) * np.cos(s.points[s.target, 1] + turn(u[1])),
    ),
    "elevation steps at a stop": ("elevation", ("elevation",), _stop),
    "range jumps with azimuth": ("distance", ("azimuth",), _square),
    "azimuth by the load of a table": ("azimuth", ("table_load_kg",), _load),
    "targets sway with time": ("place", ("place", "time"), _period),
}
