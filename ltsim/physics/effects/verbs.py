"""Public functions for effects: catalogue, registration of an effect class, construction of an effect by name."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar, cast, get_args, get_origin, get_type_hints

from ltsim.core.errors import ModelError
from ltsim.core.units import SI_PER_UNIT
from ltsim.physics.effects import CATALOGUE, find_effect
from ltsim.physics.effects.descriptions import EffectDescription, EffectList
from ltsim.physics.effects.effect import Effect as AnyEffect, LinearEffect

LOCATION_FIELD_NAMES = ("stations", "targets")
"""Names of the fields of an effect with the stations and targets where it acts."""
COMMON_EFFECT_FIELD_NAMES = {f.name for f in dataclasses.fields(AnyEffect)}
"""Names of the fields that all effects have. The other fields of an effect are its shape parameters."""
MAX_FACTOR_BEYOND_SEARCH_BOUNDS = 100.0
"""Largest factor by which a shape parameter (a length or time) of a simulated effect may lie outside the bounds between
which a diagnosis tries its values."""


@dataclasses.dataclass(frozen=True)
class SizedEffect:
    """Effect with values of its parameters, for a simulation or an injection."""

    effect: AnyEffect
    """Effect without values of its parameters."""
    parameter_values_in_display_units: Mapping[str, float]
    """Values of the parameters by name, in their display units."""


EffectT = TypeVar("EffectT", bound=LinearEffect | SizedEffect)
"""Type of an effect, with or without values of its parameters."""


def Effect(  # noqa: N802 - it stands for a class of the catalogue
    name: str, *, stations: str | Sequence[str] = (), targets: str | Sequence[str] = (), **shape_parameters: Any
) -> AnyEffect | SizedEffect:
    """Effect of the catalogue with given shape parameters, at given stations and targets.

    Parameters
    ----------
    name : str
        Name of the effect in `lt.catalogue()`.
    stations, targets : str or sequence of str
        Names of the stations and targets where the effect acts; default all.
    **shape_parameters
        Shape parameters of the effect in the units of the catalogue, such as ``law="visit"``. For a simulation or an
        injection also values of its parameters, such as ``index_drift=60``. If a shape parameter is not given, a fit
        determines it from the readings, and a simulation draws it. A fit also determines a shape parameter that is
        given with its default value; to fix it, write the effect as text: ``"index-drift:law=linear"``.

    Returns
    -------
    ltsim.physics.effects.effect.Effect
        Instance of the class of the effect, or `SizedEffect` if values of parameters are given.

    Raises
    ------
    ModelError
        When there is no such effect or shape parameter, or a value is invalid.

    Examples
    --------
    >>> import ltsim as lt
    >>> lt.Effect("index-drift", stations="S3", law="visit").stations
    ('S3',)
    """
    places = dict(zip(LOCATION_FIELD_NAMES, (name_tuple(stations), name_tuple(targets)), strict=True))
    name_by_key = {key.replace("_", "-"): key for key in shape_parameters}
    sized = {
        p.name: name_by_key[key]
        for p in find_effect(name).parameters
        if (key := p.name.replace("_", "-")) in name_by_key
    }
    sizes = {parameter: float(shape_parameters.pop(key)) for parameter, key in sized.items()}
    effect = make_effect(name, places, shape_parameters)
    return SizedEffect(effect, sizes) if sizes else effect


def name_tuple(name_or_names: str | Sequence[str]) -> tuple[str, ...]:
    """Tuple of names, from a single name or a sequence of names."""
    return (name_or_names,) if isinstance(name_or_names, str) else tuple(name_or_names)


def effect_tuple(effect_or_effects: str | EffectT | Sequence[str | EffectT]) -> tuple[str | EffectT, ...]:
    """Tuple of effects (names or objects), from a single effect or a sequence of effects."""
    alone = isinstance(effect_or_effects, str) or not isinstance(effect_or_effects, Sequence)
    return (
        (cast("str | EffectT", effect_or_effects),)
        if alone
        else tuple(cast("Sequence[str | EffectT]", effect_or_effects))
    )


def make_effect(
    name: str, location_names: Mapping[str, tuple[str, ...]], shape_parameters: Mapping[str, Any]
) -> AnyEffect:
    """Effect of the catalogue with the given stations, targets and shape parameters.

    `location_names` has names of stations and targets by the field `stations` or `targets`. `shape_parameters` are by
    name, in the catalogue's unit if it declares one, otherwise in SI units. Raises ModelError for an unknown effect or
    shape parameter, and for an invalid value.
    """
    kind = find_effect(name)
    fields = {f.name: f.default for f in dataclasses.fields(kind) if f.name not in COMMON_EFFECT_FIELD_NAMES}
    units = {s.name: SI_PER_UNIT[s.unit] for s in kind.shape_parameters}
    si_values: dict[str, Any] = {}
    for key, value in shape_parameters.items():
        if key not in fields:
            names, sizes = ", ".join(sorted(fields)) or "none", ", ".join(p.name for p in kind.parameters)
            raise ModelError(
                f"{name} has no shape parameter called '{key}'; its shape parameters are {names}; "
                f"its parameters, whose values only a simulation accepts, are {sizes}"
            )
        si_values[key] = _shape_parameter_in_si(f"{name}.{key}", value, fields[key], units.get(key, 1.0))
    effect = kind(**{**location_names, **si_values})
    _check_shape_parameters(effect)
    return effect


def _check_shape_parameters(effect: AnyEffect) -> None:
    """Check of the shape parameters of an effect; raises ModelError with the name and the permitted values.

    Words must be permitted ones. Lengths and times must be near the bounds between which a diagnosis tries values.
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


def _shape_parameter_in_si(key: str, value: Any, default: Any, unit: float) -> Any:
    """Shape parameter in SI units, with the type of its `default`, from a `value` in a unit of `unit` [SI].

    `key` is the name of the shape parameter for messages. Raises ModelError for a value of another type.
    """
    if isinstance(default, str) != isinstance(value, str) or isinstance(default, tuple) != isinstance(value, tuple):
        raise ModelError(f"{key} is {value!r}, expected a value such as {default!r}")
    if isinstance(default, int):
        if float(value) != int(value):
            raise ModelError(f"{key} is {value}, expected a whole number")
        return int(value)
    return value * unit if isinstance(default, float) else value


def displayed_shape_parameters(effect: AnyEffect) -> dict[str, Any]:
    """Shape parameters of an effect by name, in display units; `make_effect` accepts them in this form."""
    units = {s.name: SI_PER_UNIT[s.unit] for s in effect.shape_parameters}
    names = [f.name for f in dataclasses.fields(effect) if f.name not in COMMON_EFFECT_FIELD_NAMES]
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
    """Registration of a user-defined effect class for the running Python session; also a decorator of the class.

    Afterwards the name of the effect is valid in scenarios, in `with_effects`, in campaigns (including their worker
    processes) and in a diagnosis. A catalogue entry is optional. For use in other sessions, put the class into a
    package.

    Parameters
    ----------
    effect_class : type of Effect
        Effect class with `name`, `light_path_stage`, `parameters` and `design`.

    Raises
    ------
    ModelError
        If the class cannot be used as an effect, or if another effect has the same name; the message gives the reason.

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
