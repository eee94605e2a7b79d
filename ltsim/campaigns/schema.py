"""manifest.json, recovery.json and the tables beside them: what stands in them, for writers and readers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from ltsim.recording.result_file import Entry, Known, ResultFile
from ltsim.recording.result_table import ResultTable, numbers, texts

Whole = Annotated[int, Field(ge=0)]
LEVELS = (0.025, 0.05, 0.25, 0.5, 0.75, 0.95, 0.975)
"""Of the quantiles."""

SUMMARY = "summary.csv"


def summary_table(factors: Mapping[str, str]) -> ResultTable:
    """`summary.csv` of a campaign: one row a cell, method and column of the rows; factors are names with kinds."""
    about = "setting of the cell, in the unit that manifest.json says"
    settings = [
        column
        for name, kind in factors.items()
        for column in (numbers if kind in ("number", "integer") else texts)(**{name: about})
    ]
    return ResultTable(
        SUMMARY,
        "every statistic over the trials of a cell and method, with the settings of the cell",
        (
            *numbers(cell="number"),
            *settings,
            *texts(method="name", column="of the rows", unit="of all that follows but trials"),
            *numbers(trials="that have it"),
            *numbers("r", mean="over them", deviation="standard deviation"),
            *numbers("r", low="95 % bound of the mean", high="as low", least="of all", largest="of all"),
            *numbers("r", **{f"quantile_{100 * level:g}_percent": "over the trials" for level in LEVELS}),
        ),
    )


def trials_table(parameters: tuple[str, ...]) -> ResultTable:
    """`trials.csv` of a recovery: one row a trial that converged."""
    return ResultTable(
        "trials.csv",
        "errors over their stated sigmas, one row a trial",
        (
            *numbers(trial="number, from 0"),
            *numbers(".6g", **dict.fromkeys(parameters, "error of the parameter over its sigma")),
            *numbers(".6g", chi2="of the fit", dof="degrees of freedom"),
            *numbers(".6g", targets="mean square of errors over sigmas", stations="as targets"),
        ),
    )


class FactorEntry(Entry):
    """Something that differs between cells."""

    name: str
    """Its column in rows and summary."""
    keys: tuple[str, ...]
    """Dotted keys of the scenario that take its value."""
    unit: str = ""
    """Of its values."""
    kind: Literal["number", "integer", "boolean", "string", "table"] = "number"
    """Of values; tables stand as JSON."""


class CellEntry(Entry):
    """One cell of the grid."""

    cell: Whole
    """Its number."""
    label: str
    """What it is, in a line."""
    levels: dict[str, Any] = Field(default_factory=dict)
    """Value of each factor, by the factor's name."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """What it changes, by dotted key."""


class ManifestFile(ResultFile):
    """`manifest.json`: what a campaign is, written before its first row."""

    FILE: ClassVar[str] = "manifest.json"
    format: Literal["ltsim-campaign-rows/1"] = "ltsim-campaign-rows/1"
    """Which format and version this file is in."""
    title: str = ""
    """Free text."""
    fingerprint: str = ""
    """Digest of all that decides the rows; each shard says it too."""
    seed: Whole = 0
    """Root of the random draws."""
    trials: Whole
    """Of each cell, at most."""
    shard: Whole | None = None
    """Trials a file of rows."""
    methods: tuple[str, ...] = Field(min_length=1)
    """Names of the calibrators."""
    factors: tuple[FactorEntry, ...] = ()
    """What differs between cells; rows of a manifest without it hold no settings, readers take them from the cells."""
    cells: tuple[CellEntry, ...] = Field(min_length=1)
    """Of grid and design."""
    versions: dict[str, str] = Field(default_factory=dict)
    """Of what made the rows."""
    processor: str = "unknown"
    """Its type: rows are the same bytes on one type."""
    commit: str | None = None
    """Of the source, where it is known."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """The campaign file."""
    scenarios: tuple[dict[str, Any], ...] = ()
    """That of each cell."""


class CheckEntry(Entry):
    """One number that has to lie between two bounds."""

    what: str
    """Parameter, or chi-square, targets, stations."""
    statistic: str
    """Which number of it."""
    value: Known
    """What it is."""
    low: Known
    """What it should not be below."""
    high: Known
    """What it should not be above."""
    passed: bool
    """It lies between."""


class RecoveryFile(ResultFile):
    """`recovery.json`: from `recover`."""

    FILE: ClassVar[str] = "recovery.json"
    format: Literal["ltsim-recovery/1"] = "ltsim-recovery/1"
    """Which format and version this file is in."""
    passed: bool
    """All checks passed."""
    errors: Literal["drawn", "stated"] = "drawn"
    """Whether the instrument's errors were drawn from the prior, or as the scenario states them."""
    trials: Whole
    """How many."""
    converged: Whole
    """How many gave a result."""
    seed: Whole
    """Root of the random draws."""
    checks: tuple[CheckEntry, ...]
    """One number each."""
