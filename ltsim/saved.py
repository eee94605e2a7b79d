"""Values of any result: equal where their contents are, written to one file and read back without loss.

The file is a ZIP archive: `result.json` holds the tree of objects, numpy's own format each array. Reading runs nothing
that the file names: only data classes, models and enumerations of modules that are loaded are filled in.
"""

import dataclasses
import io
import json
import math
import os
import sys
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from enum import Enum
from importlib import import_module
from pathlib import Path
from types import FunctionType, MappingProxyType
from typing import Any

import numpy as np
from pydantic import BaseModel

from ltsim.errors import ModelError, RecordError

FORMAT = "ltsim-result/1"
TREE = "result.json"
MOST_BYTES = 4 << 30
"""Of all that an archive unpacks to."""


class Valued:
    """A data class that is compared by value, its arrays too.

    Data classes that are declared below it get this comparison instead of one by tuples, which arrays do not allow.
    """

    def __init_subclass__(cls, **rest: Any) -> None:
        super().__init_subclass__(**rest)
        if not issubclass(cls, BaseModel):  # which compare by value themselves
            for name in ("__eq__", "__hash__", "__repr__"):  # a data class keeps what it finds in its own namespace
                if name not in cls.__dict__ and getattr(cls, name) is not getattr(object, name):
                    setattr(cls, name, getattr(cls, name))

    def __eq__(self, other: object) -> bool:
        return same(self, other)

    def __hash__(self) -> int:
        return hash(type(self))


def same(one: Any, other: Any) -> bool:
    """Whether two values are of one kind and hold the same, NaN being like NaN."""
    if one is other:
        return True
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return _same_arrays(one, other)
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if type(one) is not type(other):
        return False
    if isinstance(one, float):
        return one == other or (math.isnan(one) and math.isnan(other))
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    if dataclasses.is_dataclass(one):
        compared = [f.name for f in dataclasses.fields(one) if f.compare]
        return all(same(getattr(one, name), getattr(other, name)) for name in compared)
    if isinstance(one, BaseModel):
        return same(one.__dict__, other.__dict__)
    made = _made_of(one)
    return bool(one == other) if made is None else same(made, _made_of(other))


def _made_of(value: Any) -> tuple[Any, ...] | None:
    """What an object of a class with ways of its own is made of by that class: a sparse matrix, one of `__reduce__`."""
    kind = type(value)
    if kind.__module__.startswith("scipy.sparse"):
        whole = value.tocsr()
        return (whole.data, whole.indices, whole.indptr), whole.shape
    if kind.__module__.startswith("ltsim.") and "__reduce__" in kind.__dict__:
        return tuple(value.__reduce__()[1])
    return None


def _same_arrays(one: Any, other: Any) -> bool:
    if not (isinstance(one, np.ndarray) and isinstance(other, np.ndarray)):
        return False
    return one.dtype == other.dtype and np.array_equal(one, other, equal_nan=one.dtype.kind in "fc")


def save(value: object, path: Path) -> None:
    """Write a value to one file; raises RecordError, ModelError for what holds something that is no data."""
    writer = _Writer()
    tree = {"format": FORMAT, "result": writer.written(value)}
    handle, name = -1, ""
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(handle, "wb") as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(TREE, json.dumps(tree, allow_nan=False))
            for i, array in enumerate(writer.arrays):
                content = io.BytesIO()
                np.save(content, array, allow_pickle=False)
                archive.writestr(f"{i}.npy", content.getvalue())
        os.replace(name, path)
    except OSError as problem:
        if name:
            Path(name).unlink(missing_ok=True)
        raise RecordError(f"cannot be written ({problem.strerror})", file=path) from None


def is_saved(path: Path) -> bool:
    """Whether a file is one that `save` wrote."""
    try:
        with zipfile.ZipFile(path) as archive:
            return TREE in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def load(path: Path) -> Any:
    """The value of a file that `save` wrote; raises RecordError in one sentence for anything else."""
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > MOST_BYTES:
                raise RecordError(f"holds more than {MOST_BYTES >> 30} GiB, the most that is read", file=path)
            tree = json.loads(archive.read(TREE))
            if tree["format"] != FORMAT:
                raise RecordError(f"format is '{tree['format']!s:.40}', expected '{FORMAT}'", file=path)
            return _Reader(archive).value(tree["result"])
    except OSError as problem:
        raise RecordError(f"cannot be read ({problem.strerror})", file=path) from None
    except RecordError:
        raise
    except Exception as problem:  # whatever a broken or foreign file makes of the reading
        message = "is no result that this version of ltsim saved; calibration.json and its like last longer"
        raise RecordError(f"{message} ({type(problem).__name__})", file=path) from None


class _Writer:
    """Values as JSON: what JSON has not is a mapping whose `is` says what it is; an object met again is its number."""

    def __init__(self) -> None:
        self.arrays: list[np.ndarray] = []
        self._met: dict[int, int] = {}
        self._kept: list[object] = []  # an identity is one only while its object lives

    def written(self, value: Any) -> Any:
        if value is None or (isinstance(value, str | bool | int) and not isinstance(value, Enum)):
            return value
        if isinstance(value, float) and not isinstance(value, np.generic):
            return value if math.isfinite(value) else {"is": "float", "of": repr(value)}
        if isinstance(value, list):
            return [self.written(item) for item in value]
        if id(value) in self._met:
            return {"is": "met", "of": self._met[id(value)]}
        return self._whole(value)

    def _whole(self, value: Any) -> dict[str, Any]:
        number = self._met[id(value)] = len(self._met)
        self._kept.append(value)
        return {"no": number, **self._entry(value)}

    def _entry(self, value: Any) -> dict[str, Any]:
        if isinstance(value, np.ndarray | np.generic):
            self.arrays.append(np.asarray(value))
            kind = "array" if isinstance(value, np.ndarray) else "scalar"
            return {"is": kind, "of": len(self.arrays) - 1}
        if isinstance(value, Path):
            return {"is": "path", "of": str(value)}
        if isinstance(value, tuple):
            named = {} if type(value) is tuple else {"class": _name(type(value))}
            return {"is": "tuple", "of": [self.written(item) for item in value], **named}
        if isinstance(value, set | frozenset):
            return {"is": type(value).__name__, "of": sorted((self.written(item) for item in value), key=repr)}
        if isinstance(value, Mapping):
            kind = "proxy" if isinstance(value, MappingProxyType) else "dict"
            return {"is": kind, "of": [[self.written(k), self.written(v)] for k, v in value.items()]}
        return self._named(value)

    def _named(self, value: Any) -> dict[str, Any]:
        if isinstance(value, FunctionType | type):
            return {"is": "name", "of": _name(value)}
        if isinstance(value, Enum):
            return {"is": "enum", "class": _name(type(value)), "of": value.name}
        if isinstance(value, BaseModel):
            fields = {name: self.written(item) for name, item in value.__dict__.items()}
            return {"is": "model", "class": _name(type(value)), "of": fields, "set": sorted(value.model_fields_set)}
        if dataclasses.is_dataclass(value):
            fields = {f.name: self.written(getattr(value, f.name)) for f in dataclasses.fields(value)}
            return {"is": "object", "class": _name(type(value)), "of": fields}
        made = _made_of(value)
        if made is not None:
            return {"is": "made", "class": _name(type(value)), "of": [self.written(item) for item in made]}
        raise ModelError(f"a {type(value).__name__} cannot be saved; a result holds data only")


class _Reader:
    """The way back."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive
        self._met: dict[int, Any] = {}

    def value(self, tree: Any) -> Any:
        if isinstance(tree, list):
            return [self.value(item) for item in tree]
        if not isinstance(tree, dict):
            return tree
        if tree["is"] == "float":
            return float(tree["of"])
        if tree["is"] == "met":
            return self._met[tree["of"]]
        self._met[tree["no"]] = made = _MAKERS[tree["is"]](self, tree)
        return made

    def _array(self, tree: dict[str, Any]) -> Any:
        return np.load(io.BytesIO(self._archive.read(f"{int(tree['of'])}.npy")), allow_pickle=False)

    def _tuple(self, tree: dict[str, Any]) -> Any:
        items = [self.value(item) for item in tree["of"]]
        kind = _data_class(tree["class"]) if "class" in tree else tuple
        return tuple(items) if kind is tuple else tuple.__new__(kind, items)

    def _mapping(self, tree: dict[str, Any]) -> dict[Any, Any]:
        return {self.value(key): self.value(value) for key, value in tree["of"]}

    def _model(self, tree: dict[str, Any]) -> Any:
        kind = _data_class(tree["class"])
        made = kind.__new__(kind)
        fields = {name: self.value(item) for name, item in tree["of"].items()}
        state = {"__pydantic_fields_set__": set(tree["set"]), "__pydantic_extra__": None, "__pydantic_private__": None}
        made.__setstate__({"__dict__": fields, **state})
        return made

    def _of_parts(self, tree: dict[str, Any]) -> Any:
        parts = [self.value(item) for item in tree["of"]]
        if tree["class"].startswith("scipy.sparse."):
            from scipy.sparse import csr_array

            return csr_array(*parts)
        kind = _named_object(tree["class"], ours=True)
        if "__reduce__" not in kind.__dict__:
            raise TypeError(f"{kind} is made otherwise")
        return kind(*parts)

    def _object(self, tree: dict[str, Any]) -> Any:
        kind = _data_class(tree["class"])
        if {f.name for f in dataclasses.fields(kind)} != set(tree["of"]):
            raise TypeError(f"another {kind.__name__}")
        made = object.__new__(kind)
        for name, item in tree["of"].items():
            object.__setattr__(made, name, self.value(item))
        return made


_MAKERS: dict[str, Callable[[_Reader, dict[str, Any]], Any]] = {
    "array": _Reader._array,
    "scalar": lambda reader, tree: reader._array(tree)[()],
    "path": lambda reader, tree: Path(tree["of"]),
    "tuple": _Reader._tuple,
    "set": lambda reader, tree: {reader.value(item) for item in tree["of"]},
    "frozenset": lambda reader, tree: frozenset(reader.value(item) for item in tree["of"]),
    "dict": _Reader._mapping,
    "proxy": lambda reader, tree: MappingProxyType(reader._mapping(tree)),
    "name": lambda reader, tree: _named_object(tree["of"], ours=True),
    "enum": lambda reader, tree: _data_class(tree["class"])[tree["of"]],
    "model": _Reader._model,
    "object": _Reader._object,
    "made": _Reader._of_parts,
}


def _name(thing: Any) -> str:
    """Module and name of a class or function that stands by itself; raises ModelError for one inside another."""
    if "<" in thing.__qualname__:
        raise ModelError(f"{thing.__qualname__} of {thing.__module__} cannot be saved; a result holds data only")
    return f"{thing.__module__}:{thing.__qualname__}"


def _named_object(name: str, *, ours: bool) -> Any:
    """What a name stands for: of ltsim, or where that is allowed of any module that is loaded."""
    module, _, inside = name.partition(":")
    if module.partition(".")[0] == "ltsim":
        import_module(module)
    elif ours:
        raise TypeError(f"{name} is foreign")
    found: Any = sys.modules[module]
    for part in inside.split("."):
        found = getattr(found, part)
    return found


def _data_class(name: str) -> Any:
    """A class that holds data and nothing else."""
    kind = _named_object(name, ours=False)
    if not (isinstance(kind, type) and (dataclasses.is_dataclass(kind) or issubclass(kind, BaseModel | Enum | tuple))):
        raise TypeError(f"{name} holds no data")
    return kind
