"""Memory of the scenarios of a campaign's cells, of which thousands differ in a few values."""

from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel

from ltsim.core.errors import InputError
from ltsim.simulation.scenario import Scenario

MAX_MANIFEST_VALUES = 1_400_000
"""Largest number of values in the scenarios of all cells together; the manifest contains all of them."""

ModelType = TypeVar("ModelType", bound=BaseModel)
"""Type of a scenario, or of a section of one."""


def with_shared_values(model: ModelType, base: ModelType) -> ModelType:
    """Copy of a scenario, or of a section of one, in which values as in `base` are the same objects as there.

    The scenarios of thousands of cells then take little more memory than one scenario.
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


def require_small_manifest(scenario: Scenario, n_cells: int, path: Path) -> None:
    """Check that the manifest, which contains the scenario of every cell, has at most `MAX_MANIFEST_VALUES` values.

    `scenario` is the base scenario of `n_cells` cells. InputError names the campaign file `path`.
    """
    text = scenario.model_dump_json(by_alias=True)
    n_values = n_cells * (text.count(",") + text.count("[") + text.count("{"))
    if n_values > MAX_MANIFEST_VALUES:
        raise InputError(
            f"{path}: the scenarios of {n_cells} cells have {n_values} values together, expected at most "
            f"{MAX_MANIFEST_VALUES}: divide the campaign"
        )
