"""Schema of manifest.json, and columns of the tables of a campaign."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

from pydantic import ConfigDict, Field, StrictBool, StrictFloat, StrictInt, StrictStr, field_validator, model_validator

from ltsim.campaigns.design import Factor, shared_json_values
from ltsim.core.json_text import json_object_parts
from ltsim.core.limits import MAX_JSON_VALUES
from ltsim.core.results import Column, Table, number_columns, text_columns
from ltsim.recordings.result_file import Entry, ResultFile

NonNegativeInt = Annotated[int, Field(ge=0)]
"""Integer of 0 or more."""
MAX_SHARDS = 500_000
"""Largest number of files of rows (shards) of a campaign; a campaign with more is rejected."""
QUANTILE_LEVELS = (0.025, 0.05, 0.25, 0.5, 0.75, 0.95, 0.975)
"""Probabilities of the quantiles in the summary of a campaign."""

SUMMARY_FILE_NAME = "summary.csv"
"""Name of the file with the statistics of a campaign."""
SOLVER_DIFFERENCE_COLUMN = "full_difference_sigma"
"""Name of the column with the largest difference between the calibration of many trials together (batch solver) and of
the single trial by `lt.calibrate` (full solver). Only trials that are calibrated by both have a value."""
PARAMETER_UNIT_PLACEHOLDER = "of the parameter"
"""Text in place of a unit in the documentation of columns that exist once per parameter, each in the unit of its
parameter."""
TRIAL_STATUSES = BATCH_CONVERGED, FULL_SOLVER, WITHOUT_RESULT = "converged", "full solver", "failed"
"""Possible statuses of a trial: calibrated together with other trials (batch solver), calibrated alone by
`lt.calibrate` (full solver), or without a result."""
InstrumentErrorOrigin = Literal["drawn", "stated"]
"""Origin of the true instrument errors in a recovery check: `drawn` from the prior distribution of the parameters, or
`stated` (declared) by the scenario."""
StatisticGroup = Literal["criteria", "errors", "z-scores", "estimates", "truth"]
"""Group of result columns in the rows of a campaign, which the key `statistics` of the campaign file selects:
disagreement of stations (`criteria`), errors of points, z-scores, estimates, or true values (`truth`)."""
MEASURED_POINT_ERROR_MEANING = (
    "rms over stations and targets of the 3D distance between the true point and the point that the readings give, "
    "after a rigid fit of each station's points to the true points; noise of these readings included"
)
"""Meaning of the result columns with an error of the measured points, for tables and documentation."""
HELD_OUT_POINT_MEANING_PREFIX = (
    "error at the held-out points of `validation_points`, whose readings no calibration used: "
)
"""First words of the meaning of result columns with an error at held-out points, for tables and documentation."""
REMOVED_ERROR_FRACTION_MEANING = (
    "(R - C) / (R - P), where R, C and P are the mean squares of {0}error_raw_um, {0}error_calibrated_um and "
    "{0}error_true_parameters_um over all trials of a cell (combination of factor levels) and method: 1 for a "
    "calibration with the true parameters, 0 for no correction, below 0 for a correction that increases the error; its "
    "interval is that of a ratio of means"
)
"""Meaning of the fraction of the error that a calibration removes, for tables; ``{0}`` is the prefix of column names.
"""


@dataclass(frozen=True)
class RowColumn(Column):
    """Result column in the rows of a campaign; a name that ends in `:` is the prefix of a column per parameter."""

    group: StatisticGroup | None = None
    """Group of results to which the column belongs; None for a column that all rows have."""


def _result_columns(group: StatisticGroup | None, unit: str, **meanings: str) -> list[RowColumn]:
    """Columns of one group of results, all with the same unit; `meanings` has name and meaning of each column."""
    return [RowColumn(name, meaning, unit=unit, group=group) for name, meaning in meanings.items()]


def _parameter_column(name: str, unit: str, group: StatisticGroup, description: str) -> RowColumn:
    """Columns with one value per parameter; `name` begins their names, `description` is their meaning."""
    return RowColumn(f"{name}:", description, unit=unit, group=group)


def _criterion_columns(criterion_kind: str, description: str) -> list[RowColumn]:
    """Columns of a disagreement of the stations: mean and maximum, before and after calibration, and reduction.

    `criterion_kind` (`distance` or `coordinate`) begins the column names, `description` is the meaning of the
    disagreement.
    """
    meaning_by_column = {
        f"{criterion_kind}_{when}_{which}_um": f"{word} of {description}, {words}"
        for when, words in (("before", "readings without corrections"), ("after", "readings corrected"))
        for which, word in (("mean", "mean"), ("max", "largest"))
    }
    meaning_of_gain = f"100 (1 - mean after / mean before calibration) of {description}"
    gain = {f"{criterion_kind}_improvement_percent": meaning_of_gain}
    return _result_columns("criteria", "um", **meaning_by_column) + _result_columns("criteria", "%", **gain)


def _error_columns(prefix: str, description: str) -> list[RowColumn]:
    """Columns of a point error [um], from readings uncorrected, corrected by estimates, or by true parameters.

    `prefix` begins the column names, `description` is the meaning of the error.
    """
    floor = "readings corrected by the true parameters: the limit of noise and unmodelled effects"
    meaning_by_column = {
        f"{prefix}error_raw_um": f"{description}; readings without corrections",
        f"{prefix}error_calibrated_um": f"{description}; readings corrected by the estimates",
        f"{prefix}error_true_parameters_um": f"{description}; {floor}",
    }
    return _result_columns("errors", "um", **meaning_by_column) + _result_columns(
        "errors", "", **{f"{prefix}share_removed": REMOVED_ERROR_FRACTION_MEANING.format(prefix)}
    )


RESULT_COLUMNS: tuple[RowColumn, ...] = (
    *_result_columns(None, "", chi2="chi-square: minimum of the weighted sum of squared residuals"),
    *_result_columns(
        None, "sigma", **{SOLVER_DIFFERENCE_COLUMN: "largest difference of parameters and targets from `lt.calibrate`"}
    ),
    *_criterion_columns("distance", "the disagreement of stations in distances (Sensors 2021, 21, 7479, eq. 11)"),
    *_criterion_columns("coordinate", "the disagreement of stations in coordinates after a rigid fit (eq. 12)"),
    *_error_columns("", MEASURED_POINT_ERROR_MEANING),
    *_result_columns(
        "errors",
        "um",
        target_error_um="rms over targets of the 3D distance from the true point to the adjusted one, all fitted "
        "rigidly to the true ones; it includes the noise of the adjusted readings",
    ),
    *_error_columns("new_point_", HELD_OUT_POINT_MEANING_PREFIX + MEASURED_POINT_ERROR_MEANING),
    _parameter_column(
        "z", "", "z-scores", "(estimate - true value) / sigma of a parameter that is both simulated and estimated"
    ),
    _parameter_column("estimate", PARAMETER_UNIT_PLACEHOLDER, "estimates", "estimate of a parameter"),
    _parameter_column("sigma", PARAMETER_UNIT_PLACEHOLDER, "estimates", "standard deviation of an estimate"),
    _parameter_column("true", PARAMETER_UNIT_PLACEHOLDER, "truth", "true value of a parameter"),
)
"""Columns of all results that rows and statistics may contain, for files, documentation and reports."""
RATIO_STATISTICS = tuple(column.name for column in RESULT_COLUMNS if column.name.endswith("share_removed"))
"""Names of the statistics that are ratios of two means over all trials, and therefore have no value for a single trial.
"""


def find_result_column(name: str) -> RowColumn | None:
    """Definition of the result column or statistic with the name `name`; None for the column of a factor."""
    return next(
        (c for c in RESULT_COLUMNS if name == c.name or (c.name.endswith(":") and name.startswith(c.name))), None
    )


def error_columns_of_ratio(ratio_name: str) -> tuple[str, str, str]:
    """Names of the columns from which the ratio `ratio_name` is computed.

    They contain the error of points from uncorrected readings, after calibration, and after correction by the true
    parameters.
    """
    prefix = ratio_name.removesuffix("share_removed")
    return f"{prefix}error_raw_um", f"{prefix}error_calibrated_um", f"{prefix}error_true_parameters_um"


def number_of_shards(n_trials: int, trials_per_shard: int, n_cells: int = 1) -> int:
    """Number of files of rows (shards) of a campaign with `n_cells` cells of `n_trials` trials.

    A cell is a combination of factor levels. ValueError is raised for more than `MAX_SHARDS` files.
    """
    n_shards = n_cells * -(-n_trials // trials_per_shard)
    if n_shards > MAX_SHARDS:
        raise ValueError(
            f"the campaign should have at most {MAX_SHARDS} files of rows, but it has {n_shards}: "
            "increase trials_per_shard, or give fewer trials or cells"
        )
    return n_shards


def sql_identifier(name: str) -> str:
    """Column name as a quoted SQL identifier; the name may contain any characters."""
    return '"' + name.replace('"', '""') + '"'


def statistic_sql_expressions(statistic: str) -> tuple[str, ...]:
    """SQL expressions whose means over the trials give a statistic.

    A column needs one expression. A ratio statistic is the ratio of the means of two expressions: the squared error
    that the calibration removes, and the squared error that the true parameters remove.
    """
    if statistic not in RATIO_STATISTICS:
        return (sql_identifier(statistic),)
    raw, calibrated, perfect = (f"{sql_identifier(name)}::DOUBLE ^ 2" for name in error_columns_of_ratio(statistic))
    return f"({raw} - {calibrated})", f"({raw} - {perfect})"


ROWS_TABLE = Table(
    "rows/cell-*/shard-*.parquet",
    "one row per trial and method; the levels of the factors follow the number of the cell",
    (
        *number_columns(cell="number of the cell (combination of factor levels), from 0"),
        *text_columns(method="name of the calibration method"),
        *number_columns(trial="number of the trial; `ltsim simulate --trial NUMBER` writes its recording"),
        *text_columns(status="converged, full solver (by `lt.calibrate`, as the batch did not converge), failed"),
        *RESULT_COLUMNS,
    ),
)


def summary_table(factors: Mapping[str, str]) -> Table:
    """Table `summary.csv` of a campaign: one row per cell (combination of factor levels), method and result column.

    `factors` holds the type of the levels of each factor by its name.
    """
    about = "level of the factor, in the unit that manifest.json states"
    settings = [
        column
        for name, kind in factors.items()
        for column in (number_columns if kind in ("number", "integer") else text_columns)(**{name: about})
    ]
    return Table(
        SUMMARY_FILE_NAME,
        "every statistic over the trials of a combination of factor levels (cell) and a method, with these levels",
        (
            *number_columns(cell="number of the cell (combination of factor levels), from 0"),
            *settings,
            *text_columns(method="name of the calibration method", column="name of the result column in the rows"),
            *text_columns(unit="unit of all following columns except `trials`"),
            *number_columns(trials="trials with a value in this column"),
            *number_columns("r", mean="mean of these values", standard_deviation="standard deviation of these values"),
            *number_columns("r", low="lower 95 % confidence limit of the mean", high="upper 95 % confidence limit"),
            *number_columns("r", minimum="smallest value", maximum="largest value"),
            *(
                Column(
                    f"quantile_{100 * level:g}_percent",
                    "quantile over the trials",
                    csv_format="r",
                    title=f"{100 * level:g} % quantile",
                    unit="",  # that of the row
                )
                for level in QUANTILE_LEVELS
            ),
        ),
    )


class TrackerSettings(Entry):
    """Tracker of a scenario in `manifest.json`, with all keys of its table in the scenario file."""

    model_config = ConfigDict(extra="allow")

    preset: str
    """Name of the tracker's data sheet or preset."""


class ScenarioSettings(Entry):
    """Scenario of one cell (combination of factor levels), with all its keys."""

    model_config = ConfigDict(extra="allow")

    instrument: TrackerSettings
    """Tracker of the stations for which the scenario names no other tracker."""
    instruments: dict[str, TrackerSettings] = Field(default_factory=dict)
    """Further trackers of the scenario, by the name that the stations use."""


FactorLevelValue = StrictBool | StrictInt | StrictFloat | StrictStr | None
"""Level of a factor in `manifest.json`: flag, integer, number, text, or null for a missing key."""


class CellEntry(Entry):
    """Entry of a cell (combination of factor levels) in the manifest of a campaign."""

    cell: NonNegativeInt
    """Index of the cell (combination of factor levels) in the campaign, from 0."""
    label: str
    """Description of the cell (combination of factor levels) in one line: the level of each factor."""
    levels: dict[str, FactorLevelValue] = Field(default_factory=dict)
    """Level of each factor, by the factor's name."""
    scenario_changes: dict[str, Any] = Field(default_factory=dict)
    """Values that replace those of the base scenario in this cell (combination of factor levels), by dotted key."""
    digest: str = ""
    """Digest of everything that determines the rows of the cell (combination of factor levels). The metadata of its
    files of rows (shards) contain it too."""


FACTORS_TABLE = Table(
    "varied.csv",
    "factors: keys of the scenario whose values differ between cells (combinations of factor levels)",
    text_columns(
        factor="title of the factor", values="its levels", key="key of the scenario", meaning="meaning of the key"
    ),
)
MEANS_BY_FACTOR_LEVEL_TABLE = Table(
    "levels.csv",
    "means of a statistic for each level of each factor",
    (
        *text_columns(factor="title of the factor", level="level of the factor", method="name of the method"),
        *text_columns(statistic="name of the statistic"),
        *number_columns(mean="mean over all cells (combinations of factor levels) with this level"),
        *number_columns(least_cell="smallest mean of such a cell", largest_cell="largest mean of such a cell"),
    ),
)
ERRORS_BEFORE_AND_AFTER_TABLE = Table(
    "errors.csv",
    "errors before and after calibration, with 95 % intervals of their means",
    (
        *text_columns(setting="factor levels of the cell", method="name of the method"),
        *number_columns(raw_um="error before calibration", calibrated_um="error after calibration"),
        *number_columns(noise_floor_um="error after correction by the true parameters"),
        *number_columns(share_removed="fraction of the correctable mean-square error that the calibration removes"),
    ),
)
METHOD_DIFFERENCES_TABLE = Table(
    "methods.csv",
    "paired differences of an error between methods, with 95 % intervals",
    (
        *text_columns(setting="factor levels of the cell", methods="first minus second method"),
        *number_columns(
            display_format=".3g",
            difference_um="mean difference on the same random draws; positive if the second method has less error",
            low_um="lower 95 % confidence limit",
            high_um="upper 95 % confidence limit",
        ),
        *text_columns(better="method with the smaller error, if the interval excludes 0"),
        *number_columns(trials="trials that both methods calibrated"),
    ),
)


class ManifestFile(ResultFile):
    """Content of `manifest.json`, the definition of a campaign.

    The file is written before the first row, and again if the campaign is extended.
    """

    FILE: ClassVar[str] = "manifest.json"
    MAX_TEXTS: ClassVar[int] = MAX_JSON_VALUES
    SHARES_EQUAL_OBJECTS: ClassVar[bool] = True
    format: Literal["ltsim-campaign-rows/1"] = "ltsim-campaign-rows/1"
    """Format and version of this file."""
    title: str = ""
    """Title of the campaign, free text."""
    seed: NonNegativeInt = 0
    """Seed of the random draws."""
    trials: NonNegativeInt
    """Largest number of trials of each cell (combination of factor levels)."""
    trials_per_shard: Annotated[int, Field(ge=1)] | None = None
    """Number of trials in a file of rows (shard); null if the campaign file declares no number."""
    methods: tuple[str, ...] = Field(min_length=1)
    """Names of the calibration methods."""
    factors: tuple[Factor, ...] = ()
    """Factors of the campaign: keys of the scenario whose values differ between cells (combinations of factor levels).
    """
    cells: tuple[CellEntry, ...] = Field(min_length=1)
    """Cells (combinations of factor levels) of the campaign."""
    versions: dict[str, str] = Field(default_factory=dict)
    """Versions of the software that computed the rows, by package."""
    processor: str = "unknown"
    """Type of the processor that computed the rows; processors of the same type compute identical bytes."""
    commit: str | None = None
    """Git commit of the ltsim checkout that computed the rows; null for an installed package."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Content of the campaign file."""
    scenarios: tuple[ScenarioSettings, ...] = ()
    """Scenario of each cell (combination of factor levels), with all its keys."""

    def text(self) -> str:
        """Text of the JSON file; scenarios are converted one by one, because 4,000 of them would take 200 MB."""
        content = self.model_copy(update={"scenarios": ()}).content()
        dumps = (scenario.model_dump(mode="json", by_alias=True, exclude_unset=True) for scenario in self.scenarios)
        return "".join([*json_object_parts(content, {"scenarios": dumps}), "\n"])

    def _summary_lines(self) -> list[str]:
        title = f"{self.title}: " if self.title else ""
        methods = ", ".join(self.methods)
        return [f"Campaign: {title}{len(self.cells)} cells, at most {self.trials} trials each, {methods}"]

    @field_validator("scenarios", mode="before")
    @classmethod
    def _share_equal_parts(cls, scenarios: Any) -> Any:
        """Scenarios whose equal parts are the same object; 4,000 separate scenarios take 120 MB."""
        return [*shared_json_values(scenarios)] if isinstance(scenarios, list) else scenarios

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        names = [factor.name for factor in self.factors]
        if len(set(names)) < len(names) or len(set(self.methods)) < len(self.methods):
            raise ValueError("two factors or two methods have the same name")
        if not all(factor.keys for factor in self.factors):
            raise ValueError("a factor has no key of the scenario")
        for number, cell in enumerate(self.cells):
            if cell.cell != number or {*cell.levels} != {*names}:
                raise ValueError(
                    f"entry {number + 1} of 'cells' should have the number {number} and a level for each factor"
                )
        number_of_shards(self.trials, self.trials_per_shard or max(self.trials, 1), len(self.cells))
        statistics = self.settings.get("statistics", [])
        if not (isinstance(statistics, list) and all(name in get_args(StatisticGroup) for name in statistics)):
            raise ValueError("the key statistics in settings is not a list of names of statistics")
        return self
