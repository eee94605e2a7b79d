"""Reading and writing of `setup.toml`; errors name the key, its value and the permitted values."""

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

from ltsim.core.errors import ModelError, RecordError, as_input_error
from ltsim.core.limits import (
    MAX_TOML_BYTES,
    MAX_TOML_DEPTH,
    MAX_TOML_KEYS,
    MAX_TOML_TEXT_CHARACTERS,
    MAX_TOML_VALUES,
    MAX_TOML_WORD_CHARACTERS,
)
from ltsim.recordings.files import SourceLocation, quoted_text, read_text, with_unix_line_ends
from ltsim.recordings.setup import Instrument, Setup

SettingsType = TypeVar("SettingsType", bound=BaseModel)
_TOML_TOKEN_PATTERN = re.compile(
    r'"""(?:[^"\\]++|\\.|"{1,2}(?!"))*+(?:"{3,5})?+|"(?:[^"\\\n]++|\\.)*+"?+|#[^\n]*+|[][{}=,.\n]'
    r"|'''(?:[^']++|'{1,2}(?!'))*+(?:'{3,5})?+|'[^'\n]*+'?+"
    rf"|(?<![\w+:-])[\w+:-]{{{MAX_TOML_WORD_CHARACTERS + 1},}}+",
    re.DOTALL,
)
"""Pattern of strings, comments, structural characters and too long words of TOML, from which keys, values and depth are
counted. A string that is not closed, which is no TOML, is one token, so that no character is looked at twice.
"""
_COMPLETE_LINE_ENDS = ("\n", '"', "'", "]", "}", "true", "false")
"""Ends of the last line of a complete TOML file."""


def read_setup(path: Path) -> Setup:
    """Set-up from the file `setup.toml`; raises RecordError."""
    return validate_setup(read_toml(path, "set-up"), path)


def read_toml(path: Path, kind: str) -> dict[str, Any]:
    """Tables of a TOML file; `kind` is the expected content, for errors. Raises RecordError."""
    text = with_unix_line_ends(read_text(path, max_bytes=MAX_TOML_BYTES))
    if not text.endswith(_COMPLETE_LINE_ENDS) and not text.splitlines()[-1].lstrip().startswith("#"):
        message = "has no line break after its last value and may be incomplete; add the line break if it is complete"
        raise RecordError(message, file=path)
    check_toml_limits(text, path)
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, ValueError) as problem:
        raise RecordError(f"is not TOML: {_single_line(problem)}", file=path) from None
    except RecursionError:
        raise RecordError(f"is nested too deeply to be a {kind}", file=path) from None


def check_toml_limits(text: str, file: object) -> None:
    """Check of the number of keys and values, and of the depth of tables, in a TOML text before it is parsed.

    Strings and comments are skipped. Each part of a dotted key counts as a key. Each part, and each bracket around it,
    adds one to the depth. Raises RecordError, also for a key, number or text with too many characters.
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
            raise RecordError(f"holds more than {what}, the limit for reading", file=file)


def _line_number_of_token(token: re.Match[str]) -> int:
    """Number of the line in which a token begins, from 1."""
    return token.string.count("\n", 0, token.start()) + 1


def validate_setup(setup_tables: Mapping[str, Any], file: object) -> Setup:
    """Set-up from the tables of a file; `file` is named in errors. Raises RecordError."""
    tables = with_completed_instruments(
        setup_tables, lambda table, place: _with_data_sheet_defaults(table, place, file)
    )
    setup = validate_settings(tables, Setup, "set-up", file)
    _check_names(setup, file)
    return setup


def with_completed_instruments(tables: Mapping[str, Any], complete_table: Callable[[Any, str], Any]) -> dict[str, Any]:
    """Tables of a file in which the table of each instrument is replaced by the result of `complete_table(table, key)`.

    `key` is ``instrument`` or ``instruments.NAME``.
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
    """Entries of `table`, and those of `defaults` whose keys `table` lacks; nested tables are merged recursively."""
    common_keys = [
        key for key, value in defaults.items() if isinstance(value, dict) and isinstance(table.get(key), dict)
    ]
    return {**defaults, **table, **{key: merge_defaults(table[key], defaults[key]) for key in common_keys}}


def validate_settings(tables: Mapping[str, Any], model: type[SettingsType], kind: str, file: object) -> SettingsType:
    """Tables of a file validated against their model; `kind` is the expected content, `file` is named in errors.

    Raises
    ------
    RecordError
        The key, its value and the permitted values. A misspelt key is reported first.
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
        raise RecordError(f"contains a value that is not possible in a {kind}", file=file) from None


def load_settings(path: Path, model: type[SettingsType], kind: str) -> SettingsType:
    """Settings from a user-written file, validated against their `model`; `kind` is the expected content, for errors.

    Raises InputError.
    """
    with as_input_error():
        return validate_settings(read_toml(path, kind), model, kind, path)


def _single_line(problem: Exception) -> str:
    return quoted_text(" ".join(str(problem).split()), 160)


def _check_names(setup: Setup, file: object) -> None:
    """Check of a set-up: permitted names, declared instruments, two different ends of each length and each difference.

    Raises RecordError, which names `file`.
    """
    for kind, names in (
        ("station", setup.stations),
        ("target", setup.targets),
        ("instrument", setup.instruments),
        ("reflector", setup.reflectors),
    ):
        for name in names:
            SourceLocation(file).name(name, kind)
    for name, station in setup.stations.items():
        instrument_name = station.instrument
        if instrument_name is not None and instrument_name not in setup.instruments:
            names_of_tables = ", ".join(_similar_names(instrument_name, setup.instruments)) or "none is declared"
            where = SourceLocation(file, column=f"stations.{name}.instrument")
            raise where.error(
                f"there is no table [instruments.{quoted_text(instrument_name)}]; instruments: {names_of_tables}"
            )
    for i, length in enumerate(setup.gauge.distance if setup.gauge else ()):
        if length.from_ == length.to:
            where = SourceLocation(file, column=f"gauge.distance {i + 1}")
            raise where.error(f"a length from '{quoted_text(length.to)}' to itself, expected two different targets")
    labels = [difference.label for difference in setup.differences]
    for i, difference in enumerate(setup.differences):
        where = SourceLocation(file, column=f"differences {i + 1}")
        if difference.from_ == difference.to:
            raise where.error(
                f"a difference from '{quoted_text(difference.to)}' to itself, expected two different marks"
            )
        if difference.label in labels[:i]:
            raise where.error(
                f"another difference is named '{quoted_text(difference.label)}', too; set a different name (key name)"
            )


def _similar_names(name: str, candidates: Any) -> list[str]:
    choices = sorted(str(k) for k in candidates)
    return difflib.get_close_matches(name, choices, n=3, cutoff=0.5) or choices[:12]


def validation_sentence(error: ErrorDetails, root: type[BaseModel]) -> str:
    """Sentence on a validation error in a file described by the model `root`: key, value, permitted values."""
    # pydantic's own parts hold brackets: "[key]", a member of a union; the last of an unknown key is a person's
    verbatim_index = len(error["loc"]) - 1 if error["type"] == "extra_forbidden" else -1
    path_parts = [part for i, part in enumerate(error["loc"]) if i == verbatim_index or "[" not in str(part)]
    key = ".".join(str(p + 1) if isinstance(p, int) else p for p in path_parts)
    value = quoted_text(json.dumps(error["input"], default=str), 60)
    if error["type"] == "extra_forbidden":
        keys = _permitted_keys(root, path_parts[:-1])
        inside = {
            name: f"{table}.{name}" for table in keys for name in _permitted_keys(root, [*path_parts[:-1], table])
        }
        close_to = partial(difflib.get_close_matches, str(path_parts[-1]), cutoff=0.7)
        near = (
            close_to(keys) or [inside[name] for name in close_to(inside)] or _similar_names(str(path_parts[-1]), keys)
        )
        return f"unknown key {quoted_text(key, 100)}; did you mean {', '.join(near)}?"
    if error["type"] == "missing":
        return f"the key {quoted_text(key, 100)} is missing"
    message = error["msg"][0].lower() + error["msg"][1:]
    expected = quoted_text(_reworded_message(message), 120)
    if choices := re.findall("'([^']*)'", message) if error["type"] == "literal_error" else []:
        near = difflib.get_close_matches(str(error["input"]), choices, n=1, cutoff=0.5)
        expected = f"it should be {', '.join(choices)}" + (
            f"; did you mean {near[0]}?" if near and len(choices) > 1 else ""
        )
    return f"{quoted_text(key, 100)} is {value}, but {expected}" if key else expected


def _permitted_keys(root: type[BaseModel], path: Iterable[object]) -> list[str]:
    return [key for _, nodes in schemas_at(root, path) for node in nodes for key in node.get("properties", {})]


_COUNT_PATTERN = re.compile(
    r"^(?:tuple|list|dictionary) should have (at most|at least) (\d+) items? after validation, not (?:\d+|more)"
)
"""Pattern of pydantic's message on a list with too many or too few entries."""


def _reworded_message(message: str) -> str:
    """Message of a validation error in the wording of ltsim: `it should ...`."""
    return _COUNT_PATTERN.sub(
        r"it should hold \1 \2", message.replace("input should", "it should").removeprefix("value error, ")
    )


JsonSchema = dict[str, Any]


@lru_cache
def _model_schema(root: type[BaseModel]) -> JsonSchema:
    return root.model_json_schema(by_alias=True)


def schemas_at(root: type[BaseModel], path: Iterable[object]) -> list[tuple[JsonSchema, list[JsonSchema]]]:
    """JSON schemas of the value at a `path` of keys in the model `root`, each with the schemas of its alternatives."""

    def choices(node: JsonSchema) -> list[JsonSchema]:
        """Alternative schemas of a node, with references resolved; the node itself if it has no alternatives."""
        if "$ref" in node:
            return choices(_model_schema(root)["$defs"][node["$ref"].rpartition("/")[2]])
        return [choice for entry in node["anyOf"] for choice in choices(entry)] if "anyOf" in node else [node]

    nodes = [_model_schema(root)]
    for part in map(str, path):
        nodes = [
            schema for node in nodes for choice in choices(node) if (schema := _schema_below(choice, part)) is not None
        ]
    return [(node, choices(node)) for node in nodes]


def _schema_below(node: JsonSchema, path_part: str) -> JsonSchema | None:
    """JSON schema of the value of one key (or list index) of a node; None if the node has no such value."""
    schema = node.get("properties", {}).get(path_part) or node.get("additionalProperties")
    schema = schema or (node.get("items") if path_part.isdecimal() else None)
    return schema if isinstance(schema, dict) else None


def setup_to_toml(setup: Setup, file: object) -> str:
    """Text of a `setup.toml`, named `file` in errors, from which `read_setup` obtains the same set-up.

    Tables of instruments and of the gauge have all keys; tables of stations and targets have only keys whose values
    differ from the defaults. The unnamed instrument is left out if named ones exist and it has only defaults.

    Raises RecordError for a set-up of more keys than are read.
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
    if _n_keys(table) > MAX_TOML_KEYS:
        message = f"would hold more than {MAX_TOML_KEYS} keys and tables, the limit for reading"
        raise RecordError(f"{message}; divide the recording by station", file=file)
    return to_toml(table)


def _n_keys(value: Any) -> int:
    """Number of keys in nested tables."""
    if isinstance(value, Mapping):
        return len(value) + sum(map(_n_keys, value.values()))
    return sum(map(_n_keys, value)) if isinstance(value, list | tuple) else 0


def to_toml(table: Mapping[str, Any]) -> str:
    """Text of a TOML file for nested tables, with arrays on one line."""
    import tomlkit  # its import takes 0.02 s, which reading does not need

    return tomlkit.dumps(table).strip() + "\n"
