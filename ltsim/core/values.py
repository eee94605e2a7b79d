"""Equality of results by value, arrays included.

Results are read from files through the models of these files alone. No function of ltsim reads a
`pickle`.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel


class ValueEquality:
    """Base class of data classes that are compared by value, arrays included.

    Data classes derived from it use this comparison instead of comparing tuples of fields, which fails for arrays.
    """

    def __init_subclass__(cls, **rest: Any) -> None:
        super().__init_subclass__(**rest)
        if not issubclass(cls, BaseModel):  # which compare by value themselves
            for name in ("__eq__", "__hash__", "__repr__"):  # a data class keeps what it finds in its own namespace
                if name not in cls.__dict__ and getattr(cls, name) is not getattr(object, name):
                    setattr(cls, name, getattr(cls, name))

    def __eq__(self, other: object) -> bool:
        return equal_values(self, other)

    def __hash__(self) -> int:
        return hash(type(self))


def equal_values(first: Any, second: Any) -> bool:
    """Equality of two values of one type by their contents; NaN equals NaN."""
    if first is second:
        return True
    if isinstance(first, np.ndarray) or isinstance(second, np.ndarray):
        return _equal_arrays(first, second)
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        return first.keys() == second.keys() and all(equal_values(first[key], second[key]) for key in first)
    if type(first) is not type(second):
        return False
    if isinstance(first, float):
        return first == second or (math.isnan(first) and math.isnan(second))
    if isinstance(first, tuple | list):
        return len(first) == len(second) and all(map(equal_values, first, second))
    if dataclasses.is_dataclass(first):
        compared = [f.name for f in dataclasses.fields(first) if f.compare]
        return all(equal_values(getattr(first, name), getattr(second, name)) for name in compared)
    if isinstance(first, BaseModel):
        return equal_values(first.__dict__, second.__dict__)
    parts = _parts_of(first)
    return bool(first == second) if parts is None else equal_values(parts, _parts_of(second))


def _parts_of(value: Any) -> tuple[Any, ...] | None:
    """Contents of an object that is neither a data class nor a model.

    A sparse matrix and an object with `__reduce__` have such contents; None for another object.
    """
    kind = type(value)
    if kind.__module__.startswith("scipy.sparse"):
        compressed = value.tocsr()
        return (compressed.data, compressed.indices, compressed.indptr), compressed.shape
    if kind.__module__.startswith("ltsim.") and "__reduce__" in kind.__dict__:
        return tuple(value.__reduce__()[1])
    return None


def _equal_arrays(first: Any, second: Any) -> bool:
    if not (isinstance(first, np.ndarray) and isinstance(second, np.ndarray)):
        return False
    return first.dtype == second.dtype and np.array_equal(first, second, equal_nan=first.dtype.kind in "fc")
