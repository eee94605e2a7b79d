"""The parameters of a tracker with a beam-steering mirror: misalignments of mirror, axes, cover plate and beam."""

from __future__ import annotations

from typing import Literal

from ltsim.effects.azimuth_eccentricity import AzimuthEccentricity
from ltsim.effects.azimuth_second_order import AzimuthSecondOrder
from ltsim.effects.effect import Lobe, Parameter, SlotEffect, Term
from ltsim.effects.range_offset import RangeOffset
from ltsim.effects.range_scale import RangeScale
from ltsim.effects.transit_offset import TransitOffset
from ltsim.effects.transit_tilt import TransitTilt
from ltsim.effects.vertical_index import VerticalIndex
from ltsim.units import ARCSECOND, MICROMETRE

SHARED: tuple[SlotEffect, ...] = (
    RangeOffset(),
    RangeScale(),
    TransitOffset(),
    TransitTilt(),
    VerticalIndex(),
    AzimuthEccentricity(),
    AzimuthSecondOrder(),
)
"""Causes that the design with the source in the head has too; they feed the same slots of another chain."""


def _offset(name: str, slot: str, meaning: str) -> tuple[Parameter, Term]:
    return Parameter(name, "um", meaning, 20 * MICROMETRE, "offset"), Term(slot)


def _tilt(name: str, slot: str, meaning: str) -> tuple[Parameter, Term]:
    return Parameter(name, "urad", meaning, 3 * ARCSECOND, "angle"), Term(slot)


def _circle(name: str, meaning: str, order: float, wave: Literal["cos", "sin"]) -> tuple[Parameter, Term]:
    """A lobe of the circle that turns with the mirror, at half the rate of the reading."""
    parameter = Parameter(name, "urad", meaning, 3 * ARCSECOND, "angle")
    return parameter, Term("elevation", Lobe(wave, 2, 0.5 * order))


PARAMETERS: tuple[tuple[Parameter, Term], ...] = (
    *((p, t) for effect in SHARED for p, t in zip(effect.parameters, effect.terms, strict=True)),
    _offset("mirror-offset", "mirror-offset", "mirror in front of the transit axis, along its normal"),
    _tilt("mirror-tilt", "mirror-tilt", "mirror turned left, its plane not along the transit axis"),
    _offset("cover-forward", "cover-forward", "beam forward of the standing axis, turning with the head"),
    _offset("cover-left", "cover-left", "beam left of the standing axis, turning with the head"),
    _offset("beam-x", "beam-x", "beam beside the standing axis, along x of the base"),
    _offset("beam-y", "beam-y", "beam beside the standing axis, along y of the base"),
    _tilt("beam-tilt-x", "beam-tilt-x", "beam leans about x of the base"),
    _tilt("beam-tilt-y", "beam-tilt-y", "beam leans about y of the base"),
    _circle("elevation-eccentricity-cos", "cosine of the mirror's angle, half the raw elevation", 1, "cos"),
    _circle("elevation-eccentricity-sin", "sine of the mirror's angle", 1, "sin"),
    _circle("elevation-second-order-cos", "cosine of twice the mirror's angle", 2, "cos"),
    _circle("elevation-second-order-sin", "sine of twice the mirror's angle", 2, "sin"),
)
"""Each parameter and the slot of `kinematics.steering_mirror` that it feeds."""
