"""Physics that is in no catalogue, invented for this examination; nothing in ltsim knows of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import Effect, Parameter, Stage, by_displacement, on_readings
from ltsim.scene.sightings import Sightings
from ltsim.units import MICROMETRE, MICRORADIAN

from .laws import first, last, later, latest, motions, newest

SETS_OF_LAWS = {"first": first, "later": later, "latest": latest, "last": last, "newest": newest, "motions": motions}
ALL = {name: law for part in SETS_OF_LAWS.values() for name, law in part.LAWS.items()}
SETS: dict[str, tuple[str, ...]] = {
    "all": tuple(name for part in (first, later, latest, last) for name in part.LAWS),
    "first": tuple(first.LAWS),
    "later": tuple(later.LAWS),
    "latest": tuple(latest.LAWS),
    "last": tuple(last.LAWS),
    "newest": tuple(newest.LAWS),
    "motions": tuple(motions.LAWS),
}
"""Which of the invented laws are drawn.

all: those of the first four sets, so that its recordings stay the same; motions: for tuning.
"""
AT_A_STATION = set().union(*(part.AT_A_STATION for part in SETS_OF_LAWS.values()))
OF_NEIGHBOURS = set().union(*(part.OF_NEIGHBOURS for part in SETS_OF_LAWS.values()))
WORDS = newest.WORDS | motions.WORDS
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
        elif self.law in WORDS and WORDS[self.law].observables:
            object.__setattr__(self, "observables", WORDS[self.law].observables)

    @property
    def words(self) -> dict[str, str]:
        """Carrier, driver and place of a law whose set tells them."""
        told = WORDS.get(self.law)
        return {"carrier": told.carrier, "driver": told.driver, "place": told.place or "everywhere"} if told else {}

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


def draw_invented(sightings: Sightings, rng: np.random.Generator, laws: str = "all") -> Invented:
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
