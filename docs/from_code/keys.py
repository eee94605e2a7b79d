"""Tables of the keys of a file, from the pydantic model that reads or writes it."""

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

from pydantic import BaseModel

from ltsim.core.units import unit_of_key

HUGE = 1e8
"""Absolute value of a bound from which the table does not show it: it only rejects absurd numbers."""
FIXED = ("`format`", "`title`")
"""Keys that a campaign cannot vary."""
KINDS = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true or false", "null": "nothing"}


def tables(model: str) -> str:
    """Markdown with headings and tables of keys for a TOML file and each table in it.

    Parameters
    ----------
    model : str
        Module and class of the model, as in ``ltsim.planning.spec:PlanFile``.
    """
    module, _, name = model.partition(":")
    return sections(getattr(import_module(module), name), _toml, "##", defaults=True)


def dotted(model: str) -> str:
    """Markdown table of every dotted key of a file, as a campaign uses it; N is the position in a list of tables."""
    module, _, name = model.partition(":")
    schema = getattr(import_module(module), name).model_json_schema()
    rows: list[list[str]] = []
    known: dict[str, str] = {}

    def add(path: str, table: dict[str, Any]) -> None:
        if table["title"] in known:
            rows.append([f"`{path}*`", "", "", f"As `{known[table['title']]}*`."])
            return
        known[table["title"]] = path
        for key, entry in table["properties"].items():
            inner = _inner(key, entry, schema)
            where = f"{path}{key}"
            if inner is not None:
                add(f"{where}{ {'one': '', 'named': '.NAME', 'several': '.N'}[inner[1]] }.", inner[2])
                continue
            named = ".NAME" if entry.get("type") == "object" else ""
            taken = entry.get("additionalProperties") if named else entry
            said = values(taken if isinstance(taken, dict) else entry, schema)
            rows.append([f"`{where}{named}`", said, unit(key), meaning(entry)])

    add("", schema)
    return "\n".join(markdown(["key", "value", "unit", "meaning"], [row for row in rows if row[0] not in FIXED]))


def sections(
    model: type[BaseModel], place: Callable[[str, str, str], str], heading: str, *, defaults: bool = False
) -> str:
    """Markdown for a file and its tables; `place` makes the path of a table from parent, multiplicity and key."""
    schema = model.model_json_schema()
    lines: list[str] = []
    todo = [("", schema)]
    while todo:
        path, table = todo.pop(0)
        lines += ["", f"{heading} `{path}`"] if path else []
        lines += ["", about(table.get("description", "")), "", *_table(table, schema, defaults=defaults)]
        inner = [_inner(key, entry, schema) for key, entry in table["properties"].items()]
        todo = [(place(path, how, key), found) for key, how, found in filter(None, inner)] + todo
    return "\n".join(lines)


def _toml(path: str, how: str, key: str) -> str:
    name = ".".join(filter(None, (path.strip("[]"), key)))
    return {"one": f"[{name}]", "named": f"[{name}.NAME]", "several": f"[[{name}]]"}[how]


def json_place(path: str, how: str, key: str) -> str:
    """Path of a table in a JSON file."""
    name = ".".join(filter(None, (path, key)))
    return {"one": name, "named": f"{name}.NAME", "several": f"{name}[]"}[how]


def _table(table: dict[str, Any], schema: dict[str, Any], *, defaults: bool) -> list[str]:
    """Markdown table of the keys of one table that have values, without empty columns."""
    own = {key: entry for key, entry in table["properties"].items() if _inner(key, entry, schema) is None}
    rows = [
        [f"`{key}`", values(entry, schema), unit(key), default(key, entry, table) if defaults else "", meaning(entry)]
        for key, entry in own.items()
    ]
    return markdown(["key", "value", "unit", "default", "meaning"], rows)


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Markdown table without empty columns."""
    kept = [i for i in range(len(header)) if any(row[i] for row in rows)]
    lines = [[header[i] for i in kept], ["---"] * len(kept), *([row[i] for i in kept] for row in rows)]
    cells = [[cell.replace("|", "\\|").replace("\n", " ") for cell in line] for line in lines]
    return ["| " + " | ".join(line) + " |" for line in cells] if kept else []


def _inner(key: str, entry: dict[str, Any], schema: dict[str, Any]) -> tuple[str, str, dict[str, Any]] | None:
    """Key, multiplicity and schema of the table that an entry contains; None for an entry with a value."""
    for choice in entry.get("anyOf", [entry]):
        further, items = choice.get("additionalProperties"), choice.get("items")
        for how, found in (("one", choice), ("named", further), ("several", items)):
            if isinstance(found, dict) and "$ref" in found:
                return key, how, schema["$defs"][found["$ref"].rpartition("/")[2]]
    return None


def about(docstring: str) -> str:
    """Class docstring as Markdown: double back-quotes become single ones."""
    return docstring.replace("``", "`")


def meaning(entry: dict[str, Any]) -> str:
    """Meaning of a key."""
    return about(entry.get("description", ""))


def unit(key: str) -> str:
    """Unit in the name of a key."""
    return unit_of_key(key).replace("um", "µm")


def default(key: str, entry: dict[str, Any], table: dict[str, Any]) -> str:
    """Default of a key, as text."""
    if key in table.get("required", ()):
        return "required"
    value = entry.get("default")
    if value is None or value in ("", [], {}):
        return ""
    return f"`{_shown(value)}`"


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return "[" + ", ".join(_shown(one) for one in value) + "]"
    return f'"{value}"' if isinstance(value, str) else f"{value:g}"


def values(entry: dict[str, Any], schema: dict[str, Any]) -> str:
    """Text on the permitted values of an entry."""
    if "$ref" in entry:
        return "table"
    if "anyOf" in entry:
        return " or ".join(values(one, schema) for one in entry["anyOf"] if one.get("type") != "null")
    if "const" in entry or "enum" in entry:
        return ", ".join(f"`{_shown(one)}`" for one in entry.get("enum", [entry.get("const")]))
    if entry.get("type") == "array":
        return _list(entry, schema)
    if entry.get("type") == "object":
        further = entry.get("additionalProperties")
        return "table of " + values(further, schema) if isinstance(further, dict) else "table"
    return (KINDS[entry["type"]] if "type" in entry else "any value") + _bounds(entry)


def _list(entry: dict[str, Any], schema: dict[str, Any]) -> str:
    items = entry.get("prefixItems")
    if items:
        return f"list of {len(items)}: {values(items[0], schema)}"
    least, most = entry.get("minItems"), entry.get("maxItems")
    count = f"{least} times " if least is not None and least == most else ""
    if most == 0:
        return "empty list"
    return f"list of {count}{values(entry['items'], schema)}"


def _bounds(entry: dict[str, Any]) -> str:
    low, high = entry.get("minimum"), entry.get("maximum")
    above, below = entry.get("exclusiveMinimum"), entry.get("exclusiveMaximum")
    if low is not None and high is not None and max(abs(low), high) < HUGE:
        return f", {low:g} to {high:g}"
    bounds = [f"> {above:g}"] if above is not None else [f"≥ {low:g}"] if low is not None and abs(low) < HUGE else []
    bounds += [f"< {below:g}"] if below is not None and below < HUGE else []
    bounds += [f"≤ {high:g}"] if high is not None and high < HUGE else []
    return " " + " and ".join(bounds) if bounds else ""
