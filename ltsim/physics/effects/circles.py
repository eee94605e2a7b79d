"""Errors of the two graduated circles: eccentricity, second order, higher harmonics."""

from dataclasses import dataclass
from typing import Self

from ltsim.physics.effects.effect import HarmonicBasis, Parameter, PriorKind, SlotEffect, SlotTerm
from ltsim.scene.sightings import Sightings

CANDIDATE_ORDERS = range(3, 9)
"""Orders of harmonics that a search tries, in periods per turn."""
READING_COLUMN_BY_CIRCLE = {"azimuth": 1, "elevation": 2}
"""Column of a circle's angle in the array of readings."""


def cos_sin_parameters(
    name_stem: str, angle_text: str, prior_sigma: float, prior_kind: PriorKind | None = None
) -> tuple[Parameter, ...]:
    """Parameters `name_stem-cos` and `name_stem-sin`, the amplitudes of cosine and sine of an angle.

    `angle_text` describes the angle, `prior_sigma` [rad] is the prior standard deviation of each amplitude.
    """
    waves = ("cosine", "sine")
    return tuple(
        Parameter(f"{name_stem}-{wave[:3]}", "urad", f"{wave} of {angle_text}", prior_sigma, prior_kind)
        for wave in waves
    )


def cos_sin_terms(circle: str, order: int) -> tuple[SlotTerm, SlotTerm]:
    """Terms with cosine and sine of `order` times the raw reading of a circle, as corrections of this reading."""
    return SlotTerm(circle, HarmonicBasis("cos", READING_COLUMN_BY_CIRCLE[circle], order)), SlotTerm(
        circle, HarmonicBasis("sin", READING_COLUMN_BY_CIRCLE[circle], order)
    )


@dataclass(frozen=True)
class CircleHarmonic(SlotEffect):
    """Base class of harmonics of one circle: periodic errors of its graduation."""

    order: int = 3
    """Periods per turn of the circle."""

    @property
    def terms(self) -> tuple[SlotTerm, ...]:  # type: ignore[override]
        return cos_sin_terms(self.observables[0], self.order)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Candidates for every order of `CANDIDATE_ORDERS`."""
        return [cls(order=m) for m in CANDIDATE_ORDERS]
