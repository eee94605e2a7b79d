"""Limits of cells (combinations of factor levels) of a campaign, and equal values that their scenarios share.

Thousands of scenarios that differ in a few values thus take little memory.
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from ltsim.core.errors import InputError
from ltsim.simulation.scenario import Scenario

MAX_MANIFEST_VALUES = 1_400_000
"""Largest number of values in the scenarios of all cells (combinations of factor levels) together, all of which are
stored in the manifest."""
MAX_CELLS = 4096
"""Largest number of cells (combinations of factor levels) of a campaign."""
MAX_STATISTICS = 150_000
"""Largest number of statistics of a campaign: `N_STATISTICS` and the number of effects for each method, in each cell. A
statistic takes 1.5 kB in the summary and the report."""
N_STATISTICS = 36
"""Number of statistics of a method without effects: 20 result columns and the z-scores of 16 parameters."""

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


def shared_json_values(values: Iterable[Any]) -> Iterator[Any]:
    """JSON values, one after the other; equal parts of different values are the same object."""
    part_by_text: dict[str, Any] = {}

    def shared_value(value: Any) -> Any:
        if isinstance(value, dict):
            value = {key: shared_value(part) for key, part in value.items()}
        elif isinstance(value, list):
            value = [shared_value(part) for part in value]
        return part_by_text.setdefault(repr(value), value)

    for value in values:
        yield {key: shared_value(part) for key, part in value.items()} if isinstance(value, dict) else value


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


def require_few_cells(n_cells: int, n_effects_by_method: Sequence[int]) -> None:
    """Check that a campaign has at most `MAX_CELLS` cells and `MAX_STATISTICS` statistics; raises ValueError.

    A cell is a combination of factor levels. `n_effects_by_method` holds the number of effects that each calibration
    method estimates.
    """
    if n_cells > MAX_CELLS:
        raise ValueError(
            f"a campaign should have at most {MAX_CELLS} cells, but grid, design and cells give {n_cells}: divide it"
        )
    n_statistics = n_cells * sum(N_STATISTICS + n_effects for n_effects in n_effects_by_method)
    if n_statistics > MAX_STATISTICS:
        raise ValueError(
            f"a campaign should have at most {MAX_STATISTICS} statistics, but {n_cells} cells with "
            f"{len(n_effects_by_method)} methods have about {n_statistics}: divide it"
        )
