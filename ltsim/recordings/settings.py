"""Reading, validation and writing of `setup.toml`; errors name the key, its value and the permitted values."""

import difflib
import json
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from ltsim.core.errors import ModelError, RecordError, reraise_as_input_error
from ltsim.core.limits import (
    MAX_TOML_BYTES,
    MAX_TOML_DEPTH,
    MAX_TOML_KEYS,
    MAX_TOML_TEXT_CHARACTERS,
    MAX_TOML_VALUES,
    MAX_TOML_WORD_CHARACTERS,
)
from ltsim.recordings.files import SourceLocation, read_text, safe_excerpt, with_unix_line_ends
from ltsim.recordings.setup import Instrument, Setup

SettingsType = TypeVar("SettingsType", bound=BaseModel)
"""Type of the pydantic model that describes a TOML file."""
_TOML_TOKEN_PATTERN = re.compile(
    r'"""(?:[^"\\]++|\\.|"{1,2}(?!"))*+(?:"{3,5})?+|"(?:[^"\\\n]++|\\.)*+"?+|#[^\n]*+|[][{}=,.\n]'
    r"|'''(?:[^']++|'{1,2}(?!'))*+(?:'{3,5})?+|'[^'\n]*+'?+"
    rf"|(?<![\w+:-])[\w+:-]{{{MAX_TOML_WORD_CHARACTERS + 1},}}+",
    re.DOTALL,
)
"""Pattern of the parts of a TOML text (strings, comments, structural characters, too long words) from which keys,
values and depth are counted. A string without closing quotes, which is not valid TOML, is one part, so that the time
does not grow with the square of its length."""
_COMPLETE_TOML_ENDS = ("\n", '"', "'", "]", "}", "true", "false")
"""Texts with which a complete TOML file can end, besides a comment."""


def read_setup(path: Path) -> Setup:
    """Set-up from a file `setup.toml`; raises RecordError."""
    return validate_setup(read_toml(path, "set-up"), path)


def read_toml(path: Path, kind: str) -> dict[str, Any]:
    """Content of a TOML file as nested tables; `kind` is the expected content, for errors. Raises RecordError."""
    text = with_unix_line_ends(read_text(path, max_bytes=MAX_TOML_BYTES))
    if not text.endswith(_COMPLETE_TOML_ENDS) and not text.splitlines()[-1].lstrip().startswith("#"):
        message = "ends without a line break and may be incomplete; if it is complete, add a line break at its end"
        raise RecordError(message, file=path)
    check_toml_limits(text, path)
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, ValueError) as problem:
        raise RecordError(f"is not TOML: {_message_without_line_breaks(problem)}", file=path) from None
    except RecursionError:
        raise RecordError(f"the file is nested too deeply to be a {kind}", file=path) from None


def check_toml_limits(text: str, file: object) -> None:
    """Check of the number of keys and values and of the depth of tables in a TOML text, before it is parsed.

    Strings and comments do not count. Each part of a dotted key counts as a key. Each part, and each bracket around it,
    adds one to the depth. Raises RecordError, which names `file`, also for too long keys, numbers and texts.
    """
    keys = values = brackets = parts = line = 0
    is_header = False
    for token in _TOML_TOKEN_PATTERN.finditer(text):
        mark = token[0]
        if mark in "\n=":
            keys += parts if is_header or mark == "=" else 0
            is_header = False
        if mark == "[" and token.start() == line:
            is_header, keys = True, keys + 1
        values += mark in "=[{,"
        keys += mark in "={"
        if mark in "[{":
            brackets, parts = brackets + 1, 0
        elif mark in "]}":
            brackets = max(brackets - 1, 0)
        elif mark == ".":
            parts += 1
        elif mark in "\n=,":
            line, parts = token.end() if mark == "\n" else line, 0
        elif mark[0] != "#" and len(mark) > (
            most := MAX_TOML_TEXT_CHARACTERS if mark[0] in "\"'" else MAX_TOML_WORD_CHARACTERS
        ):
            kind = "text" if mark[0] in "\"'" else "key or number"
            raise SourceLocation(file, _line_number_of_token(token)).error(
                f"a {kind} is longer than {most} characters, the limit for reading"
            )
        if brackets + parts > MAX_TOML_DEPTH:
            raise SourceLocation(file, _line_number_of_token(token)).error(
                f"tables or keys are nested deeper than {MAX_TOML_DEPTH}, the limit for reading"
            )
        if keys > MAX_TOML_KEYS or values > MAX_TOML_VALUES:
            what = f"{MAX_TOML_KEYS} keys and tables or {MAX_TOML_VALUES} values"
            raise RecordError(f"the file holds more than {what}, the limit for reading", file=file)


def _line_number_of_token(token: re.Match[str]) -> int:
    """Number of the line in which a token begins, from 1."""
    return token.string.count("\n", 0, token.start()) + 1


def validate_setup(setup_tables: Mapping[str, Any], file: object) -> Setup:
    """Set-up from the tables of its file; `file` is named in errors. Raises RecordError."""
    tables = with_completed_instruments(
        setup_tables, lambda table, place: _with_data_sheet_defaults(table, place, file)
    )
    setup = validate_settings(tables, Setup, "set-up", file)
    _check_setup_names(setup, file)
    return setup


def with_completed_instruments(tables: Mapping[str, Any], complete_table: Callable[[Any, str], Any]) -> dict[str, Any]:
    """Copy of the tables of a set-up in which each instrument's table is the result of `complete_table(table, key)`.

    The key is ``instrument`` or ``instruments.NAME``.
    """
    completed, named_instruments = dict(tables), tables.get("instruments")
    if isinstance(named_instruments, dict):
        completed["instruments"] = {
            name: complete_table(table, f"instruments.{name}") for name, table in named_instruments.items()
        }
    if "instrument" in tables:
        completed["instrument"] = complete_table(tables["instrument"], "instrument")
    return completed


def _with_data_sheet_defaults(table: Any, place: str, file: object) -> Any:
    """Table of an instrument, completed by the values of the data sheet that it names; `place` is its key."""
    if not isinstance(table, dict) or not isinstance(table.get("sheet"), str):
        return table
    from ltsim.recordings.specification import (  # most files name no sheet and need not wait
        data_sheet_values,
        noise_and_prior_tables,
    )

    try:
        defaults = noise_and_prior_tables(table["sheet"], table)
    except ModelError as problem:
        raise RecordError(str(problem), file=file, column=f"{place}.sheet") from None
    return merge_defaults({"model": data_sheet_values(table["sheet"])["name"], **table}, defaults)


def merge_defaults(table: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Entries of `table`, completed by those of `defaults` whose keys `table` lacks; so are nested tables."""
    common_keys = [
        key for key, value in defaults.items() if isinstance(value, dict) and isinstance(table.get(key), dict)
    ]
    return {**defaults, **table, **{key: merge_defaults(table[key], defaults[key]) for key in common_keys}}


def validate_settings(tables: Mapping[str, Any], model: type[SettingsType], kind: str, file: object) -> SettingsType:
    """Content of a TOML file as an object of its `model`; `kind` is the expected content, `file` is named in errors.

    Raises
    ------
    RecordError
        Key, its value and the permitted values. A misspelt key is reported first.
    """
    expected_format = model.model_fields["format"].default
    if "format" not in tables:
        raise RecordError(f'the key format is missing, expected format = "{expected_format}"', file=file)
    try:
        return model.model_validate_json(json.dumps(tables, default=str), strict=True)
    except ValidationError as problem:
        errors = problem.errors()
        misspelt = [error for error in errors if error["type"] == "extra_forbidden"]
        raise RecordError(validation_sentence((misspelt or errors)[0], model), file=file) from None
    except (ValueError, RecursionError):
        raise RecordError(f"the file contains a value that is not possible in a {kind}", file=file) from None


def load_settings(path: Path, model: type[SettingsType], kind: str) -> SettingsType:
    """Content of a TOML file written by a user, as an object of its `model`; `kind` names it in errors.

    Raises InputError.
    """
    with reraise_as_input_error():
        return validate_settings(read_toml(path, kind), model, kind, path)


def _message_without_line_breaks(problem: Exception) -> str:
    """Message of an error on one line."""
    return safe_excerpt(" ".join(str(problem).split()), 160)


def _check_setup_names(setup: Setup, file: object) -> None:
    """Check of a set-up: permitted names, declared instruments, and two different ends of each length and difference.

    Raises RecordError, which names `file`.
    """
    for kind, names in (
        ("station", setup.stations),
        ("target", setup.targets),
        ("instrument", setup.instruments),
        ("reflector", setup.reflectors),
    ):
        for name in names:
            SourceLocation(file).checked_name(name, kind)
    for name, station in setup.stations.items():
        instrument_name = station.instrument
        if instrument_name is not None and instrument_name not in setup.instruments:
            names_of_tables = ", ".join(_similar_names(instrument_name, setup.instruments)) or "none is declared"
            where = SourceLocation(file, column=f"stations.{name}.instrument")
            raise where.error(
                f"there is no table [instruments.{safe_excerpt(instrument_name)}]; instruments: {names_of_tables}"
            )
    for i, length in enumerate(setup.gauge.distance if setup.gauge else ()):
        if length.from_ == length.to:
            where = SourceLocation(file, column=f"gauge.distance {i + 1}")
            raise where.error(f"the length is from '{safe_excerpt(length.to)}' to itself, expected two targets")
    labels = [difference.label for difference in setup.differences]
    for i, difference in enumerate(setup.differences):
        where = SourceLocation(file, column=f"differences {i + 1}")
        if difference.from_ == difference.to:
            raise where.error(f"the difference is from '{safe_excerpt(difference.to)}' to itself, expected two marks")
        if difference.label in labels[:i]:
            raise where.error(
                f"another difference is named '{safe_excerpt(difference.label)}', too; set a different name (key name)"
            )


def _similar_names(name: str, candidates: Any) -> list[str]:
    """Candidates, at most three, whose spelling is similar to that of `name`."""
    choices = sorted(str(k) for k in candidates)
    return difflib.get_close_matches(name, choices, n=3, cutoff=0.5) or choices[:12]


def validation_sentence(error: ErrorDetails, root: type[BaseModel]) -> str:
    """Sentence on a validation error in a TOML file with the model `root`: key, value, and permitted values."""
    # pydantic's own parts hold brackets: "[key]", a member of a union; the last of an unknown key is a person's
    verbatim_index = len(error["loc"]) - 1 if error["type"] == "extra_forbidden" else -1
    path_parts = [part for i, part in enumerate(error["loc"]) if i == verbatim_index or "[" not in str(part)]
    key = ".".join(str(p + 1) if isinstance(p, int) else p for p in path_parts)
    value = safe_excerpt(json.dumps(error["input"], default=str), 60)
    if error["type"] == "extra_forbidden":
        keys = _permitted_keys(root, path_parts[:-1])
        inside = {
            name: f"{table}.{name}" for table in keys for name in _permitted_keys(root, [*path_parts[:-1], table])
        }
        close_to = partial(difflib.get_close_matches, str(path_parts[-1]), cutoff=0.7)
        near = (
            close_to(keys) or [inside[name] for name in close_to(inside)] or _similar_names(str(path_parts[-1]), keys)
        )
        return f"unknown key {safe_excerpt(key, 100)}; did you mean {', '.join(near)}?"
    if error["type"] == "missing":
        return f"the key {safe_excerpt(key, 100)} is missing"
    message = error["msg"][0].lower() + error["msg"][1:]
    expected = safe_excerpt(_reworded_message(message), 120)
    if choices := re.findall("'([^']*)'", message) if error["type"] == "literal_error" else []:
        near = difflib.get_close_matches(str(error["input"]), choices, n=1, cutoff=0.5)
        expected = f"it should be {', '.join(choices)}" + (
            f"; did you mean {near[0]}?" if near and len(choices) > 1 else ""
        )
    return f"{safe_excerpt(key, 100)} is {value}, but {expected}" if key else expected


def _permitted_keys(root: type[BaseModel], path: Iterable[object]) -> list[str]:
    """Keys that the table at a `path` of keys in the model `root` may have."""
    return [key for _, nodes in json_schemas_at(root, path) for node in nodes for key in node.get("properties", {})]


_COUNT_PATTERN = re.compile(
    r"^(?:tuple|list|dictionary) should have (at most|at least) (\d+) items? after validation, not (?:\d+|more)"
)
"""Pattern of the message of pydantic on a list with too many or too few entries."""


def _reworded_message(message: str) -> str:
    """Message of pydantic on a wrong value, reworded to `it should ...`."""
    return _COUNT_PATTERN.sub(
        r"it should hold \1 \2", message.replace("input should", "it should").removeprefix("value error, ")
    )


JsonSchema = dict[str, Any]
"""Schema of a value in the notation of JSON Schema."""


@lru_cache
def _model_schema(root: type[BaseModel]) -> JsonSchema:
    """JSON schema of a pydantic model."""
    return root.model_json_schema(by_alias=True)


def json_schemas_at(root: type[BaseModel], path: Iterable[object]) -> list[tuple[JsonSchema, list[JsonSchema]]]:
    """JSON schemas of the value at a `path` of keys in the model `root`, with their alternatives ("number or text")."""

    def choices(node: JsonSchema) -> list[JsonSchema]:
        """Alternatives of a schema, with references resolved; the schema itself if it has none."""
        if "$ref" in node:
            return choices(_model_schema(root)["$defs"][node["$ref"].rpartition("/")[2]])
        return [choice for entry in node["anyOf"] for choice in choices(entry)] if "anyOf" in node else [node]

    nodes = [_model_schema(root)]
    for part in map(str, path):
        nodes = [
            schema for node in nodes for choice in choices(node) if (schema := _schema_of_key(choice, part)) is not None
        ]
    return [(node, choices(node)) for node in nodes]


def _schema_of_key(node: JsonSchema, path_part: str) -> JsonSchema | None:
    """JSON schema of a key (or list index) in a table with the schema `node`; None if there is no such key."""
    schema = node.get("properties", {}).get(path_part) or node.get("additionalProperties")
    schema = schema or (node.get("items") if path_part.isdecimal() else None)
    return schema if isinstance(schema, dict) else None


def setup_to_toml(setup: Setup, file: object) -> str:
    """Text of a `setup.toml` from which `read_setup` obtains an equal set-up; `file` is named in errors.

    Tables of instruments and of the gauge contain all keys. Tables of stations and targets contain only values that
    differ from the defaults. The unnamed instrument is omitted if it has only defaults and there are named instruments.

    Raises RecordError for a set-up with more keys than can be read.
    """
    tables = {"instrument", "instruments", "gauge", "stations", "targets", "reflectors"}
    table: dict[str, Any] = {"format": setup.format, "title": setup.title}
    table |= setup.model_dump(by_alias=True, exclude_defaults=True, exclude=tables)
    if not setup.instruments or setup.instrument != Instrument():
        table["instrument"] = setup.instrument.model_dump(by_alias=True, exclude_none=True)
    instrument_tables = {n: i.model_dump(by_alias=True, exclude_none=True) for n, i in setup.instruments.items()}
    table["instruments"] = instrument_tables
    if setup.gauge is not None:
        lengths = [d.model_dump(by_alias=True, exclude_defaults=True) for d in setup.gauge.distance]
        table["gauge"] = setup.gauge.model_dump(exclude_none=True) | {"distance": lengths}
    for kind in ("stations", "targets", "reflectors"):
        entries: dict[str, BaseModel] = getattr(setup, kind)
        table[kind] = {n: e.model_dump(by_alias=True, exclude_defaults=True) for n, e in entries.items()}
    if _count_keys(table) > MAX_TOML_KEYS:
        message = f"would hold more than {MAX_TOML_KEYS} keys and tables, the limit for reading"
        raise RecordError(f"{message}; divide the recording by station", file=file)
    return to_toml(table)


def _count_keys(value: Any) -> int:
    """Number of keys in nested tables."""
    if isinstance(value, Mapping):
        return len(value) + sum(map(_count_keys, value.values()))
    return sum(map(_count_keys, value)) if isinstance(value, list | tuple) else 0


def to_toml(table: Mapping[str, Any]) -> str:
    """Text of a TOML file with nested tables; each array is on one line."""
    import tomlkit  # its import takes 0.02 s, which reading does not need

    return tomlkit.dumps(table).strip() + "\n"
