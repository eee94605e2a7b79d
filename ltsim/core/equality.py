"""Equality of results by value, including their arrays.

Results are read from files only through pydantic models; no function of ltsim reads a `pickle`.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel


class ValueEquality:
    """Base class of data classes that are compared by value, including their arrays.

    The `__eq__` that Python generates for data classes compares tuples of fields, which fails for arrays.
    """

    def __init_subclass__(cls, **class_options: Any) -> None:
        super().__init_subclass__(**class_options)
        if not issubclass(cls, BaseModel):  # which compare by value themselves
            for name in ("__eq__", "__hash__", "__repr__"):  # a data class keeps what it finds in its own namespace
                if name not in cls.__dict__ and getattr(cls, name) is not getattr(object, name):
                    setattr(cls, name, getattr(cls, name))

    def __eq__(self, other: object) -> bool:
        return equal_values(self, other)

    def __hash__(self) -> int:
        return hash(type(self))


def equal_values(first_value: Any, second_value: Any) -> bool:
    """True if two values have the same type and equal contents; NaN equals NaN."""
    if first_value is second_value:
        return True
    if isinstance(first_value, np.ndarray) or isinstance(second_value, np.ndarray):
        return _equal_arrays(first_value, second_value)
    if isinstance(first_value, Mapping) and isinstance(second_value, Mapping):
        return first_value.keys() == second_value.keys() and all(
            equal_values(first_value[key], second_value[key]) for key in first_value
        )
    if type(first_value) is not type(second_value):
        return False
    if isinstance(first_value, float):
        return first_value == second_value or (math.isnan(first_value) and math.isnan(second_value))
    if isinstance(first_value, tuple | list):
        return len(first_value) == len(second_value) and all(map(equal_values, first_value, second_value))
    if dataclasses.is_dataclass(first_value):
        compared = [f.name for f in dataclasses.fields(first_value) if f.compare]
        return all(equal_values(getattr(first_value, name), getattr(second_value, name)) for name in compared)
    if isinstance(first_value, BaseModel):
        return equal_values(first_value.__dict__, second_value.__dict__)
    contents = _comparable_content(first_value)
    return (
        bool(first_value == second_value)
        if contents is None
        else equal_values(contents, _comparable_content(second_value))
    )


def _comparable_content(compared_object: Any) -> tuple[Any, ...] | None:
    """Tuple with the content of a sparse matrix, or of an ltsim object that defines `__reduce__`; None for others."""
    kind = type(compared_object)
    if kind.__module__.startswith("scipy.sparse"):
        compressed = compared_object.tocsr()
        return (compressed.data, compressed.indices, compressed.indptr), compressed.shape
    if kind.__module__.startswith("ltsim.") and "__reduce__" in kind.__dict__:
        return tuple(compared_object.__reduce__()[1])
    return None


def _equal_arrays(first_array: Any, second_array: Any) -> bool:
    """True if two arrays have the same shape, type and values; NaN equals NaN."""
    if not (isinstance(first_array, np.ndarray) and isinstance(second_array, np.ndarray)):
        return False
    return first_array.dtype == second_array.dtype and np.array_equal(
        first_array, second_array, equal_nan=first_array.dtype.kind in "fc"
    )
