"""Physics that is in no catalogue, invented for this examination; nothing in ltsim knows of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from concealed.invented_last import LAST, LAST_AT_A_STATION, LAST_OF_NEIGHBOURS
from concealed.invented_later import LATER, LATER_AT_A_STATION, LATER_OF_NEIGHBOURS
from concealed.invented_latest import LATEST, LATEST_AT_A_STATION, LATEST_OF_NEIGHBOURS
from concealed.law import Law
from ltsim.arrays import Floats
from ltsim.effects.effect import Effect, Parameter, Stage, by_displacement, on_readings
from ltsim.scene.sightings import Sightings
from ltsim.units import MICROMETRE, MICRORADIAN

Laws = Literal["first", "later", "latest", "last", "all"]
"""Which of the invented laws are drawn."""


def _turn(u: float) -> float:
    return 2 * np.pi * u


def _period(s: Sightings, u: Floats) -> Floats:
    return np.sin(2 * np.pi * s.time / (400.0 * 8.0 ** u[0]) + _turn(u[1]))


def _far(s: Sightings, u: Floats) -> Floats:
    return s.range_**2


def _faced(s: Sightings, u: Floats) -> Floats:
    return np.sin(s.elevation) * (s.face == 2) if (s.face == 2).any() else np.sin(3 * s.elevation)


def _dip(s: Sightings, u: Floats) -> Floats:
    gap = np.angle(np.exp(1j * (s.azimuth - _turn(u[0]))))
    return np.exp(-((gap / (0.15 + 0.25 * u[1])) ** 2))


def _stop(s: Sightings, u: Floats) -> Floats:
    return (s.elevation > np.quantile(s.elevation, 0.3 + 0.4 * u[0])).astype(np.float64)


def _square(s: Sightings, u: Floats) -> Floats:
    return np.sign(np.sin((1 + np.floor(3 * u[0])) * s.azimuth + _turn(u[1])))


def _load(s: Sightings, u: Floats) -> Floats:
    load = s.covariates.get("table_load_kg", np.zeros(len(s)))
    return (load / 40.0) ** 2


LAWS: dict[str, tuple[str, tuple[str, ...], Law]] = {
    "range by azimuth and elevation": (
        "distance",
        ("azimuth", "elevation"),
        lambda s, u: np.sin(2 * s.azimuth + _turn(u[0])) * np.sin(2 * s.elevation),
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
        lambda s, u: np.sin(s.azimuth + _turn(u[0])) * np.sin(2 * s.elevation),
    ),
    "range by place in the room": (
        "distance",
        ("place",),
        lambda s, u: np.sin(1.5 * s.points[s.target, 0] + _turn(u[0])) * np.cos(s.points[s.target, 1] + _turn(u[1])),
    ),
    "elevation steps at a stop": ("elevation", ("elevation",), _stop),
    "range jumps with azimuth": ("distance", ("azimuth",), _square),
    "azimuth by the load of a table": ("azimuth", ("table_load_kg",), _load),
    "targets sway with time": ("place", ("place", "time"), _period),
}
ALL = LAWS | LATER | LATEST | LAST
SETS: dict[Laws, tuple[str, ...]] = {
    "first": tuple(LAWS),
    "later": tuple(LATER),
    "latest": tuple(LATEST),
    "last": tuple(LAST),
    "all": tuple(ALL),
}
AT_A_STATION = {
    "range by squared height at a station",
    *LATER_AT_A_STATION,
    *LATEST_AT_A_STATION,
    *LAST_AT_A_STATION,
}
OF_NEIGHBOURS = LATER_OF_NEIGHBOURS | LATEST_OF_NEIGHBOURS | LAST_OF_NEIGHBOURS
LOAD = "table_load_kg"


@dataclass(frozen=True)
class Invented(Effect):
    """One law of any set with its constants."""

    law: str = ""
    constants: tuple[float, ...] = (0.0,) * 5

    name = "unknown"
    number = 0
    stage = Stage.ELECTRONICS

    def __post_init__(self) -> None:
        observable, covariates, _ = ALL[self.law]
        angular = observable in ("azimuth", "elevation")
        unit, size = ("urad", 10 * MICRORADIAN) if angular else ("um", 30 * MICROMETRE)
        object.__setattr__(self, "parameters", (Parameter("size", unit, self.law, size),))
        object.__setattr__(self, "covariates", covariates)
        if observable != "place":
            object.__setattr__(self, "observables", (observable,))

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings per unit of size."""
        observable, _, law = ALL[self.law]
        amount = law(sightings, np.array(self.constants))
        amount = (amount.T * self.mask(sightings)).T
        if observable != "place":
            return on_readings(sightings, **{observable: amount})[:, :, None]
        if amount.ndim == 2:
            return by_displacement(sightings, amount[:, :, None])
        axis = int(2 * self.constants[2])
        moved = np.zeros((len(sightings), 3, 1))
        near = sightings.points[:, axis] < np.median(sightings.points[:, axis])
        moved[:, axis, 0] = amount * near[sightings.target]
        return by_displacement(sightings, moved)


def draw_invented(sightings: Sightings, rng: np.random.Generator, laws: Laws = "all") -> Invented:
    """An invented law of a set, with random constants, that acts on this network."""
    names = SETS[laws]
    while True:
        law = names[int(rng.integers(len(names)))]
        if LOAD in ALL[law][1] and LOAD not in sightings.covariates:
            continue
        station = sightings.station_names[int(rng.integers(len(sightings.station_names)))]
        place = (station,) if law in AT_A_STATION else ()
        group = _neighbours(sightings, rng) if law in OF_NEIGHBOURS else ()
        return Invented(place, group, law, tuple(rng.random(5).tolist()))


def _neighbours(sightings: Sightings, rng: np.random.Generator) -> tuple[str, ...]:
    """Five to ten targets that stand together."""
    centre = sightings.points[int(rng.integers(len(sightings.points)))]
    near = np.argsort(np.linalg.norm(sightings.points - centre, axis=1))[: int(rng.integers(5, 11))]
    return tuple(sightings.target_names[t] for t in sorted(near.tolist()))
