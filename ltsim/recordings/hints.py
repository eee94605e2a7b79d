"""Hints of the user on what a file of readings does not determine, such as the unit of its angles."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

from ltsim.core.arguments import check_mapping_argument
from ltsim.core.errors import InputError, option_text

AngleUnit = Literal["deg", "gon", "rad"]
VerticalKind = Literal["zenith", "elevation"]
AzimuthSense = Literal["clockwise", "counter-clockwise"]
LengthUnit = Literal["mm", "m"]


@dataclass(frozen=True)
class Hints:
    """Hints of the user on units, senses and names that a file does not determine; None lets the data decide.

    `angle` and `length` are units, `vertical` the kind of vertical angle, `azimuth` its sense. `points` is a file of
    coordinates (name, x, y, z) in a right-handed frame, which decides the sense of the azimuth. `station` names the
    set-up if the file contains no name. `columns` assigns the columns of a table (``target=Name,azimuth=Hz[gon]``).
    `setup` is a `setup.toml` for the file, `date` the order of day and month in dates with slashes. `is_growing`
    permits a file that an instrument is still writing: its last row may be incomplete, and targets of reference lengths
    may not be measured yet. An invalid value raises InputError.

    Examples
    --------
    >>> import ltsim as lt
    >>> lt.Hints(azimuth="clockwise").azimuth
    'clockwise'
    """

    angle: AngleUnit | None = None
    vertical: VerticalKind | None = None
    azimuth: AzimuthSense | None = None
    length: LengthUnit | None = None
    points: Path | None = None
    station: str | None = None
    columns: str | None = None
    setup: Path | None = None
    date: Literal["dmy", "mdy"] | None = None
    is_growing: bool = False

    def __post_init__(self) -> None:
        for field in fields(self):
            value, kind = getattr(self, field.name), next(iter(get_args(field.type)), object)
            choices, kind = get_args(kind), str | Path if kind is Path else kind
            if value is None or (value in choices if choices else value != "" and isinstance(value, kind)):
                continue
            expected = " or ".join(choices) if choices else "a path" if kind == str | Path else "a text"
            raise InputError(f"{option_text('hints')} {field.name}={value}: {field.name} can be {expected}")
        for name in ("points", "setup"):
            object.__setattr__(self, name, getattr(self, name) and Path(getattr(self, name)))


NO_HINTS = Hints()
HINT_KEYS = tuple(field.name for field in fields(Hints) if field.name != "is_growing")
"""Keys of hints of the user."""
HintsArgument = Hints | Mapping[str, Any] | None
"""Hints as an argument of the user: `Hints`, or values by key, such as ``{"azimuth": "clockwise"}``."""


def hints_from_argument(hints: HintsArgument) -> Hints:
    """Hints made from an argument of the user; raises InputError for an invalid key or value."""
    if isinstance(hints, Hints):
        return hints
    check_mapping_argument("hints", hints, HINT_KEYS)
    return Hints(**(hints or {}))
