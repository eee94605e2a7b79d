"""Sharing of equal values between the scenarios of the cells (combinations of factor levels) of a campaign.

Thousands of scenarios that differ in a few values thus take little memory.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from ltsim.core.errors import InputError
from ltsim.simulation.scenario import Scenario

MAX_MANIFEST_VALUES = 1_400_000
"""Largest number of values in the scenarios of all cells (combinations of factor levels) together, all of which are
stored in the manifest."""

ModelType = TypeVar("ModelType", bound=BaseModel)
"""Type of a scenario, or of a table of a scenario."""


def with_shared_values(model: ModelType, base: ModelType) -> ModelType:
    """Copy of `model`, a scenario or a table of one, that refers to the objects of `base` wherever values are equal.

    The scenarios of thousands of cells (combinations of factor levels) then take little more memory than one scenario.
    """
    shared_values = {}
    for name in type(model).model_fields:
        value, base_value = getattr(model, name), getattr(base, name)
        if repr(value) == repr(base_value):  # -0.0 equals 0.0, but the digest of a cell distinguishes them
            shared_values[name] = base_value
        elif isinstance(value, BaseModel) and type(value) is type(base_value):
            shared_values[name] = with_shared_values(value, base_value)
        elif isinstance(value, dict):
            shared_values[name] = {
                key: base_value[key] if key in base_value and repr(base_value[key]) == repr(entry) else entry
                for key, entry in value.items()
            }
    return model.model_copy(update=shared_values)


def shared_json_values(scenarios: Iterable[BaseModel]) -> Iterator[dict[str, Any]]:
    """JSON values of scenarios, one after the other; equal parts of different scenarios are the same object."""
    part_by_text: dict[str, Any] = {}

    def shared_value(value: Any) -> Any:
        if isinstance(value, dict):
            value = {key: shared_value(part) for key, part in value.items()}
        elif isinstance(value, list):
            value = [shared_value(part) for part in value]
        return part_by_text.setdefault(repr(value), value)

    for scenario in scenarios:
        yield {key: shared_value(part) for key, part in scenario.model_dump(mode="json", by_alias=True).items()}


def require_small_manifest(scenario: Scenario, n_cells: int, path: Path) -> None:
    """Check that the scenarios of all cells together have at most `MAX_MANIFEST_VALUES` values.

    A cell is a combination of factor levels; `scenario` is the base scenario of the `n_cells` cells. InputError names
    the campaign file `path`.
    """
    text = scenario.model_dump_json(by_alias=True)
    n_values = n_cells * (text.count(",") + text.count("[") + text.count("{"))
    if n_values > MAX_MANIFEST_VALUES:
        raise InputError(
            f"{path}: the scenarios of {n_cells} cells have {n_values} values together, expected at most "
            f"{MAX_MANIFEST_VALUES}: divide the campaign"
        )
