"""Errors of the two graduated circles: eccentricity, second order, higher harmonics."""

from dataclasses import dataclass
from typing import Self

from ltsim.physics.effects.effect import ChainErrorEffect, ChainErrorTerm, HarmonicBasis, Parameter, SpecifiedQuantity
from ltsim.scene.sightings import Sightings

CANDIDATE_HARMONIC_ORDERS = range(3, 9)
"""Orders of harmonics that a search tries, in periods per turn."""
READING_COLUMN_BY_CIRCLE = {"azimuth": 1, "elevation": 2}
"""Column of the reading of each circle in the array of readings (range, azimuth, elevation)."""


def cos_sin_parameters(
    name_stem: str, angle_text: str, prior_sigma: float, specified_quantity: SpecifiedQuantity | None = None
) -> tuple[Parameter, ...]:
    """Parameters `name_stem-cos` and `name_stem-sin`, the amplitudes of cosine and sine of an angle.

    `angle_text` describes the angle for users, `prior_sigma` [rad] is the prior standard deviation of each amplitude,
    `specified_quantity` the entry of the instrument's specification that replaces it.
    """
    waves = ("cosine", "sine")
    return tuple(
        Parameter(f"{name_stem}-{wave[:3]}", "urad", f"{wave} of {angle_text}", prior_sigma, specified_quantity)
        for wave in waves
    )


def cos_sin_terms(circle: str, order: int) -> tuple[ChainErrorTerm, ChainErrorTerm]:
    """Terms with the cosine and the sine of `order` times the raw reading of a circle, as corrections of this reading.

    `circle` is a key of `READING_COLUMN_BY_CIRCLE`.
    """
    return ChainErrorTerm(circle, HarmonicBasis("cos", READING_COLUMN_BY_CIRCLE[circle], order)), ChainErrorTerm(
        circle, HarmonicBasis("sin", READING_COLUMN_BY_CIRCLE[circle], order)
    )


@dataclass(frozen=True)
class CircleHarmonic(ChainErrorEffect):
    """Base class of harmonics of one circle: periodic errors of its graduation."""

    order: int = 3
    """Number of periods of the error per turn of the circle."""

    @property
    def terms(self) -> tuple[ChainErrorTerm, ...]:  # type: ignore[override]
        return cos_sin_terms(self.observables[0], self.order)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Harmonics that a diagnosis tries, one for each order in `CANDIDATE_HARMONIC_ORDERS`."""
        return [cls(order=m) for m in CANDIDATE_HARMONIC_ORDERS]
