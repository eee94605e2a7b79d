"""Higher graduation harmonic of the azimuth circle (9): lines of the scale that are off, as seen by its read heads.

Delta_azimuth = A cos(m x) + B sin(m x), x the raw azimuth, m from 3 up. Odd m flips with the face, even m does not.
Like: noise and errors of single targets; radial run-out of the standing axis, order m + 1.
Separate by: a turn of the base between stations, which moves the pattern; a repeat, which does not change it.
Valid: m up to 8; with some thirty directions nothing higher can be told.
Source: physics.md entry 9 [S16, K].
Status: validated against the exact chain in first order, face parity and sign.
"""

from __future__ import annotations

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
    number = 9
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
