"""Public functions of the catalogue: list of effects, registration, and construction of an effect by name."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar, cast, get_args, get_origin, get_type_hints

from ltsim.core.errors import ModelError
from ltsim.core.units import SI_PER_UNIT
from ltsim.physics.effects import CATALOGUE, find_effect
from ltsim.physics.effects.descriptions import EffectDescription, EffectList
from ltsim.physics.effects.effect import Effect as AnyEffect, LinearEffect

LOCATION_FIELDS = ("stations", "targets")
"""Names of the fields of an effect that contain the stations and targets where it acts."""
COMMON_EFFECT_FIELDS = {f.name for f in dataclasses.fields(AnyEffect)}
"""Names of the fields that every effect has; further fields of an effect are its constants."""
MAX_FACTOR_BEYOND_SEARCH_BOUNDS = 100.0
"""Factor by which a constant of a simulated effect (a length or time) may lie outside the bounds of a search for the
constant."""


@dataclasses.dataclass(frozen=True)
class SizedEffect:
    """Effect with the values of its parameters, as it is simulated or injected."""

    effect: AnyEffect
    display_values: Mapping[str, float]
    """Values of the effect's parameters by name, in display units."""


EffectT = TypeVar("EffectT", bound=LinearEffect | SizedEffect)


def Effect(  # noqa: N802 - it stands for a class of the catalogue
    name: str, *, stations: str | Sequence[str] = (), targets: str | Sequence[str] = (), **constants: Any
) -> AnyEffect | SizedEffect:
    """Effect of the catalogue at given stations and targets, with given constants.

    Parameters
    ----------
    name : str
        Name of the effect in `lt.catalogue()`.
    stations, targets : str or sequence of str
        Names of the stations and targets where the effect acts; default all.
    **constants
        Constants of the effect in the units of the catalogue, such as ``law="visit"``, and values of its parameters if
        it is simulated or injected, such as ``index_drift=60``. A fit determines constants that are not given from the
        readings; a simulation draws them. A fit also determines constants that are given with their default value; to
        fix them, write the effect as text: ``"index-drift:law=linear"``.

    Returns
    -------
    ltsim.physics.effects.effect.Effect
        Instance of the class of the effect, or `SizedEffect` if values of parameters are given.

    Raises
    ------
    ModelError
        When there is no such effect or constant, or a value is invalid.

    Examples
    --------
    >>> import ltsim as lt
    >>> lt.Effect("index-drift", stations="S3", law="visit").stations
    ('S3',)
    """
    places = dict(zip(LOCATION_FIELDS, (name_tuple(stations), name_tuple(targets)), strict=True))
    name_by_key = {key.replace("_", "-"): key for key in constants}
    sized = {
        p.name: name_by_key[key]
        for p in find_effect(name).parameters
        if (key := p.name.replace("_", "-")) in name_by_key
    }
    sizes = {parameter: float(constants.pop(key)) for parameter, key in sized.items()}
    effect = make_effect(name, places, constants)
    return SizedEffect(effect, sizes) if sizes else effect


def name_tuple(name_or_names: str | Sequence[str]) -> tuple[str, ...]:
    """Names as a tuple, from a single name or a sequence of names."""
    return (name_or_names,) if isinstance(name_or_names, str) else tuple(name_or_names)


def effect_tuple(effect_or_effects: str | EffectT | Sequence[str | EffectT]) -> tuple[str | EffectT, ...]:
    """Effects (names or objects) as a tuple, from a single effect or a sequence of effects."""
    alone = isinstance(effect_or_effects, str) or not isinstance(effect_or_effects, Sequence)
    return (
        (cast("str | EffectT", effect_or_effects),)
        if alone
        else tuple(cast("Sequence[str | EffectT]", effect_or_effects))
    )


def make_effect(name: str, places: Mapping[str, tuple[str, ...]], constants: Mapping[str, Any]) -> AnyEffect:
    """Effect of the catalogue with the given stations, targets and constants.

    `places` has the names of stations and targets by the field `stations` or `targets`. `constants` are by name, in the
    catalogue's unit if it declares one, otherwise in SI units. Raises ModelError for an unknown effect or constant, and
    for an invalid value.
    """
    kind = find_effect(name)
    fields = {f.name: f.default for f in dataclasses.fields(kind) if f.name not in COMMON_EFFECT_FIELDS}
    units = {s.name: SI_PER_UNIT[s.unit] for s in kind.shape_parameters}
    si_constants: dict[str, Any] = {}
    for key, value in constants.items():
        if key not in fields:
            names, sizes = ", ".join(sorted(fields)) or "none", ", ".join(p.name for p in kind.parameters)
            raise ModelError(
                f"{name} has no constant called '{key}'; its constants are {names}; its parameters, whose values "
                f"only a simulation accepts, are {sizes}"
            )
        si_constants[key] = _constant_in_si(f"{name}.{key}", value, fields[key], units.get(key, 1.0))
    effect = kind(**{**places, **si_constants})
    _check_constants(effect)
    return effect


def _check_constants(effect: AnyEffect) -> None:
    """Check of the constants of an effect: words must be permitted, lengths and times near the bounds of a search.

    Raises ModelError with the name of the constant and its permitted values.
    """
    hints = get_type_hints(type(effect))
    for field in dataclasses.fields(effect):
        choices, value = get_args(hints[field.name]), getattr(effect, field.name)
        if get_origin(hints[field.name]) is Literal and value not in choices:
            raise ModelError(f"{effect.name}.{field.name} is {value!r}, expected one of {', '.join(map(str, choices))}")
    for shape in effect.shape_parameters:
        value, unit = getattr(effect, shape.name), SI_PER_UNIT[shape.unit]
        low, high = (
            shape.lower_bound / MAX_FACTOR_BEYOND_SEARCH_BOUNDS,
            shape.upper_bound * MAX_FACTOR_BEYOND_SEARCH_BOUNDS,
        )
        if (
            isinstance(value, float)
            and (shape.has_logarithmic_grid or shape.has_reciprocal_grid)
            and not low <= value <= high
        ):
            bounds = f"{low / unit:.4g} to {high / unit:.4g} {shape.unit}"
            raise ModelError(f"{effect.name}.{shape.name} is {value / unit:.4g}, expected {bounds}")


def _constant_in_si(key: str, value: Any, default: Any, unit: float) -> Any:
    """Constant in SI units with the type of its default, from a `value` in a unit of `unit` [SI].

    `key` names the constant in messages. Raises ModelError for a value of another type.
    """
    if isinstance(default, str) != isinstance(value, str) or isinstance(default, tuple) != isinstance(value, tuple):
        raise ModelError(f"{key} is {value!r}, expected a value such as {default!r}")
    if isinstance(default, int):
        if float(value) != int(value):
            raise ModelError(f"{key} is {value}, expected a whole number")
        return int(value)
    return value * unit if isinstance(default, float) else value


def constants_in_display_units(effect: AnyEffect) -> dict[str, Any]:
    """Constants of an effect by name, in display units, as `make_effect` takes them."""
    units = {s.name: SI_PER_UNIT[s.unit] for s in effect.shape_parameters}
    names = [f.name for f in dataclasses.fields(effect) if f.name not in COMMON_EFFECT_FIELDS]
    value_by_name = {name: getattr(effect, name) for name in names}
    return {name: value / units[name] if name in units else value for name, value in value_by_name.items()}


def catalogue(*names: str) -> EffectList:
    """Physical effects that can be simulated, calibrated and diagnosed: all, or a selection.

    Parameters
    ----------
    *names : str
        Names of effects; default all.

    Raises
    ------
    ModelError
        When there is no such effect; the message gives the most similar names.

    Examples
    --------
    >>> import ltsim as lt
    >>> lt.catalogue("beam-tilt").to_dataframe("parameters")[["parameter", "unit"]]
       parameter  unit
    0  beam-tilt  urad
    """
    listed = CATALOGUE.entries
    chosen = [listed[find_effect(name).name] for name in names] if names else listed.values()
    return EffectList(tuple(EffectDescription.from_listed_effect(effect) for effect in chosen))


def add_effect(effect_class: type[AnyEffect]) -> type[AnyEffect]:
    """Registration of a user-defined effect for this session; also a decorator of its class.

    Afterwards its name is valid in scenarios, in `with_effects`, in campaigns (including their worker processes) and in
    a diagnosis. A catalogue entry is optional. For other sessions the class must be in a package.

    Parameters
    ----------
    effect_class : type of Effect
        Effect class with `name`, `light_path_stage`, `parameters` and `design`.

    Raises
    ------
    ModelError
        If the class cannot be an effect, with the reason, or if another effect has its name.

    Notes
    -----
    The page "An effect of your own" has an example of an effect that is simulated and fitted.

    Examples
    --------
    >>> import ltsim as lt
    >>> lt.add_effect(int)
    Traceback (most recent call last):
    ltsim.core.errors.ModelError: <class 'int'> cannot be an effect: it is not a class derived from lt.Effect
    """
    return CATALOGUE.add(effect_class)
