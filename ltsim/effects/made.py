"""An effect of the catalogue from its name, its places and its constants, as files and people state them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args, get_origin, get_type_hints

from ltsim.effects import find_effect
from ltsim.effects.effect import Effect as AnyEffect
from ltsim.errors import ModelError
from ltsim.units import FACTOR

PLACES = ("stations", "targets")
WIDER = 100.0
"""Times beyond the bounds of a search that a length or a time constant may be simulated."""


class Effect:
    """An effect of the catalogue at some places, with some of its constants: `lt.Effect("index-drift", stations="S3")`.

    Parameters
    ----------
    name : str
        As `lt.catalogue()` lists it.
    stations, targets : str or sequence of str
        Where it acts; all where neither is given.
    **constants
        In the units that the catalogue shows, such as ``law="visit"``.

    Raises
    ------
    ModelError
        When there is no such effect or constant, or a value does not fit.

    Examples
    --------
    >>> import ltsim as lt
    >>> lt.Effect("index-drift", stations="S3", law="visit").stations
    ('S3',)
    """

    def __new__(  # type: ignore[misc]  # the object is one of the effect's own class
        cls, name: str, *, stations: str | Sequence[str] = (), targets: str | Sequence[str] = (), **constants: Any
    ) -> AnyEffect:
        """The effect itself."""
        places = dict(zip(PLACES, (names(stations), names(targets)), strict=True))
        return effect_from(name, places, constants)


def names(given: str | Sequence[str]) -> tuple[str, ...]:
    """Names where one alone may stand for a list of one: a text is a name, not its letters."""
    return (given,) if isinstance(given, str) else tuple(given)


def effect_from(name: str, places: Mapping[str, tuple[str, ...]], shape: Mapping[str, Any]) -> AnyEffect:
    """An effect of the catalogue with its places and constants (in display units where it declares one, else SI).

    Raises
    ------
    ModelError
        When there is no such effect or constant, or a value does not fit.
    """
    kind = find_effect(name)
    fields = {f.name: f.default for f in dataclasses.fields(kind) if f.name not in PLACES}
    units = {s.name: FACTOR[s.unit] for s in kind.shape}
    constants: dict[str, Any] = {}
    for key, value in shape.items():
        if key not in fields:
            known = ", ".join(sorted(fields)) or "none"
            raise ModelError(f"{name} has no constant called '{key}'; constants: {known}")
        constants[key] = _fitted(f"{name}.{key}", value, fields[key], units.get(key, 1.0))
    effect = kind(**places, **constants)
    _check_constants(effect)
    return effect


def _check_constants(effect: AnyEffect) -> None:
    """Refuse a word that is none of those a constant knows, and a length or time far outside what is searched.

    Raises
    ------
    ModelError
        Naming the constant and what would do.
    """
    hints = get_type_hints(type(effect))
    for field in dataclasses.fields(effect):
        known, value = get_args(hints[field.name]), getattr(effect, field.name)
        if get_origin(hints[field.name]) is Literal and value not in known:
            raise ModelError(f"{effect.name}.{field.name} is {value!r}, expected one of {', '.join(map(str, known))}")
    for shape in effect.shape:
        value, unit = getattr(effect, shape.name), FACTOR[shape.unit]
        low, high = shape.low / WIDER, shape.high * WIDER
        if isinstance(value, float) and (shape.logarithmic or shape.reciprocal) and not low <= value <= high:
            bounds = f"{low / unit:.4g} to {high / unit:.4g} {shape.unit}"
            raise ModelError(f"{effect.name}.{shape.name} is {value / unit:.4g}, expected {bounds}")


def _fitted(key: str, value: Any, default: Any, unit: float) -> Any:
    """A constant in SI, of the type its default has."""
    if isinstance(default, str) != isinstance(value, str) or isinstance(default, tuple) != isinstance(value, tuple):
        raise ModelError(f"{key} is {value!r}, expected something like {default!r}")
    if isinstance(default, int):
        if float(value) != int(value):
            raise ModelError(f"{key} is {value}, expected a whole number")
        return int(value)
    return value * unit if isinstance(default, float) else value


def shape_of(effect: AnyEffect) -> dict[str, Any]:
    """The constants of an effect, as `effect_from` takes them."""
    units = {s.name: FACTOR[s.unit] for s in effect.shape}
    names = [f.name for f in dataclasses.fields(effect) if f.name not in PLACES]
    values = {name: getattr(effect, name) for name in names}
    return {name: value / units[name] if name in units else value for name, value in values.items()}
