"""Bounds, choices and forms of arguments, with the same error messages in Python and on the command line."""

from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from numbers import Integral, Real
from os import PathLike, fspath
from pathlib import Path
from typing import Any

from ltsim.core.errors import SetupError, option

MAX_JOBS = 256
"""Largest number of worker processes that `jobs` accepts."""
ARGUMENT_BOUNDS: dict[str, tuple[float, float | None]] = {
    "seed": (0, None), "trial": (0, 10**12), "trials": (2, 10**9), "starts": (1, 10**4), "injections": (1, 10**5),
    "jobs": (1, MAX_JOBS), "level": (1e-6, 0.5), "noncentrality": (1e-3, None), "length_sigma": (1e-6, None),
    "every": (1, 10**6),
}  # fmt: skip
"""Smallest and largest permitted value by argument name (None: no upper bound); an integer bound requires whole
numbers.
"""
MOVE_SYNTAX = "STATION=X,Y or STATION=X,Y,Z or STATION=X,Y,Z,YAW in mm and degrees, such as S2=5000,3000"
"""Syntax of a moved station, for messages and help."""


def range_text(name: str) -> str:
    """Range of an argument as text: `0 or more`, `1 to 256`."""
    low, high = ARGUMENT_BOUNDS[name]
    number = ",d" if isinstance(low, int) else "g"
    return f"{low:g} or more" if high is None else f"{low:g} to {high:{number}}"


def check_bounds(*, required: str = "", **given: object) -> None:
    """Check of numeric arguments against `ARGUMENT_BOUNDS`; raises SetupError for a value out of range.

    None means that an argument was not given; it is an error for the arguments in `required`, names separated by
    blanks.
    """
    for name, value in given.items():
        low, high = ARGUMENT_BOUNDS[name]
        whole = isinstance(low, int)
        is_number = not isinstance(value, bool) and isinstance(value, Integral if whole else Real) and isfinite(value)
        good = is_number and low <= value and (high is None or value <= high)  # type: ignore[operator]
        if not (good or (value is None and name not in required.split())):
            kind = "a whole number" if whole else "a number"
            raise SetupError(f"{option(name)} is {value}, expected {kind}, {range_text(name)}")


def bounded_parser(name: str) -> Callable[[object], int | float]:
    """Parser of a numeric argument on the command line; it raises SetupError under the conditions of `check_bounds`."""
    kind = int if isinstance(ARGUMENT_BOUNDS[name][0], int) else float

    def parse_bounded(text: object) -> int | float:
        value: object = text
        if isinstance(text, str):
            try:
                value = kind(text)
            except ValueError:
                value = text
        given: dict[str, Any] = {name: value}
        check_bounds(**given)
        return value  # type: ignore[return-value]

    return parse_bounded


def check_choice(name: str, value: object, choices: Sequence[str], *, optional: bool = False) -> None:
    """Check that an argument is one of its choices; raises SetupError. None is permitted for an `optional` argument."""
    if value not in choices and not (optional and value is None):
        raise SetupError(f"{option(name)} is {value}, expected {' or '.join(choices)}")


def check_mapping(name: str, value: object) -> None:
    """Check that an argument is a mapping or None; raises SetupError."""
    if value is not None and not isinstance(value, Mapping):
        raise SetupError(f"{option(name)} is {value}, expected a mapping")


def source_path(source: object) -> Path:
    """Path or name of a source; raises SetupError for another object, and for an empty text."""
    text = fspath(source) if isinstance(source, str | PathLike) else None
    if not isinstance(text, str) or not text or "\0" in text:
        raise SetupError(f"the source is {source!r}, expected the name of a built-in one, or the path of a file")
    return Path(text)
