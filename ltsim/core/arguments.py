"""Bounds and choices of arguments, with the same error messages in Python and on the command line."""

from collections.abc import Sequence
from math import isfinite
from numbers import Integral, Real

from ltsim.core.errors import SetupError, option

MOST_JOBS = 256
"""Largest number of processes."""
BOUNDS: dict[str, tuple[float, float | None]] = {
    "seed": (0, None), "trial": (0, 10**12), "trials": (2, 10**9), "starts": (1, 10**4), "injections": (1, 10**5),
    "jobs": (1, MOST_JOBS), "level": (1e-6, 0.5), "noncentrality": (1e-3, None), "length_sigma": (1e-6, None),
}  # fmt: skip
"""Smallest and largest value by the name of an argument; whole numbers where the smallest is one."""


def range_words(name: str) -> str:
    """Range of an argument in words: `0 or more`, `1 to 256`."""
    low, high = BOUNDS[name]
    number = ",d" if isinstance(low, int) else "g"
    return f"{low:g} or more" if high is None else f"{low:g} to {high:{number}}"


def check_bounds(**given: object) -> None:
    """Raise SetupError for an argument that is no number of its range; None stands for one that is not given."""
    for name, value in given.items():
        low, high = BOUNDS[name]
        whole = isinstance(low, int)
        good = isinstance(value, Integral if whole else Real) and isfinite(value)
        if value is not None and not (good and low <= value and (high is None or value <= high)):  # type: ignore[operator]
            kind = "a whole number" if whole else "a number"
            raise SetupError(f"{option(name)} is {value}, expected {kind}, {range_words(name)}")


def check_choice(name: str, value: object, choices: Sequence[str]) -> None:
    """Raise SetupError for an argument that is none of its choices; None stands for one that is not given."""
    if value is not None and value not in choices:
        raise SetupError(f"{option(name)} is {value}, expected {' or '.join(choices)}")
