"""Catalogue of physical effects that change the readings of a tracker, one module per effect.

To add a built-in effect, write a module for it and add its name to `EFFECT_NAMES_BY_GROUP`.
"""

from importlib import import_module

from ltsim.core.errors import ModelError
from ltsim.physics.effects.catalogue import (
    Catalogue,
    CatalogueEntry as CatalogueEntry,
    ListedEffect as ListedEffect,
    catalogue_entry as catalogue_entry,
)
from ltsim.physics.effects.effect import (
    ChainErrorEffect as ChainErrorEffect,
    Effect as Effect,
    LightPathStage as LightPathStage,
    NoiseEffect as NoiseEffect,
    Parameter as Parameter,
    ShapeParameter as ShapeParameter,
)

EFFECT_NAMES_BY_GROUP = {
    "instrument geometry": (
        "beam-offset transit-offset beam-tilt transit-tilt vertical-index azimuth-eccentricity elevation-eccentricity "
        "azimuth-second-order elevation-second-order azimuth-harmonic elevation-harmonic encoder-interpolation "
        "bearing-wobble head-sag backlash detector-offset"
    ),
    "range": (
        "range-offset range-mode range-step reflector-constant range-scale station-weather dead-path range-cyclic "
        "refractivity-drift range-drift"
    ),
    "air": "air-gradient air-layer heat-plume turbulence",
    "reflector": "smr-centring smr-incidence smr-dihedral window smr-offset nest-lift target-moved",
    "time and heat": "index-drift azimuth-drift station-settling mesh-expansion gauge-scale gauge-shape",
    "system and gross": "station-levelling timing-lag station-bump target-swap outlier wrong-unit face-confusion",
    "noise": "noise-level station-noise",
}
"""Names of the built-in effects by group of the catalogue, separated by spaces. The class of the effect `beam-tilt`
is `BeamTilt` in the module `beam_tilt.py`."""


def _builtin_effect_class(effect_name: str) -> type[Effect]:
    """Class of the built-in effect `effect_name`, from the module with the same name (with underscores for hyphens)."""
    module_members = vars(import_module(f"{__name__}.{effect_name.replace('-', '_')}")).values()
    return next(kind for kind in module_members if isinstance(kind, type) and vars(kind).get("name") == effect_name)


EFFECT_CLASSES_BY_GROUP = {
    group: tuple(map(_builtin_effect_class, names.split())) for group, names in EFFECT_NAMES_BY_GROUP.items()
}
"""Classes of the built-in effects by group of the catalogue, in the order of `EFFECT_NAMES_BY_GROUP`."""

CATALOGUE = Catalogue(EFFECT_CLASSES_BY_GROUP)
"""Catalogue of all effects: the built-in effects, followed by the effects of installed packages."""

find_effect = CATALOGUE.find
"""Function that returns the class of an effect from its name. For an unknown name it raises ModelError with the most
similar names."""


def effect_title(effect_name: str) -> str:
    """Title of an effect for use within a sentence, with a small first letter.

    For an unknown effect it is the name without hyphens.
    """
    try:
        title = catalogue_entry(find_effect(effect_name)).title
    except ModelError:
        return effect_name.replace("-", " ")
    return f"{title[0].lower()}{title[1:]}"


ORDINARY_CALIBRATION_EFFECT_NAMES = (
    "range-offset range-scale transit-offset beam-offset beam-tilt transit-tilt vertical-index azimuth-eccentricity "
    "azimuth-second-order elevation-eccentricity elevation-second-order"
)
"""Names, separated by spaces, of the geometric errors whose parameters a calibration always estimates (ordinary
calibration)."""
ORDINARY_CALIBRATION_EFFECTS = tuple(
    effect
    for name in ORDINARY_CALIBRATION_EFFECT_NAMES.split()
    if isinstance(effect := find_effect(name)(), ChainErrorEffect)
)
"""Geometric errors that a calibration always estimates (ordinary calibration). They have 16 parameters in total,
among them the range zero and the range scale."""


def _instrument_parameter_text_by_name() -> dict[str, str]:
    """Descriptions of the 16 parameters of an ordinary calibration, by the name of the parameter.

    A description is the title of the effect. If the effect has two parameters, the component (such as cosine or sine)
    follows.
    """
    texts = {}
    for effect in ORDINARY_CALIBRATION_EFFECTS:
        title = (
            effect_title(effect.name)
            if len(effect.parameters) > 1
            else effect_title(effect.name).removesuffix(" error")
        )
        for parameter in effect.parameters:
            component = COMPONENT_TEXT_BY_NAME_ENDING.get(parameter.name.removeprefix(effect.name).strip("-"), "")
            texts[parameter.name] = f"{title} ({component})" if component else title
    return texts


COMPONENT_TEXT_BY_NAME_ENDING = {"cos": "cosine", "sin": "sine", "lateral": "lateral", "vertical": "vertical"}
"""Words, shown to users, for the component of an effect with two parameters (cosine and sine, lateral and vertical), by
the ending of the parameter's name."""
INSTRUMENT_PARAMETER_TEXT_BY_NAME = _instrument_parameter_text_by_name()
"""Descriptions, shown to users, of the 16 parameters of an ordinary calibration, by the name of the parameter."""


def parameter_text(name: str) -> str:
    """Description of an instrument parameter for use within a sentence.

    `name` is the name of the parameter, or ``NAME@INSTRUMENT`` for the parameter of one of several instruments.
    """
    name, _, instrument = name.partition("@")
    words = [name] if "." in name else name.replace("_", " ").replace("-", " ").split()  # J1.eX_c is a symbol
    text = INSTRUMENT_PARAMETER_TEXT_BY_NAME.get(name) or " ".join(
        COMPONENT_TEXT_BY_NAME_ENDING.get(word, word) for word in words
    )
    return f"{text} of {instrument}" if instrument else text
