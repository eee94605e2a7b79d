"""Errors of the two graduated circles: eccentricity, second order, higher harmonics."""

from dataclasses import dataclass
from typing import Self

from ltsim.physics.effects.effect import Lobe, Parameter, PriorKind, SlotEffect, Term
from ltsim.scene.sightings import Sightings

ORDERS = range(3, 9)
COLUMN = {"azimuth": 1, "elevation": 2}


def lobes(name: str, of: str, size: float, kind: PriorKind | None = None) -> tuple[Parameter, ...]:
    """Parameters of the cosine and sine amplitudes of an angle."""
    waves = ("cosine", "sine")
    return tuple(Parameter(f"{name}-{wave[:3]}", "urad", f"{wave} of {of}", size, kind) for wave in waves)


def waves(circle: str, order: int) -> tuple[Term, Term]:
    """Terms with cosine and sine of a multiple of a circle's raw reading, as corrections of that reading."""
    return Term(circle, Lobe("cos", COLUMN[circle], order)), Term(circle, Lobe("sin", COLUMN[circle], order))


@dataclass(frozen=True)
class Harmonic(SlotEffect):
    """Graduation harmonic of `order` of one circle."""

    order: int = 3

    @property
    def terms(self) -> tuple[Term, ...]:  # type: ignore[override]
        return waves(self.observables[0], self.order)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Candidates for every order that the data can distinguish."""
        return [cls(order=m) for m in ORDERS]
