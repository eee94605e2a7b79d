"""Higher graduation harmonic of the azimuth circle: lines of the scale are off, as its read heads see them.

Delta_azimuth = A cos(m x) + B sin(m x), x the raw azimuth, m from 3 up. Odd m flips with the face, even m does not; of
several read heads, orders that are multiples of their number survive.

Size: 0.2 urad in a good circle, 2 urad in a bad one.
Like: noise and errors of single targets; bearing-wobble, radial run-out of order m + 1.
Separate by: a turn of the base between stations, which moves the pattern; a repeat, which does not change it.
Valid: m up to 8; with some thirty directions nothing higher can be told.
Source: Lu, Graetz, Amin-Shahidi and Smeds 2010, On-axis self-calibration of angle encoders, CIRP Annals 59, 529-534;
Muralikrishnan et al. 2010, J. Res. NIST 115, 291-301, doi:10.6028/jres.115.022 (parity).
Status: validated against the exact chain in first order, face parity and sign.
"""

from dataclasses import dataclass
from functools import partial
from typing import Self

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import Parameter, SlotEffect, Stage, Term
from ltsim.scene.sightings import Sightings
from ltsim.units import MICRORADIAN

ORDERS = range(3, 9)


def cosine(raw: Floats, *, column: int, order: int) -> Floats:
    """Cosine of a multiple of a raw reading."""
    return np.asarray(np.cos(order * raw[:, column]))


def sine(raw: Floats, *, column: int, order: int) -> Floats:
    """Sine of a multiple of a raw reading."""
    return np.asarray(np.sin(order * raw[:, column]))


def waves(slot: str, column: int, order: int) -> tuple[Term, Term]:
    """Cosine and sine of a multiple of a raw reading, fed to a slot."""
    return (
        Term(slot, partial(cosine, column=column, order=order)),
        Term(slot, partial(sine, column=column, order=order)),
    )


@dataclass(frozen=True)
class AzimuthHarmonic(SlotEffect):
    """Harmonic `order` of the azimuth circle."""

    order: int = 3

    name = "azimuth-harmonic"
    stage = Stage.ENCODERS
    observables = ("azimuth",)
    covariates = ("azimuth",)
    parameters = (
        Parameter("azimuth-harmonic-cos", "urad", "cosine of `order` times the raw azimuth", 2 * MICRORADIAN),
        Parameter("azimuth-harmonic-sin", "urad", "sine of `order` times the raw azimuth", 2 * MICRORADIAN),
    )

    @property
    def terms(self) -> tuple[Term, ...]:  # type: ignore[override]
        """The slot and the two waves."""
        return waves("azimuth", 1, self.order)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Every order that can be told."""
        return [cls(order=m) for m in ORDERS]
