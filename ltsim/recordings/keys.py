"""Types of the values in user-written TOML files, and the base class of the tables of these files."""

from __future__ import annotations

import datetime
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

from pydantic import AfterValidator, ConfigDict, Field

from ltsim.core.descriptions import DescribedModel

if TYPE_CHECKING:
    from ltsim.core.arrays import Floats

ListedValue = TypeVar("ListedValue")


def _require_nonzero(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if not max(abs(component) for component in vector) > MIN_VECTOR_LENGTH:
        raise ValueError("a direction should not have length zero")
    return vector


def _require_not_tiny(value: float) -> float:
    if value < MIN_POSITIVE:
        raise ValueError(f"it should be at least {MIN_POSITIVE:g}")
    return value


def _without_repetitions(values: tuple[ListedValue, ...]) -> tuple[ListedValue, ...]:
    return tuple(dict.fromkeys(values))


def _require_single_line(text: str) -> str:
    if not text.isprintable():
        raise ValueError("it should be one line of printable text")
    return text


def _require_calendar_date(text: str) -> str:
    try:
        return datetime.date.fromisoformat(text).isoformat()
    except ValueError:
        raise ValueError("it should be a date such as 2026-05-31") from None


def _require_positive_definite(upper_triangle: tuple[float, ...]) -> tuple[float, ...]:
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
"""Smallest eigenvalue of the correlation matrix of a declared covariance; with a smaller one the covariance is refused
as not positive definite."""
MIN_VECTOR_LENGTH = 1e-6
"""Length below which a vector is refused as a direction."""
Finite = Annotated[float, Field(ge=-1e11, le=1e11, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
MIN_POSITIVE = 1e-9
"""Smallest permitted value of a positive number, in the unit of its key, because results are divided by the square of
the number."""
Positive = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False), AfterValidator(_require_not_tiny)]
Elevation = Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)]
Height = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Axes = Literal["xyz", "xy", "xz", "yz", "x", "y", "z"]
DistinctValues = Annotated[tuple[ListedValue, ...], AfterValidator(_without_repetitions)]
"""Values of a list, each once: a file of 1 MB could repeat a name 100,000 times."""
SingleLine = Annotated[str, Field(max_length=200), AfterValidator(_require_single_line)]
Date = Annotated[str, AfterValidator(_require_calendar_date)]
MIN_SIGMA = 1e-6
"""Smallest permitted standard deviation [mm, arcsec, ppm]; with a smaller one the normal equations lose digits."""
Sigma = Annotated[float, Field(ge=MIN_SIGMA, le=1e9, allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]
Covariance = Annotated[
    tuple[Finite, Finite, Finite, Finite, Finite, Finite], AfterValidator(_require_positive_definite)
]
Direction = Annotated[Vector, AfterValidator(_require_nonzero)]
EXACT_LEVELLING_SIGMA_ARCSEC = 1e-3
"""Standard deviation [arcsec] of levelling for formats that assume exact levelling (gama-local, LGC without ROT3D)."""


class TomlSection(DescribedModel):
    """Base class of the tables of user-written TOML files: unknown keys are errors, values are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)
