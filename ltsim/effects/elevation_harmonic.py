"""Higher graduation harmonic of the elevation circle: lines of the scale are off, as its read heads see them.

Delta_elevation = A cos(m x) + B sin(m x), x the raw elevation, m from 3 up. In front-face terms the cosine flips with
the face for even m, the sine for odd m.

Size: 0.2 urad in a good circle, 2 urad in a bad one.
Like: noise and errors of single targets; over the 110 deg that a network uses, its own neighbours in order.
Separate by: two faces; more elevations.
Valid: m up to 8.
Source: Lu, Graetz, Amin-Shahidi and Smeds 2010, On-axis self-calibration of angle encoders, CIRP Annals 59, 529-534.
Status: validated against the exact chain in first order, face parity and sign.
"""

from dataclasses import dataclass
from typing import Self

from ltsim.effects.azimuth_harmonic import ORDERS, waves
from ltsim.effects.effect import Parameter, SlotEffect, Stage, Term
from ltsim.scene.sightings import Sightings
from ltsim.units import MICRORADIAN


@dataclass(frozen=True)
class ElevationHarmonic(SlotEffect):
    """Harmonic `order` of the elevation circle."""

    order: int = 3

    name = "elevation-harmonic"
    stage = Stage.ENCODERS
    observables = ("elevation",)
    covariates = ("elevation",)
    parameters = (
        Parameter("elevation-harmonic-cos", "urad", "cosine of `order` times the raw elevation", 2 * MICRORADIAN),
        Parameter("elevation-harmonic-sin", "urad", "sine of `order` times the raw elevation", 2 * MICRORADIAN),
    )

    @property
    def terms(self) -> tuple[Term, ...]:  # type: ignore[override]
        """The slot and the two waves."""
        return waves("elevation", 2, self.order)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Every order that can be told."""
        return [cls(order=m) for m in ORDERS]
