"""manifest.json, recovery.json and the tables beside them: what stands in them, for writers and readers."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from ltsim.recording.result_file import Entry, Known, ResultFile
from ltsim.recording.result_table import ResultTable, numbers, texts

Whole = Annotated[int, Field(ge=0)]
LEVELS = (0.025, 0.05, 0.25, 0.5, 0.75, 0.95, 0.975)
"""Of the quantiles."""

SUMMARY = ResultTable(
    "summary.csv",
    "every statistic over the trials of a cell and method",
    (
        *numbers(cell="number"),
        *texts(method="name", column="of the rows"),
        *numbers(trials="that have it"),
        *numbers("r", mean="over them", deviation="standard deviation", low="95 % bound of the mean", high="as low"),
        *numbers("r", least="of all", largest="of all"),
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


class CellEntry(Entry):
    """One cell of the grid."""

    cell: Whole
    label: str
    settings: dict[str, Any] = Field(default_factory=dict)


class ManifestFile(ResultFile):
    """`manifest.json`: what a campaign is, written before its first row."""

    FILE: ClassVar[str] = "manifest.json"
    format: Literal["ltsim-campaign-rows/1"] = "ltsim-campaign-rows/1"
    title: str = ""
    fingerprint: str = Field("", description="Digest of all that decides the rows; each shard says it too.")
    seed: Whole = 0
    trials: Whole
    shard: Whole | None = None
    methods: tuple[str, ...] = Field(min_length=1)
    cells: tuple[CellEntry, ...] = Field(min_length=1)
    versions: dict[str, str] = Field(default_factory=dict)
    processor: str = "unknown"
    commit: str | None = None
    settings: dict[str, Any] = Field(default_factory=dict)
    scenarios: tuple[dict[str, Any], ...] = ()


class CheckEntry(Entry):
    """One number that has to lie between two bounds."""

    what: str
    statistic: str
    value: Known
    low: Known
    high: Known
    passed: bool


class RecoveryFile(ResultFile):
    """`recovery.json`: from `recover`."""

    FILE: ClassVar[str] = "recovery.json"
    format: Literal["ltsim-recovery/1"] = "ltsim-recovery/1"
    passed: bool
    trials: Whole
    converged: Whole
    seed: Whole
    checks: tuple[CheckEntry, ...]
