"""Types of values in TOML files written by users (`setup.toml`, plans, campaigns), and base class of their tables."""

from __future__ import annotations

import datetime
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

from pydantic import AfterValidator, ConfigDict, Field

from ltsim.core.descriptions import DescribedModel

if TYPE_CHECKING:
    from ltsim.core.arrays import Floats

ListedValue = TypeVar("ListedValue")
"""Type of the values in a list."""


def _require_nonzero(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    """Unchanged `vector`; raises ValueError if it is shorter than `MIN_VECTOR_LENGTH`."""
    if not max(abs(component) for component in vector) > MIN_VECTOR_LENGTH:
        raise ValueError("a direction should not have length zero")
    return vector


def _require_min_positive(value: float) -> float:
    """Unchanged `value`; raises ValueError if it is smaller than `MIN_POSITIVE`."""
    if value < MIN_POSITIVE:
        raise ValueError(f"it should be at least {MIN_POSITIVE:g}")
    return value


def _without_repetitions(values: tuple[ListedValue, ...]) -> tuple[ListedValue, ...]:
    """Distinct values in the order of their first occurrence."""
    return tuple(dict.fromkeys(values))


def _require_single_line(text: str) -> str:
    """Unchanged `text`; raises ValueError if it is not one line of printable characters."""
    if not text.isprintable():
        raise ValueError("it should be one line of printable text")
    return text


def _require_calendar_date(text: str) -> str:
    """Unchanged `text`; raises ValueError if it is not a date in ISO format."""
    try:
        return datetime.date.fromisoformat(text).isoformat()
    except ValueError:
        raise ValueError("it should be a date such as 2026-05-31") from None


def _require_positive_definite(upper_triangle: tuple[float, ...]) -> tuple[float, ...]:
    """Unchanged entries xx, xy, xz, yy, yz, zz of a matrix; raises ValueError if it is not positive definite."""
    import numpy as np  # help of a verb need not wait for it

    matrix = symmetric_matrix(upper_triangle)
    sigma = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    if sigma.min() < MIN_SIGMA or np.linalg.eigvalsh(matrix / np.outer(sigma, sigma))[0] < MIN_CORRELATION_EIGENVALUE:
        raise ValueError("it should be the entries xx, xy, xz, yy, yz, zz of a positive definite covariance matrix")
    return upper_triangle


def symmetric_matrix(upper_triangle: tuple[float, ...]) -> Floats:
    """Symmetric matrix (3, 3) from its upper triangle xx, xy, xz, yy, yz, zz."""
    import numpy as np

    matrix = np.zeros((3, 3))
    matrix[np.triu_indices(3)] = upper_triangle
    return matrix + np.triu(matrix, 1).T


MIN_CORRELATION_EIGENVALUE = 1e-9
"""Smallest permitted eigenvalue of the correlation matrix of a declared covariance. Below this limit the covariance
counts as not positive definite."""
MIN_VECTOR_LENGTH = 1e-6
"""Smallest length of an accepted vector, in its unit; a shorter vector has no direction."""
Finite = Annotated[float, Field(ge=-1e11, le=1e11, allow_inf_nan=False)]
"""Finite number of at most 1e11 in magnitude."""
NonNegative = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
"""Number from 0 to 1e9."""
MIN_POSITIVE = 1e-9
"""Smallest permitted value of a number that must be positive, in the unit of its key: results are divided by its
square."""
Positive = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False), AfterValidator(_require_min_positive)]
"""Number from `MIN_POSITIVE` to 1e9."""
Elevation = Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)]
"""Elevation [deg] above the horizontal plane, from -90 to 90."""
Height = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
"""Height of at most 1e6 in magnitude, in the unit of its key."""
Axes = Literal["xyz", "xy", "xz", "yz", "x", "y", "z"]
"""Coordinate axes, as letters in alphabetical order."""
DistinctValues = Annotated[tuple[ListedValue, ...], AfterValidator(_without_repetitions)]
"""List whose repeated values are removed, because a file of 1 MB could repeat a name 100,000 times."""
SingleLine = Annotated[str, Field(max_length=200), AfterValidator(_require_single_line)]
"""Text of one line with at most 200 characters."""
Date = Annotated[str, AfterValidator(_require_calendar_date)]
"""Calendar date in ISO format, such as 2026-05-31."""
MIN_SIGMA = 1e-6
"""Smallest permitted standard deviation [mm, arcsec or ppm]; a smaller value would make the normal equations
inaccurate."""
Sigma = Annotated[float, Field(ge=MIN_SIGMA, le=1e9, allow_inf_nan=False)]
"""Standard deviation from `MIN_SIGMA` to 1e9."""
Vector = tuple[Finite, Finite, Finite]
"""Vector x, y, z."""
Covariance = Annotated[
    tuple[Finite, Finite, Finite, Finite, Finite, Finite], AfterValidator(_require_positive_definite)
]
"""Entries xx, xy, xz, yy, yz, zz of a positive definite covariance matrix."""
Direction = Annotated[Vector, AfterValidator(_require_nonzero)]
"""Vector x, y, z of any length except 0, whose direction is used."""
EXACT_LEVELLING_SIGMA_ARCSEC = 1e-3
"""Standard deviation [arcsec] of the tilt of instruments in formats that assume exact levelling (gama-local, LGC
without ROT3D)."""


class TomlSection(DescribedModel):
    """Base class of tables in TOML files written by users: unknown keys are errors, and values cannot be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)
