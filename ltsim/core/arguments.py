"""Checks of arguments against bounds, choices and types, with the same messages in Python and on the command line."""

from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from numbers import Integral, Real
from os import PathLike, fspath
from pathlib import Path
from typing import Any

from ltsim.core.errors import InputError, option_text

MAX_JOBS = 256
"""Largest number of worker processes that the argument `jobs` accepts."""
ARGUMENT_BOUNDS: dict[str, tuple[float, float | None]] = {
    "seed": (0, None), "trial": (0, 10**12), "trials": (2, 10**9), "starts": (1, 10**4), "injections": (1, 10**5),
    "jobs": (1, MAX_JOBS), "level": (1e-3, 0.5), "noncentrality": (1e-3, None), "length_sigma": (1e-6, None),
    "every": (1, 10**6),
}  # fmt: skip
"""Permitted range of each numeric argument by its name: smallest and largest value, None for no upper bound.

If the smallest value is an integer, only whole numbers are permitted."""
STATION_POSITION_SYNTAX = "STATION=X,Y or STATION=X,Y,Z or STATION=X,Y,Z,YAW in mm and degrees, such as S2=5000,3000"
"""Syntax of an argument that moves a station to a new position, for messages and help."""


MAPPING_ARGUMENT_SYNTAX = {
    "hold": "NAME=VALUE with a number, e.g. beam-tilt=2.5",
    "tolerance": "NAME=QUANTITY, such as beam-tilt='2 urad'",
    "changes": "KEY=VALUE, such as work.faces=2",
    "hints": "KEY=VALUE",
    "move": STATION_POSITION_SYNTAX,
}
"""Syntax of each argument that is a mapping (`NAME=VALUE`), by the name of the argument, for messages and help."""
MAX_MAPPING_ARGUMENT_MAGNITUDE = 1e12
"""Largest absolute value of a number in an argument of the form `NAME=NUMBER`."""


def argument_bounds_text(argument_name: str) -> str:
    """Text of the permitted range of an argument: `0 or more`, `1 to 256`."""
    low, high = ARGUMENT_BOUNDS[argument_name]
    number_format = ",d" if isinstance(low, int) else "g"
    return f"{low:g} or more" if high is None else f"{low:g} to {high:{number_format}}"


def check_argument_bounds(*, required_argument: str = "", **argument_values: object) -> None:
    """Check of numeric arguments, given by name, against `ARGUMENT_BOUNDS`; raises InputError for a value out of range.

    The value None stands for an argument that was not given. It is an error only for the arguments that
    `required_argument` names (a text of names separated by blanks).
    """
    for name, value in argument_values.items():
        low, high = ARGUMENT_BOUNDS[name]
        number_type = Integral if isinstance(low, int) else Real
        is_number = not isinstance(value, bool) and isinstance(value, number_type) and isfinite(value)
        good = is_number and low <= value and (high is None or value <= high)  # type: ignore[operator]
        if not (good or (value is None and name not in required_argument.split())):
            kind = "a whole number" if number_type is Integral else "a number"
            raise InputError(f"{option_text(name)} is {value}, expected {kind}, {argument_bounds_text(name)}")


def bounded_number_parser(argument_name: str) -> Callable[[object], int | float]:
    """Function that converts a command-line argument to a number within its range in `ARGUMENT_BOUNDS`.

    Raises InputError for a number out of range.
    """
    kind = int if isinstance(ARGUMENT_BOUNDS[argument_name][0], int) else float

    def parse_bounded(text: object) -> int | float:
        value: object = text
        if isinstance(text, str):
            try:
                value = kind(text)
            except ValueError:
                value = text
        value_by_name: dict[str, Any] = {argument_name: value}
        check_argument_bounds(**value_by_name)
        return value  # type: ignore[return-value]

    return parse_bounded


def check_argument_choice(
    argument_name: str, argument_value: object, choices: Sequence[str], *, allow_none: bool = False
) -> None:
    """Check that an argument is one of `choices` (or None with `allow_none`); raises InputError otherwise."""
    if argument_value not in choices and not (allow_none and argument_value is None):
        raise InputError(f"{option_text(argument_name)} is {argument_value}, expected {' or '.join(choices)}")


def check_mapping_argument(argument_name: str, argument_value: object, valid_keys: Sequence[str] = ()) -> None:
    """Check that an argument is a mapping from names (of `valid_keys`, if given), or None; raises InputError."""
    if argument_value is not None and not isinstance(argument_value, Mapping):
        raise InputError(f"{option_text(argument_name)} is {argument_value}, expected a mapping")
    for key, value in (argument_value or {}).items():
        if not isinstance(key, str) or not key.strip() or (valid_keys and key not in valid_keys):
            syntax = MAPPING_ARGUMENT_SYNTAX[argument_name]
            among = f" with a key among {', '.join(valid_keys)}" if valid_keys else ""
            raise InputError(f"{option_text(argument_name)} {key}={value}: expected {syntax}{among}")


def path_of_file_or_built_in(path_or_name: object) -> Path:
    """Path made from an argument of the user: path of a file or folder, or a built-in name such as `paper-workshop`.

    Raises InputError for an empty text, and for an object that is neither text nor path.
    """
    if not (text := _path_text(path_or_name)):
        expected = "the path of a file or folder, or a built-in name such as paper-workshop"
        raise InputError(f"the source is {path_or_name!r}, expected {expected}")
    return Path(text)


def path_argument(argument_name: str, path: object) -> Path:
    """Path made from the argument `argument_name`; raises InputError for an object that is neither text nor path."""
    if (text := _path_text(path)) is None:
        raise InputError(f"{option_text(argument_name)} is {path!r}, expected a path")
    return Path(text)


def _path_text(path: object) -> str | None:
    """Text of a path; None for an object that is no path."""
    text = fspath(path) if isinstance(path, str | PathLike) else None
    return text if isinstance(text, str) and "\0" not in text else None
