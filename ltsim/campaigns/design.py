"""Experimental design of a campaign: factors, points in ranges of several keys, scenarios of the cells.

The scenarios of the cells (combinations of factor levels) share equal values, so that thousands of scenarios that
differ in a few values take little memory. Their CAD files are identified by digests.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
from pydantic import BaseModel, Field, model_validator

from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError
from ltsim.core.randomness import random_stream
from ltsim.core.storage import read_whole_file
from ltsim.core.units import unit_of_key
from ltsim.recordings.result_file import Entry
from ltsim.recordings.setup import Finite, TomlSection
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.scenario_keys import KeyValueType, value_at_key, value_type_of_key

RESERVED_COLUMN_NAMES = frozenset(
    {
        "cell", "label", "method", "trial", "trials", "status", "chi2",
        "column", "unit", "mean", "standard_deviation", "low", "high", "minimum", "maximum",
    }
)  # fmt: skip
"""Names of the columns that the rows of every campaign have; no factor may have such a name."""
N_DESIGN_POINT_DIGITS = 4
"""Number of significant digits of rounded values at design points. The rounding makes them readable; the points remain
distinct."""
MAX_DESIGN_KEYS = 64
"""Largest number of scenario keys that a design varies, each over a range of values."""
MAX_CELLS = 4096
"""Largest number of cells (combinations of factor levels) of a campaign."""
MAX_STATISTICS = 150_000
"""Largest number of statistics of a campaign: `N_STATISTICS` and the number of effects for each method, in each cell.
With 131,760 statistics in 3,660 cells, `ltsim campaign --resume` takes 490 MB, with `--json` 450 MB, and `ltsim report`
350 MB. A row of `summary.csv` has 270 bytes and is in memory three times while the file is written. A statistic takes
1.5 kB as an object, but only the objects of one result column exist at a time."""
N_STATISTICS = 36
"""Number of statistics of a method without effects: 20 result columns and the z-scores of 16 parameters."""
MAX_MANIFEST_VALUES = 1_400_000
"""Largest number of values in the scenarios of all cells (combinations of factor levels) together, all of which are
stored in the manifest."""

ModelType = TypeVar("ModelType", bound=BaseModel)
"""Type of a scenario, or of a table of a scenario."""


class ScenarioKeyRange(TomlSection):
    """Range over which a design varies one key of the scenario, in the unit of the key.

    The values are integers if the key takes integers.
    """

    low: Finite
    """Smallest value of the key."""
    high: Finite
    """Largest value of the key."""
    scale: Literal["linear", "log"] = "linear"
    """Spacing of the points: uniform in the value, or in its logarithm."""

    @model_validator(mode="after")
    def _check_limits_ascend(self) -> Self:
        if self.low >= self.high or (self.scale == "log" and self.low <= 0):
            raise ValueError("low should be below high, and above 0 for scale = 'log'")
        return self

    def values_at(self, fractions: Floats, *, is_integer: bool) -> list[float]:
        """Values at the fractions `fractions` (points,) of the range; 0 is its lowest value, 1 its highest.

        All integers of the range are equally likely if `is_integer` is true.
        """
        low, high = (self.low, self.high + 1.0) if is_integer else (self.low, self.high)
        values = low * (high / low) ** fractions if self.scale == "log" else low + fractions * (high - low)
        return [int(min(v, self.high)) if is_integer else float(f"{v:.{N_DESIGN_POINT_DIGITS}g}") for v in values]


class SpaceFillingDesign(TomlSection):
    """Space-filling design: points distributed evenly over ranges of several keys, instead of a full grid."""

    kind: Literal["latin-hypercube", "sobol"]
    """Kind of design: Latin hypercube (McKay 1979), or scrambled Sobol sequence (Owen 1998)."""
    cell_count: Annotated[int, Field(ge=2)]
    """Number of design points, each a combination of factor levels (cell); a power of two for a Sobol sequence."""
    ranges: Annotated[dict[str, ScenarioKeyRange], Field(min_length=1, max_length=MAX_DESIGN_KEYS)]
    """Range of each key, tables `[design.ranges.KEY]`. KEY is a dotted key of the scenario, or the name of a group of
    keys with equal values in the table `[linked_keys]`."""

    @model_validator(mode="after")
    def _check_balance(self) -> Self:
        if self.kind == "sobol" and self.cell_count & (self.cell_count - 1):
            near = 2 ** round(float(np.log2(self.cell_count)))
            raise ValueError(f"cell_count should be a power of two for a Sobol sequence, such as {near}")
        return self

    def points(self, seed: int, keys: Mapping[str, str]) -> list[dict[str, Any]]:
        """Value of each key at each design point, drawn with the seed of the campaign.

        `keys` maps the name of each range to a dotted key of the scenario. Values are integers if this key takes
        integers.
        """
        from scipy.stats import qmc  # a second to load, and few campaigns have a design

        draw = random_stream(seed, "campaign", "design", self.kind)
        sampler = qmc.Sobol if self.kind == "sobol" else qmc.LatinHypercube
        shares = sampler(len(self.ranges), seed=draw).random(self.cell_count)
        columns = [
            limits.values_at(shares[:, k], is_integer=value_type_of_key(keys[name]) == "integer")
            for k, (name, limits) in enumerate(self.ranges.items())
        ]
        return [dict(zip(self.ranges, point, strict=True)) for point in zip(*columns, strict=True)]


class Factor(Entry):
    """Factor of a campaign: one key of the scenario, or several linked keys, whose value differs between cells.

    A cell is a combination of factor levels.
    """

    name: str
    """Name of the factor, and of its column in rows and summary."""
    keys: tuple[str, ...]
    """Dotted keys of the scenario, such as `work.faces`, that take the value of the factor."""
    unit: str = ""
    """Unit of the factor levels; empty for levels without a unit."""
    kind: KeyValueType = "number"
    """Type of the factor levels, such as `number`; tables are written as JSON."""

    def level_in_scenario(self, scenario: Mapping[str, Any]) -> Any:
        """Level of the factor in a cell (combination of factor levels), from the TOML tables of the cell's scenario.

        A table is returned as JSON text, a missing key as None.
        """
        value = value_at_key(dict(scenario), self.keys[0])
        return json.dumps(value) if isinstance(value, (dict, list)) else value

    def level_text(self, level: Any) -> str:
        """Level of the factor as text; the unit is added unless the name of the factor contains it."""
        text = level if isinstance(level, str) else "none" if level is None else f"{level:g}"
        if isinstance(level, bool):
            text = "yes" if level else "no"
        return f"{text} {self.unit}" if self.unit and not unit_of_key(self.name) and level is not None else text


def short_key_names(keys: Sequence[str]) -> dict[str, str]:
    """Short name of each dotted key: its shortest ending that no other key and no reserved column has."""
    depth = dict.fromkeys(keys, 1)
    while True:
        names = {key: "_".join(key.split(".")[-depth[key] :]) for key in keys}
        often = Counter(names.values())
        again = [
            k
            for k in keys
            if (often[names[k]] > 1 or names[k] in RESERVED_COLUMN_NAMES) and depth[k] < len(k.split("."))
        ]
        if not again:
            return names
        for key in again:
            depth[key] += 1


def cell_label(factors: Sequence[Factor], level_by_factor: Mapping[str, Any]) -> str:
    """Description of a cell (combination of factor levels) in one line: the level of each factor."""
    return ", ".join(f"{f.name} = {f.level_text(level_by_factor[f.name])}" for f in factors) or "as the scenario says"


def with_equal_values_from(model: ModelType, base: ModelType) -> ModelType:
    """Copy of `model`, a scenario or a table of one, that refers to the objects of `base` wherever values are equal.

    The scenarios of thousands of cells (combinations of factor levels) then take little more memory than one scenario.
    """
    shared_values = {}
    for name in type(model).model_fields:
        value, base_value = getattr(model, name), getattr(base, name)
        if repr(value) == repr(base_value):  # -0.0 equals 0.0, but the digest of a cell distinguishes them
            shared_values[name] = base_value
        elif isinstance(value, BaseModel) and type(value) is type(base_value):
            shared_values[name] = with_equal_values_from(value, base_value)
        elif isinstance(value, dict):
            shared_values[name] = {
                key: base_value[key] if key in base_value and repr(base_value[key]) == repr(entry) else entry
                for key, entry in value.items()
            }
    return model.model_copy(update=shared_values)


def shared_json_values(values: Iterable[Any]) -> Iterator[Any]:
    """JSON values, one after the other; equal parts of different values are the same object."""
    part_by_text: dict[str, Any] = {}
    for value in values:
        if isinstance(value, dict):
            yield {key: _shared_json_part(part, part_by_text) for key, part in value.items()}
        else:
            yield value


def _shared_json_part(value: Any, part_by_text: dict[str, Any]) -> Any:
    """JSON value in `part_by_text` that equals `value`; if there is none, `value` is added and returned.

    The parts of `value` are treated in the same way first. The function is not nested in `shared_json_values`, because
    a recursive nested function refers to itself and keeps the dictionary in memory until cyclic garbage is collected.
    """
    if isinstance(value, dict):
        value = {key: _shared_json_part(part, part_by_text) for key, part in value.items()}
    elif isinstance(value, list):
        value = [_shared_json_part(part, part_by_text) for part in value]
    return part_by_text.setdefault(repr(value), value)


def require_small_manifest(scenario: Scenario, n_cells: int, path: Path) -> None:
    """Check that the scenarios of a campaign have at most `MAX_MANIFEST_VALUES` values together.

    `scenario` is the base scenario of the `n_cells` cells (combinations of factor levels). InputError names the
    campaign file `path`.
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

    A cell is a combination of factor levels. `n_effects_by_method` is the number of effects that each calibration
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


def cad_files(scenarios: Iterable[Scenario]) -> list[Path]:
    """Paths of the CAD files in the workshops of `scenarios`, without duplicates."""
    file_names = (o.file for scenario in scenarios for o in scenario.workshop.obstacles if o.file is not None)
    return [Path(name) for name in dict.fromkeys(file_names)]


def with_cad_digests(scenario: Scenario) -> Scenario:
    """Copy of a scenario in which the name of each CAD file is replaced by the digest of the file's content."""
    hall = scenario.workshop
    digests = {path: hashlib.sha256(read_cad_bytes(path)).hexdigest() for path in cad_files([scenario])}
    obstacles = [o if o.file is None else o.model_copy(update={"file": digests[Path(o.file)]}) for o in hall.obstacles]
    return scenario.model_copy(update={"workshop": hall.model_copy(update={"obstacles": tuple(obstacles)})})


def read_cad_bytes(path: Path) -> bytes:
    """Content of a CAD file; raises InputError."""
    try:
        return read_whole_file(path)
    except OSError as problem:
        raise InputError(f"{path}: the file cannot be read ({problem.strerror})") from None
