"""Campaign file (ltsim-campaign/1): base scenario, factors with their levels, methods to compare, number of trials."""

import hashlib
import itertools
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from ltsim.adjustment.evaluation.criteria import read_nominal
from ltsim.campaigns.design import (
    MAX_DESIGN_KEYS,
    Factor,
    SpaceFillingDesign,
    cell_label,
    require_few_cells,
    require_small_manifest,
    short_key_names,
    with_cad_digests,
    with_equal_values_from,
)
from ltsim.campaigns.schema import (
    RESULT_COLUMNS,
    CellEntry,
    ManifestFile,
    StatisticGroup,
    find_result_column,
    number_of_shards,
)
from ltsim.core.errors import InputError, reraise_as_input_error, unknown_name_error
from ltsim.core.limits import MAX_ADDITIONAL_EFFECTS
from ltsim.core.units import MILLIMETRE
from ltsim.recordings.keys import DistinctValues
from ltsim.recordings.settings import read_toml, validate_settings
from ltsim.recordings.setup import Positive, TomlSection
from ltsim.simulation.scenario import KEY_REMOVAL_VALUE, Scenario, change_scenario, load_scenario
from ltsim.simulation.scenario_keys import convert_value, unit_of_scenario_key, value_type_of_key
from ltsim.simulation.sections import PlacedEffect

CAMPAIGN_FORMAT = "ltsim-campaign/1"
"""Format and version of a campaign file."""
MAX_WRITTEN_SHARD_ROWS = 65_536
"""Largest number of rows (trials times methods) in a written file of rows (shard). A row with all statistics takes 2 kB
of memory."""
VALIDATION_STREAM_KEY = "judge"
"""Key of the random stream for the measurement of held-out points (key `validation_points`)."""


class CalibrationMethod(TomlSection):
    """Calibration method of a campaign.

    The solver ``batch`` calibrates all trials in one network geometry together, hundreds of times as fast as ``single``
    (each recording by `lt.calibrate`). Every campaign calibrates some trials with both and reports the difference.
    """

    name: str = ""
    """Name of the calibration method in the results; default the value of `method`."""
    method: Literal["network", "distance", "distance-l1", "equation-9", "equation-9-l1"] = "network"
    """Estimator: network adjustment, or the agreement of target distances between stations (Sensors 2021, 21, 7479,
    equation 9) by least squares or least absolute deviations (`-l1`). `distance` estimates only the combinations of
    parameters that the readings determine, `equation-9` estimates all, as in the paper."""
    construction: Literal["misalignment", "dh", "steering-mirror", "ideal"] = "misalignment"
    """Geometric error model whose parameters are estimated; `ideal` has none."""
    harmonics: Annotated[int, Field(ge=0, le=4)] = 2
    """Number of harmonics in the error of each rotary axis of the model `dh`."""
    degree: Annotated[int, Field(ge=0, le=4)] = 2
    """Degree of the polynomials in the range that describe the errors of the range axis of the model `dh`."""
    effects: Annotated[tuple[PlacedEffect, ...], Field(max_length=MAX_ADDITIONAL_EFFECTS)] = ()
    """Effects to estimate in addition to the instrument parameters, tables `[[methods.effects]]`."""
    solver: Literal["batch", "single"] = "batch"
    """Solver: all trials in one network geometry together (`batch`), or each recording separately (`single`)."""
    uses_applied_corrections: bool = False
    """True to evaluate the corrections that `ltsim calibrate` applies, in place of the estimates. Permitted only for
    the method `network` with the solver `single`."""

    @property
    def title(self) -> str:
        """Name of the calibration method in the results."""
        return self.name or self.method

    @model_validator(mode="after")
    def _check_effects_have_network(self) -> Self:
        if self.effects and self.method != "network":
            raise ValueError(f"effects should be empty: method {self.method} estimates instrument parameters only")
        if self.uses_applied_corrections and (self.effects or self.method != "network" or self.solver != "single"):
            raise ValueError("uses_applied_corrections needs method = 'network', solver = 'single' and no effects")
        if self.construction == "ideal" and self.method != "network":
            raise ValueError(f"construction should not be ideal: method {self.method} needs parameters to estimate")
        return self


class StoppingRule(TomlSection):
    """Adaptive stopping rule of each cell (combination of factor levels), evaluated after each round of trials.

    A cell stops when the confidence interval of the mean of `statistic` is narrow enough for every method: its
    half-width is at most `max_half_width`. Each round adds 50 % more trials.
    """

    statistic: str = "target_error_um"
    """Statistic whose mean has to be precise: a column of the rows, or an improvement of the agreement of stations [%].
    """
    max_half_width: Positive
    """Half-width of the 95 % confidence interval at which a cell (combination of factor levels) stops."""


class CampaignFile(TomlSection):
    """Content of a campaign file.

    `scenario_changes` applies to all cells (combinations of factor levels). `grid` holds lists of values that are
    combined with each other, `design` distributes points over ranges, and `cells` lists single combinations. If a file
    has several of these three, every combination of their entries is a cell. Keys are dotted keys of the scenario, as
    in ``"instrument.noise_factor"`` (entries of a list by number, as in ``"effects.1.values.x"``), or names in
    `linked_keys`. A value is a number in the key's unit, or a text with its unit (``"2 urad"``). The scenario defines
    the true errors, `methods` defines the estimated parameters.
    """

    format: Literal["ltsim-campaign/1"] = "ltsim-campaign/1"
    """Format and version of this file."""
    title: str = ""
    """Title of the campaign, free text."""
    scenario: str = "paper-workshop"
    """Base scenario: name of a built-in scenario, or a file in the folder of the campaign file."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of all random draws."""
    trials: Annotated[int, Field(ge=1, le=10**9)] = 1000
    """Number of trials of each cell (combination of factor levels)."""
    trials_per_shard: Annotated[int, Field(ge=1, le=65_536)] = 4096
    """Number of trials in each output file (shard). If a process is killed, its unfinished file is lost."""
    geometry: Literal["shared", "per-trial"] = "shared"
    """True positions of stations and targets: equal for all trials with equal factor levels (`shared`), or drawn for
    each trial (`per-trial`)."""
    verified_trials_per_shard: Annotated[int, Field(ge=0, le=1000)] = 2
    """Number of trials at the start of each output file that `lt.calibrate` repeats one by one, for verification."""
    statistics: DistinctValues[StatisticGroup] = ("criteria", "errors", "z-scores")
    """Groups of results that each row contains: disagreement of stations (`criteria`), errors of points (`errors`),
    `z-scores`, `estimates` and true values (`truth`)."""
    validation_points: str = ""
    """Held-out points, which the instruments of each trial measure but no calibration uses. Name of a scenario
    (built-in, or a file in the folder of this one), or of a table of points (`target,x_mm,y_mm,z_mm` in a file
    `NAME.csv`) that are measured from the stations of the trial."""
    validation_drift: Annotated[float, Field(ge=0)] = 0.0
    """Standard deviation of a random drift of the instrument parameters (except the range scale) between calibration
    and measurement of the held-out points, as a fraction of the prior standard deviations."""
    scenario_changes: dict[str, Any] = Field(default_factory=dict)
    """Values that replace those of the base scenario in all cells (combinations of factor levels), by dotted key."""
    linked_keys: dict[str, Annotated[tuple[str, ...], Field(min_length=1)]] = Field(
        default_factory=dict, max_length=MAX_DESIGN_KEYS
    )
    """Groups of keys that always take the same value, by a name for the group, which is also the name of their column.
    """
    grid: dict[str, list[Any]] = Field(default_factory=dict)
    """Lists of levels by dotted key; each combination of these factor levels is a cell of the campaign."""
    design: SpaceFillingDesign | None = None
    """Space-filling design: points of a Latin hypercube or a Sobol sequence in ranges of several keys."""
    cells: tuple[dict[str, Any], ...] = ()
    """Combinations of factor levels (cells) that are listed individually, tables `[[cells]]`."""
    stop: StoppingRule | None = None
    """Rule that may stop a cell (combination of factor levels) before it has all its trials."""
    methods: tuple[CalibrationMethod, ...] = (CalibrationMethod(),)
    """Calibration methods to compare, tables `[[methods]]`."""

    @model_validator(mode="after")
    def _check_names_differ(self) -> Self:
        titles = [method.title for method in self.methods]
        if not titles or len(set(titles)) < len(titles):
            raise ValueError(f"methods should be one or more with different names, found the names {titles}")
        if any(not values for values in self.grid.values()):
            raise ValueError("each key of grid should have at least one value")
        return self

    @model_validator(mode="after")
    def _check_stop_statistic(self) -> Self:
        if self.stop is None:
            return self
        column = find_result_column(self.stop.statistic)
        if column is None:
            columns = [column.name for column in RESULT_COLUMNS]
            raise ValueError(
                f"stop.statistic: {unknown_name_error('column of the rows', self.stop.statistic, columns)}"
            )
        if column.group and column.group not in self.statistics:
            message = f"statistics should include '{column.group}', because stop.statistic is {self.stop.statistic}"
            raise ValueError(message)
        return self

    @model_validator(mode="after")
    def _check_each_key_once(self) -> Self:
        places = [*self.grid, *(self.design.ranges if self.design else ())]
        keys = [key for name in places for key in self.linked_keys.get(name, (name,))]
        twice = next((key for key, count in Counter(keys).items() if count > 1), None)
        if twice:
            raise ValueError(f"grid, design and linked_keys should vary each key once, but they vary {twice} twice")
        return self

    @model_validator(mode="after")
    def _check_size(self) -> Self:
        cells = max(len(self.cells), 1) * math.prod(len(values) for values in self.grid.values())
        cells *= self.design.cell_count if self.design else 1
        require_few_cells(cells, [len(method.effects) for method in self.methods])
        number_of_shards(self.trials, self.trials_per_shard, cells)
        n_rows = min(self.trials_per_shard, self.trials) * len(self.methods)
        if n_rows > MAX_WRITTEN_SHARD_ROWS:
            raise ValueError(
                f"a file of rows should have at most {MAX_WRITTEN_SHARD_ROWS} rows, but trials_per_shard and methods "
                f"give {n_rows}: reduce trials_per_shard"
            )
        return self

    @property
    def n_shards_per_cell(self) -> int:
        """Number of files of rows (shards) of each cell (combination of factor levels)."""
        return number_of_shards(self.trials, self.trials_per_shard)

    @property
    def varied_keys(self) -> tuple[str, ...]:
        """Dotted keys, and names in `linked_keys`, that are factors of the campaign, in file order."""
        keys = (key for cell in self.cells for key in cell)
        return tuple(dict.fromkeys((*keys, *(self.design.ranges if self.design else ()), *self.grid)))

    def factors(self, scenario: Scenario) -> tuple[Factor, ...]:
        """Factors of the campaign, with units and types from the scenario of any combination of factor levels.

        If a table and the key `title` vary together, the title represents the table.
        """
        titles, given = (
            short_key_names(self.varied_keys),
            {name: self.linked_keys.get(name, (name,)) for name in self.varied_keys},
        )
        factors = (
            Factor(
                name=titles[name],
                keys=keys,
                unit=unit_of_scenario_key(scenario, keys[0]),
                kind=value_type_of_key(keys[0]),
            )
            for name, keys in given.items()
        )
        return tuple(factor for factor in factors if factor.kind != "table" or "title" not in self.varied_keys)

    def scenario_changes_of_cells(self) -> Iterator[dict[str, Any]]:
        """Values, by dotted key, that replace those of the base scenario in each combination of factor levels."""
        first_key_by_name = {name: self.linked_keys.get(name, (name,))[0] for name in self.varied_keys}
        points = self.design.points(self.seed, first_key_by_name) if self.design else [{}]
        for listed, point in itertools.product(self.cells or ({},), points):
            for values in itertools.product(*self.grid.values()):
                values_by_name = self.scenario_changes | listed | point | dict(zip(self.grid, values, strict=True))
                yield self.values_by_key(values_by_name)

    def values_by_key(self, values_by_name: Mapping[str, Any]) -> dict[str, Any]:
        """Values by dotted key, from values by dotted key or by the name of a group of keys in `linked_keys`."""
        return {key: value for name, value in values_by_name.items() for key in self.linked_keys.get(name, (name,))}


def load_campaign(
    path: Path, changes: Mapping[str, Any] | None = None, tables: Mapping[str, Any] | None = None
) -> tuple[CampaignFile, tuple[Scenario, ...]]:
    """Campaign of a file (or of `tables` in place of a file), and the scenario of each cell.

    A cell is a combination of factor levels. `changes` are new values of keys of the file (such as `trials`), or of
    dotted keys of the scenario in all cells. InputError is raised for an invalid file.
    """
    if tables is None and (path / ManifestFile.FILE).is_file():
        raise InputError(f"{path}: the folder holds rows of a campaign; to run it, give {path / 'campaign.toml'}")
    with reraise_as_input_error():
        given = read_toml(path, "campaign") if tables is None else {"format": CAMPAIGN_FORMAT, **tables}
        campaign = validate_settings(given, CampaignFile, "campaign", path)
    if changes:
        campaign = campaign_with_changes(campaign, changes, path)
    base = load_scenario(path_relative_to_campaign_file(campaign.scenario, path) or campaign.scenario)
    common_values = {
        key: convert_value(base, key, value, str(path))
        for key, value in campaign.values_by_key(campaign.scenario_changes).items()
    }
    units = change_scenario(base, common_values, path)  # with the effects that `scenario_changes` adds
    require_small_manifest(base, sum(1 for _ in campaign.scenario_changes_of_cells()), path)
    items = []
    for number, values in enumerate(campaign.scenario_changes_of_cells(), start=1):
        where = f"{path}: cell {number}"
        inside = {key: convert_value(units, key, value, where) for key, value in values.items()}
        items.append(with_equal_values_from(change_scenario(base, inside, path, where), base))
    return campaign, tuple(items)


def campaign_with_changes(campaign: CampaignFile, key_changes: Mapping[str, Any], path: Path) -> CampaignFile:
    """Campaign with new values of its own keys, or of dotted keys of all its scenarios; errors name `path`."""
    tables = campaign.model_dump(mode="json", by_alias=True, exclude_none=True)
    for key, value in key_changes.items():
        if key in CampaignFile.model_fields:
            tables[key] = value
        elif key in campaign.grid:
            tables["grid"][key] = [value]
        elif key in campaign.varied_keys:
            raise InputError(
                f"{path}: {key} has different values in the cells or the design of the file: change it there"
            )
        else:
            tables["scenario_changes"][key] = value
    with reraise_as_input_error():
        return validate_settings(tables, CampaignFile, "campaign", path)


@dataclass(frozen=True)
class CampaignCell:
    """Cell of a campaign: a combination of factor levels, with its scenario."""

    scenario: Scenario
    validation_scenario: Scenario | None
    """Scenario of the held-out points; None if the campaign names none (key `validation_points`)."""
    scenario_changes: dict[str, Any]
    """Values that replace those of the base scenario in this cell (combination of factor levels), by dotted key."""
    levels: dict[str, Any]
    """Level of each factor, by the factor's name."""
    digest: str
    """Digest of everything that determines the rows of the cell (combination of factor levels), except the number of
    rows and the selected statistics."""

    def manifest_entry(self, cell_index: int, factors: Sequence[Factor]) -> CellEntry:
        """Entry of the cell (combination of factor levels) in `manifest.json`."""
        label, changes = cell_label(factors, self.levels), self.scenario_changes
        return CellEntry(cell=cell_index, label=label, scenario_changes=changes, levels=self.levels, digest=self.digest)


def make_campaign_cells(
    campaign: CampaignFile, scenarios: Sequence[Scenario], path: Path
) -> tuple[tuple[Factor, ...], tuple[CampaignCell, ...]]:
    """Factors of a campaign, and its cells (combinations of factor levels); InputError for an invalid scenario."""
    factors, cells = campaign.factors(scenarios[0]), []
    deciding = {"seed", "trials_per_shard", "geometry", "verified_trials_per_shard", "methods", "validation_drift"}
    cell_seed_text = campaign.model_dump_json(include=deciding, by_alias=True)
    for scenario, scenario_changes in zip(scenarios, campaign.scenario_changes_of_cells(), strict=True):
        tables = scenario.model_dump(mode="json", by_alias=True)
        points_name = campaign.validation_points
        validation = make_validation_scenario(points_name, scenario, path) if points_name else None
        levels = {factor.name: factor.level_in_scenario(tables) for factor in factors}
        texts = [with_cad_digests(s).model_dump_json(by_alias=True) for s in (scenario, validation) if s is not None]
        digest = hashlib.sha256("\n".join([cell_seed_text, *texts]).encode()).hexdigest()
        cells.append(CampaignCell(scenario, validation, scenario_changes, levels, digest))
    return factors, tuple(cells)


def make_validation_scenario(name: str, scenario: Scenario, path: Path) -> Scenario:
    """Scenario of the held-out points of `validation_points`, with the instruments of `scenario`.

    `name` is the value of `validation_points`, and `path` the campaign file. InputError is raised for an invalid name.
    """
    file = path_relative_to_campaign_file(name, path)
    if name.endswith(".csv"):
        with reraise_as_input_error():
            points = read_nominal(file or path.parent / name)
        places = {target: {"position_mm": (place / MILLIMETRE).tolist()} for target, place in points.items()}
        effects = [e.model_dump(mode="json") for e in scenario.effects if not e.targets]
        changes = {
            "gauge": KEY_REMOVAL_VALUE,
            "lengths": [],
            "work.targets": KEY_REMOVAL_VALUE,
            "targets": places,
            "effects": effects,
        }
        return change_scenario(scenario, changes, path, f"{path}: validation_points")
    hall = load_scenario(file or name)
    instruments = {"instrument": scenario.instrument, "instruments": scenario.instruments}
    hall = hall.model_copy(update=instruments)
    instrument_names = {station.instrument or "" for station in hall.stations.values()}
    if instrument_names != {*scenario.trackers_in_use}:
        wanted = ", ".join(scenario.trackers_in_use) or "one without a name"
        raise InputError(
            f"{path}: validation_points: stations of {name} should name the trackers of the cells: {wanted}"
        )
    return hall


def path_relative_to_campaign_file(name: str, path: Path) -> Path | None:
    """Path of the file `name` in the folder of the campaign file `path`; None if there is no such file."""
    for candidate in (path.parent / name, path.parent / Path(name).name):
        if candidate.is_file():
            return candidate.resolve()
    return None
