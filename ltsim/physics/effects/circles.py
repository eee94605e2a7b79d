"""Errors of the two graduated circles, which measure azimuth and elevation: eccentricity and periodic errors."""

from dataclasses import dataclass
from typing import Self

from ltsim.physics.effects.effect import ChainErrorEffect, ChainErrorTerm, HarmonicBasis, Parameter, SpecifiedQuantity
from ltsim.scene.sightings import Sightings

CANDIDATE_HARMONIC_ORDERS = range(3, 9)
"""Orders (numbers of periods per turn) of the graduation harmonics that a diagnosis tries."""
READING_COLUMN_BY_CIRCLE = {"azimuth": 1, "elevation": 2}
"""Column of each circle's reading in an array of readings, whose columns are range, azimuth and elevation."""


def cos_sin_parameters(
    name_stem: str, angle_text: str, prior_sigma: float, specified_quantity: SpecifiedQuantity | None = None
) -> tuple[Parameter, ...]:
    """Parameters `name_stem-cos` and `name_stem-sin`: amplitudes of the cosine and the sine of an angle.

    `angle_text` describes the angle for users. `prior_sigma` [rad] is the prior standard deviation of each amplitude,
    unless the instrument's specification states one for `specified_quantity`.
    """
    waves = ("cosine", "sine")
    return tuple(
        Parameter(
            f"{name_stem}-{wave[:3]}",
            "urad",
            f"amplitude of the {wave} of {angle_text}",
            prior_sigma,
            specified_quantity,
        )
        for wave in waves
    )


def cos_sin_terms(circle: str, order: int) -> tuple[ChainErrorTerm, ChainErrorTerm]:
    """Terms with the cosine and the sine of `order` times the raw reading of a circle, which correct this reading.

    `circle` is `azimuth` or `elevation`.
    """
    return ChainErrorTerm(circle, HarmonicBasis("cos", READING_COLUMN_BY_CIRCLE[circle], order)), ChainErrorTerm(
        circle, HarmonicBasis("sin", READING_COLUMN_BY_CIRCLE[circle], order)
    )


@dataclass(frozen=True)
class CircleHarmonic(ChainErrorEffect):
    """Base class of periodic graduation errors of one circle, with several periods per turn."""

    order: int = 3
    """Order of the harmonic: number of periods of the error per turn of the circle."""

    @property
    def terms(self) -> tuple[ChainErrorTerm, ...]:  # type: ignore[override]
        return cos_sin_terms(self.observables[0], self.order)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Harmonics that a diagnosis tries: one for each order in `CANDIDATE_HARMONIC_ORDERS`."""
        return [cls(order=m) for m in CANDIDATE_HARMONIC_ORDERS]
