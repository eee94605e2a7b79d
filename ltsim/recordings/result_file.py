"""Base classes of results with a JSON file: one pydantic model is the Python object and the content of the file.

The JSON file contains digests (SHA-256) of its companion files and of the recording. They show whether a table belongs
to the same run.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Self, TypeVar

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    GetCoreSchemaHandler,
    ValidationError,
)
from pydantic_core import CoreSchema

from ltsim.core.descriptions import DescribedModel
from ltsim.core.equality import equal_values
from ltsim.core.errors import RecordError
from ltsim.core.limits import (
    MAX_JSON_VALUES,
    MAX_RESULT_LIST_ENTRIES,
    MAX_RESULT_MEAN_TEXT_CHARACTERS,
    MAX_RESULT_TEXT_CHARACTERS,
    MAX_RESULT_TEXTS,
)
from ltsim.core.results import MAX_RESULT_MAGNITUDE, Result, Table
from ltsim.recordings.epoch_coordinates import EpochCoordinates
from ltsim.recordings.files import read_bytes, read_text, safe_excerpt, write_texts
from ltsim.recordings.recording import Recording

DIGEST_ROUNDING_STEP = 1e-6
"""Step [m, rad] of rounded readings in a digest, so that a recording has the same digest after export and import."""
DIGEST_ROUNDING_OFFSET = 1.0 / np.pi
"""Offset, in multiples of `DIGEST_ROUNDING_STEP`, that is added before rounding; with it no decimal reading is halfway
between two steps."""


def finite_or_none(value: Any) -> Any:
    """Unchanged `value`, or None in place of NaN and infinities."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _require_not_zero(value: Any) -> Any:
    """Unchanged number or vector; raises ValueError if no element reaches `MIN_NONZERO_MAGNITUDE` in magnitude."""
    if not np.max(np.abs(value)) >= MIN_NONZERO_MAGNITUDE:
        raise ValueError("Input should not be zero")
    return value


Finite = FiniteFloat
"""Finite number."""
OptionalFloat = Annotated[FiniteFloat | None, BeforeValidator(finite_or_none)]
"""Number or None; NaN and infinities, which JSON does not have, become None."""
NotNegative = Annotated[Finite, Field(ge=0)]
"""Finite number of at least 0."""
Sigma = Annotated[NotNegative | None, BeforeValidator(finite_or_none)]
"""Standard deviation of at least 0; None if unknown."""
MIN_NONZERO_MAGNITUDE = 1.0 / MAX_RESULT_MAGNITUDE
"""Largest magnitude that counts as zero, because the square of its reciprocal would not be finite."""
Positive = Annotated[Finite, Field(gt=0), AfterValidator(_require_not_zero)]
"""Finite number above 0, at least `MIN_NONZERO_MAGNITUDE`."""
NonZero = Annotated[Finite, AfterValidator(_require_not_zero)]
"""Finite number that is not 0."""
Vector = tuple[Finite, Finite, Finite]
"""Vector x, y, z."""
Quaternion = Annotated[tuple[Finite, Finite, Finite, Finite], AfterValidator(_require_not_zero)]
"""Rotation as quaternion x, y, z, w, of any length except 0."""


def _stop_at_first_error(schema: Any) -> None:
    """Change, in place, of a pydantic core schema: the validation of a list ends at its first wrong entry."""
    if isinstance(schema, list | tuple):
        for part in schema:
            _stop_at_first_error(part)
    elif isinstance(schema, dict):
        if schema.get("type") in ("list", "tuple"):
            schema["fail_fast"] = True
        for key, part in schema.items():
            if key not in ("metadata", "serialization"):
                _stop_at_first_error(part)


class Entry(DescribedModel):
    """Base class of objects in a result file: values cannot be changed, unknown keys of later versions are ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True, populate_by_name=True)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Core schema with which the validation of a list ends at its first wrong entry, to save memory for errors."""
        schema = handler(source)
        _stop_at_first_error(schema)
        return schema

    def with_values(self, **values: Any) -> Self:
        """Validated copy with new values of fields, given by name in `values`; NaN and infinities become None.

        Raises TypeError for a name that is not a field, because validation would ignore it.
        """
        if unknown := sorted(values.keys() - type(self).model_fields.keys()):
            raise TypeError(f"{type(self).__name__} has no field {', '.join(unknown)}")
        return type(self).model_validate({name: getattr(self, name) for name in self.model_fields_set} | values)


class ResultSource(Entry):
    """Identification of the recording, or of the list of coordinates, from which a result was computed."""

    title: str = ""
    """Title of the recording, for display."""
    pointings: int
    """Number of pointings of the recording; 0 for a list of coordinates."""
    digest: str
    """Digest (SHA-256) of the recording or of the coordinates."""
    measured_on: str | None = None
    """Day, or day and time, of the measurement in ISO format; None if the set-up does not give it."""

    @classmethod
    def from_recording(cls, recording: Recording) -> ResultSource:
        """Identification of a recording: title, number of pointings, digest and day of the measurement."""
        time_keys = {"measured_on": recording.setup.measured_on} if recording.setup.measured_on else {}
        return cls(
            title=recording.setup.title, pointings=len(recording), digest=recording_digest(recording), **time_keys
        )

    @classmethod
    def from_coordinates(cls, coordinates: EpochCoordinates) -> ResultSource:
        """Identification of a list of coordinates: title and digest, with 0 pointings."""
        content = (
            "\t".join((*coordinates.names, coordinates.axes)).encode()
            + coordinates.points.tobytes()
            + coordinates.covariance.tobytes()
        )
        return cls(title=coordinates.title, pointings=0, digest=hashlib.sha256(content).hexdigest())


class ResultFile(Entry, Result):
    """Base model of results: the object that a public function returns, which is also the content of its JSON file.

    Subclasses set `FILE`, the name of the file, and `format`. `COMPANION_TABLES` are the tables that are written with
    the file, by name of the table, and `FURTHER_FILES` the names of other files that a command may write with it, such
    as a picture. `MAX_TEXTS` is the largest number of texts, lists and objects together in a file that is read. If
    `SHARES_EQUAL_OBJECTS` is true, equal objects of a file are read as the same dictionary. Arrays that the file does
    not contain are in private attributes, which the comparison of results ignores.
    """

    FILE: ClassVar[str]
    COMPANION_TABLES: ClassVar[Mapping[str, Table]] = MappingProxyType({})
    FURTHER_FILES: ClassVar[tuple[str, ...]] = ()
    MAX_TEXTS: ClassVar[int] = MAX_RESULT_TEXTS
    SHARES_EQUAL_OBJECTS: ClassVar[bool] = False
    format: str
    """Format and version of the file, such as `ltsim-calibration/1`."""
    recording: ResultSource | None = None
    """Recording, or list of coordinates, from which the result was computed."""
    files: dict[str, str] = Field(default_factory=dict)
    """Digest (SHA-256) of each companion file, such as a table that is written with the JSON file, by file name."""

    __repr__ = __str__ = Result.__repr__
    __hash__ = Result.__hash__

    def __eq__(self, other: object) -> bool:
        return equal_values(self, other)

    def content(self) -> dict[str, Any]:
        """Content of the file as JSON values: the format, and all fields that were set."""
        field_values = self.model_dump(mode="json", by_alias=True, exclude_unset=True)
        trailing_values = {name: value for name in ("recording", "files") if (value := field_values.pop(name, None))}
        return {"format": self.format} | field_values | trailing_values

    def text(self) -> str:
        """Text of the JSON file."""
        stream = io.StringIO()
        json.dump(self.content(), stream, indent=1, allow_nan=False)  # `dumps` would hold each part as an object
        return stream.getvalue() + "\n"

    @classmethod
    def companion_file_names(cls) -> tuple[str, ...]:
        """Names of all files that may be written with the JSON file: tables and other files."""
        return (*(table.file for table in cls.COMPANION_TABLES.values()), *cls.FURTHER_FILES)

    def companion_table_texts(self) -> dict[str, str]:
        """Contents of the tables that are written with the JSON file, by file name, as far as the result has them."""
        names = [name for name in self._table_makers() if name in self.COMPANION_TABLES]
        return {self.COMPANION_TABLES[name].file: self.table(name).csv_text() for name in names}

    def is_unchanged_companion(self, folder: Path, name: str) -> bool:
        """True if the companion file `name` (a table) in `folder` has the digest that this result contains for it.

        Raises RecordError if the file cannot be read.
        """
        return self.files.get(name) == _digest(read_bytes(folder / name))


def _digest(content: bytes) -> str:
    """Digest (SHA-256) of bytes, as hexadecimal text."""
    return hashlib.sha256(content).hexdigest()


def recording_digest(recording: Recording) -> str:
    """Digest (SHA-256) of the stations, targets, faces and readings of a recording.

    Readings are rounded to a micrometre and a microradian.
    """
    readings = recording.readings
    floored_steps = np.floor(np.nan_to_num(readings) / DIGEST_ROUNDING_STEP + DIGEST_ROUNDING_OFFSET).astype("<i8")
    rounded_steps = np.where(np.isfinite(readings), floored_steps, np.iinfo(np.int64).min).astype("<i8")
    names = [
        f"{recording.stations[s]}\t{recording.targets[t]}\t{face}"
        for s, t, face in zip(recording.station, recording.target, recording.face, strict=True)
    ]
    return _digest("\n".join(names).encode() + rounded_steps.tobytes())


ResultFileType = TypeVar("ResultFileType", bound=ResultFile)
"""Type of a result."""


def write_result(
    folder: Path, result: ResultFileType, further_files: Mapping[str, str | bytes] = MappingProxyType({})
) -> ResultFileType:
    """Copy of `result` with the digests of its companion files, after writing all its files into `folder`.

    The companion files are the tables of the result and `further_files`, contents by file name. Raises RecordError if
    the folder is not writable; no incomplete files remain.
    """
    companions = {**result.companion_table_texts(), **further_files}
    digests = {name: _digest(t.encode() if isinstance(t, str) else t) for name, t in companions.items()}
    written = result.model_copy(update={"files": digests})
    write_texts(folder, {**companions, result.FILE: written.text()})
    return written


def read_result(path: Path, model: type[ResultFileType]) -> ResultFileType:
    """Result from its JSON file, or from the folder with this file, validated by its `model`; raises RecordError."""
    file = path / model.FILE if path.is_dir() else path
    content = read_json(file, model.FILE, shares_equal_objects=model.SHARES_EQUAL_OBJECTS)
    version = content.get("format")
    expected = model.model_fields["format"].default
    if version != expected:
        raise RecordError(f"format is '{safe_excerpt(str(version))}', expected '{expected}'", file=file)
    _require_bounded_content(content, model.MAX_TEXTS, file)
    try:
        return model.model_validate(content)
    except ValidationError as problem:
        error = problem.errors()[0]
        key = "".join(f"{part}." for part in error["loc"])[:-1]
        wrong = safe_excerpt(error["msg"].removeprefix("Value error, "), 120)
        raise RecordError(f"{safe_excerpt(key, 100)}: {wrong}" if key else wrong, file=file) from None


def _require_bounded_content(content: Mapping[str, Any], max_texts: int, file: Path) -> None:
    """Check of the lengths of all lists, objects and texts of a result file before its model is built.

    Raises RecordError for a list or object of more than `MAX_RESULT_LIST_ENTRIES` entries, for long texts, and for more
    than `max_texts` texts, lists and objects together.
    """
    n_texts = n_characters = 0
    waiting: list[tuple[str, Any]] = [("the file", content)]
    while waiting:
        key, value = waiting.pop()
        if isinstance(value, str):
            n_characters += len(value)
            if len(value) > MAX_RESULT_TEXT_CHARACTERS:
                what = f"{safe_excerpt(key, 100)} has {len(value)} characters"
                raise RecordError(f"{what}, expected at most {MAX_RESULT_TEXT_CHARACTERS}", file=file)
        elif len(value) > MAX_RESULT_LIST_ENTRIES:
            what = f"{safe_excerpt(key, 100)} has {len(value)} entries"
            raise RecordError(f"{what}, expected at most {MAX_RESULT_LIST_ENTRIES}", file=file)
        else:
            parts = value.items() if isinstance(value, dict) else ((key, part) for part in value)
            waiting += [(name, part) for name, part in parts if isinstance(part, str | list | dict)]
        n_texts += 1
        if n_texts + len(waiting) > max_texts:
            raise RecordError(
                f"the file has more than {max_texts} texts, lists and objects, the limit for reading", file=file
            )
    if n_characters > (most := max_texts * MAX_RESULT_MEAN_TEXT_CHARACTERS):
        raise RecordError(
            f"the file has texts of {n_characters} characters, expected at most {most} together", file=file
        )


def read_json(file: Path, kind: str, *, shares_equal_objects: bool = False) -> dict[str, Any]:
    """Content of a JSON file with an object, as a dictionary; `kind` is the expected content, for errors.

    With `shares_equal_objects`, equal objects in the file become the same dictionary, which must not be changed. Raises
    RecordError for other content, for too many values, and for a number beyond `MAX_RESULT_MAGNITUDE`.
    """

    def checked_number(text: str, number_type: Callable[[str], float]) -> float:
        """Number in a JSON text; raises RecordError beyond `MAX_RESULT_MAGNITUDE`."""
        value = number_type(text) if len(text) <= 400 else math.inf
        if not abs(value) <= MAX_RESULT_MAGNITUDE:
            permitted = f"a finite number of at most {MAX_RESULT_MAGNITUDE:g} in magnitude"
            raise RecordError(f"the file contains the number {safe_excerpt(text)}, expected {permitted}", file=file)
        return value

    object_by_digest: dict[bytes, dict[str, Any]] = {}

    def shared_object(value: dict[str, Any]) -> dict[str, Any]:
        """First of all equal objects in the file, which is used in place of `value`."""
        return object_by_digest.setdefault(hashlib.sha256(repr(_comparison_key(value)).encode()).digest(), value)

    parse_decimal, parse_integer = (partial(checked_number, number_type=number_type) for number_type in (float, int))
    text = read_text(file)
    if text.count(",") + text.count("[") + text.count("{") > MAX_JSON_VALUES:
        raise RecordError(f"the file contains more than {MAX_JSON_VALUES} values, the limit for reading", file=file)
    try:
        content = json.loads(
            text,
            object_hook=shared_object if shares_equal_objects else None,
            parse_float=parse_decimal,
            parse_constant=parse_decimal,
            parse_int=parse_integer,
        )
    except (json.JSONDecodeError, RecursionError):
        raise RecordError(f"the file is not JSON; expected a {kind}", file=file) from None
    if not isinstance(content, dict):
        raise RecordError(f"the file contains no JSON object; expected a {kind}", file=file)
    return content


def _comparison_key(value: Any) -> Any:
    """Key of a JSON value that equal values have in common, if equal objects in it are the same dictionary.

    Numbers of different types or signs of zero are different. The work is proportional to the size of `value` without
    the objects in it.
    """
    if isinstance(value, dict):
        return [(name, id(part) if isinstance(part, dict) else _comparison_key(part)) for name, part in value.items()]
    if isinstance(value, list):
        return [("object", id(part)) if isinstance(part, dict) else _comparison_key(part) for part in value]
    return ascii(value)


def companion_path(folder: Path, name: str, result: ResultFile) -> Path | None:
    """Path of the companion file `name` (such as a table) of a result in `folder`; None if there is no such file.

    Raises RecordError if the file belongs to another result or was changed.
    """
    file = folder / name
    if not file.is_file():
        return None
    if result.files and not result.is_unchanged_companion(folder, name):
        raise RecordError(
            f"the file does not belong to {result.FILE} in the same folder, or was changed; run the command again",
            file=file,
        )
    return file


def require_same_recording(result: ResultFile, recording: Recording | None, folder: Path) -> None:
    """Check that `result` was computed from this recording; None as recording is accepted.

    Raises RecordError, which names the file of the result in `folder`.
    """
    source = result.recording
    if recording is None or source is None or source.digest == recording_digest(recording):
        return
    title = f"'{safe_excerpt(source.title)}', " if source.title else ""
    raise RecordError(
        f"the file is the result of another recording ({title}{source.pointings} pointings) than the given one "
        f"({len(recording)} pointings)",
        file=folder / result.FILE,
    )
