"""Errors of the two graduated circles."""

from dataclasses import dataclass
from typing import Self

from ltsim.physics.effects.effect import Lobe, Parameter, PriorKind, SlotEffect, Term
from ltsim.scene.sightings import Sightings

ORDERS = range(3, 9)
COLUMN = {"azimuth": 1, "elevation": 2}


def lobes(name: str, of: str, size: float, kind: PriorKind | None = None) -> tuple[Parameter, ...]:
    """Amplitudes of the cosine and the sine of an angle."""
    waves = ("cosine", "sine")
    return tuple(Parameter(f"{name}-{wave[:3]}", "urad", f"{wave} of {of}", size, kind) for wave in waves)


def waves(circle: str, order: int) -> tuple[Term, Term]:
    """Cosine and sine of a multiple of the raw reading of a circle, as corrections of that reading."""
    return Term(circle, Lobe("cos", COLUMN[circle], order)), Term(circle, Lobe("sin", COLUMN[circle], order))


@dataclass(frozen=True)
class Harmonic(SlotEffect):
    """Harmonic `order` of a circle, the only one of its observables."""

    order: int = 3

    @property
    def terms(self) -> tuple[Term, ...]:  # type: ignore[override]
        return waves(self.observables[0], self.order)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Every order that can be told."""
        return [cls(order=m) for m in ORDERS]
