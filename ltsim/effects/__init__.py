"""The catalogue: one class, one physical effect. To add one, write its class into a file of its group."""

from ltsim.effects import (
    atmosphere,
    blunders,
    circles,
    head,
    misalignments,
    noise,
    ranges,
    reflectors,
    seats,
    warming,
)
from ltsim.effects.catalogue import Card as Card, Catalogue, Entry as Entry, card_of as card_of, effects_in
from ltsim.effects.effect import (
    Effect as Effect,
    NoiseEffect as NoiseEffect,
    Parameter as Parameter,
    ShapeParameter as ShapeParameter,
    SlotEffect as SlotEffect,
    Stage as Stage,
)

BASELINE: tuple[SlotEffect, ...] = (
    ranges.RangeOffset(),
    ranges.RangeScale(),
    misalignments.TransitOffset(),
    misalignments.BeamOffset(),
    misalignments.BeamTilt(),
    misalignments.TransitTilt(),
    misalignments.VerticalIndex(),
    circles.AzimuthEccentricity(),
    circles.AzimuthSecondOrder(),
    circles.ElevationEccentricity(),
    circles.ElevationSecondOrder(),
)
"""The ordinary calibration: the 16 parameters of the geometric-misalignment model with range zero and scale."""

GROUPS: dict[str, tuple[type[Effect], ...]] = {
    "instrument geometry": effects_in(misalignments, circles, head),
    "range": effects_in(ranges),
    "air": effects_in(atmosphere),
    "reflector": effects_in(reflectors, seats),
    "time and heat": effects_in(warming),
    "system and gross": effects_in(blunders),
    "noise": effects_in(noise),
}
"""What ships, by group, in the order of the files."""

CATALOGUE = Catalogue(GROUPS)
"""Every effect: what ships, then what installed packages add (see `effects.catalogue`)."""

find_effect = CATALOGUE.find
