"""Catalogue of physical effects, one small module each. A new effect needs a module and an entry in its group."""

from importlib import import_module

from ltsim.core.errors import ModelError
from ltsim.physics.effects.catalogue import Card as Card, Catalogue, Listed as Listed, card_of as card_of
from ltsim.physics.effects.effect import (
    Effect as Effect,
    NoiseEffect as NoiseEffect,
    Parameter as Parameter,
    ShapeParameter as ShapeParameter,
    SlotEffect as SlotEffect,
    Stage as Stage,
)

FILES = {
    "instrument geometry": (
        "beam-offset transit-offset beam-tilt transit-tilt vertical-index azimuth-eccentricity elevation-eccentricity "
        "azimuth-second-order elevation-second-order azimuth-harmonic elevation-harmonic encoder-interpolation "
        "bearing-wobble head-sag backlash detector-offset"
    ),
    "range": (
        "range-offset range-mode range-step range-scale station-weather dead-path range-cyclic refractivity-drift "
        "range-drift"
    ),
    "air": "air-gradient air-layer heat-plume turbulence",
    "reflector": "smr-centring smr-incidence smr-dihedral window smr-offset nest-lift target-moved",
    "time and heat": "index-drift azimuth-drift station-settling mesh-expansion gauge-scale gauge-shape",
    "system and gross": "station-levelling timing-lag station-bump target-swap outlier wrong-unit face-confusion",
    "noise": "noise-level station-noise",
}
"""Names of the built-in effects by group; the effect `beam-tilt` is the class `BeamTilt` in `beam_tilt.py`."""


def _shipped(name: str) -> type[Effect]:
    """Class of a built-in effect, from the module with its name."""
    held = vars(import_module(f"{__name__}.{name.replace('-', '_')}")).values()
    return next(kind for kind in held if isinstance(kind, type) and vars(kind).get("name") == name)


GROUPS = {group: tuple(map(_shipped, names.split())) for group, names in FILES.items()}
"""Classes of the built-in effects by group, in the order of the files."""

CATALOGUE = Catalogue(GROUPS)
"""Catalogue of all effects: built-in ones, then those of installed packages (see `effects.catalogue`)."""

find_effect = CATALOGUE.find


def title_of(name: str) -> str:
    """Title of an effect for the middle of a sentence; for an unknown name, the name without hyphens."""
    try:
        title = card_of(find_effect(name)).title
    except ModelError:
        return name.replace("-", " ")
    return f"{title[0].lower()}{title[1:]}"


_ORDINARY = (
    "range-offset range-scale transit-offset beam-offset beam-tilt transit-tilt vertical-index azimuth-eccentricity "
    "azimuth-second-order elevation-eccentricity elevation-second-order"
)
BASELINE = tuple(effect for name in _ORDINARY.split() if isinstance(effect := find_effect(name)(), SlotEffect))
"""Effects of the ordinary calibration: the 16 parameters of the geometric-misalignment model, including range zero and
scale.
"""
