"""Dotted keys of a scenario, such as `work.faces`: types and units of their values, and conversion of units."""

from typing import Any, Literal

from ltsim.core.errors import InputError, LtsimError
from ltsim.core.units import parse_quantity_in_unit, unit_of_key
from ltsim.physics.effects import find_effect
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.settings import json_schemas_at
from ltsim.simulation.physics import make_scenario_construction
from ltsim.simulation.scenario import Scenario

KeyValueType = Literal["number", "integer", "boolean", "string", "table"]
"""Type of the value of a scenario key."""
SCALAR_VALUE_TYPES: tuple[KeyValueType, ...] = ("number", "integer", "boolean", "string")
"""Types of the values of scenario keys that are not tables."""


def value_type_of_key(dotted_key: str) -> KeyValueType:
    """Type of the value of a dotted key; `table` for a list, a table or an unknown key."""
    kinds = {
        _schema_type(choice) for _, choices in json_schemas_at(Scenario, dotted_key.split(".")) for choice in choices
    }
    return next((kind for kind in SCALAR_VALUE_TYPES if kind in kinds), "table")


def key_description(dotted_key: str) -> str:
    """Description of a dotted key, from the scenario's docstrings; empty for a key with a user-defined name."""
    nodes = (node for node, _ in json_schemas_at(Scenario, dotted_key.split(".")))
    return next((node["description"].replace("\n", " ") for node in nodes if "description" in node), "")


def _schema_type(schema_node: dict[str, Any]) -> str:
    """Type of the values that a node of the JSON schema permits; `integer` for a list of permitted integers."""
    words = schema_node.get("enum", [schema_node.get("const")])
    return "integer" if isinstance(words[0], int) else str(schema_node.get("type", "string"))


def unit_of_scenario_key(scenario: Scenario, dotted_key: str) -> str:
    """Unit of the value of a dotted key, from its ending (`_mm`) or from the parameter in it; '' without a unit."""
    *parents, last = dotted_key.split(".")
    try:
        if parents[-1:] == ["errors"] or parents[-2:] == ["prior", "parameters"]:
            built = make_scenario_construction(scenario)
            return built.parameters[built.parameter_index(last)].unit
        if parents[:1] == ["effects"] and parents[2:] in (["values"], ["shape"]):
            kind = find_effect(scenario.effects[int(parents[1]) - 1].name)
            parameters = kind.parameters if parents[2] == "values" else kind.shape_parameters
            return next((entry.unit for entry in parameters if entry.name == last), "")
    except (LtsimError, ValueError, IndexError):
        return ""
    return unit_of_key(last)


def convert_value(scenario: Scenario, dotted_key: str, value: Any, error_location: str) -> Any:
    """Value in the unit of its key: a text with a unit such as ``2 urad`` is converted, other values are unchanged.

    InputError is raised if the text has a unit of another quantity; its message begins with `error_location`.
    """
    if not isinstance(value, str) or not value or value[0] not in "+-.0123456789":
        return value
    unit = unit_of_scenario_key(scenario, dotted_key)
    converted_number = parse_quantity_in_unit(value, unit) if unit else None
    if unit and converted_number is None:
        raise InputError(
            f"{error_location}: {dotted_key} is '{safe_excerpt(value)}', expected a number in {unit}, "
            f"or a number with a unit of the same kind"
        )
    return value if converted_number is None else converted_number


def value_at_key(table: dict[str, Any], dotted_key: str) -> Any:
    """Value of a dotted key in the TOML tables of a scenario; None for a missing key."""
    subtable: Any = table
    for part in dotted_key.split("."):
        if isinstance(subtable, list) and part.isdecimal() and 1 <= int(part) <= len(subtable):
            subtable = subtable[int(part) - 1]
        else:
            subtable = subtable.get(part) if isinstance(subtable, dict) else None
    return subtable
