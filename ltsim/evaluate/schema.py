"""criteria.json: the paper's criteria as a file, also a part of calibration.json."""

from __future__ import annotations

from typing import ClassVar, Literal

from ltsim.recording.result_file import Entry, Known, ResultFile
from ltsim.recording.result_table import ResultTable, numbers, texts

NOMINAL = ResultTable(
    "nominal.csv",
    "points of a measuring machine, which `verify` compares with",
    (*texts(target="name"), *numbers(".4f", x_mm="coordinate", y_mm="coordinate", z_mm="coordinate")),
)


class SpreadEntry(Entry):
    """How far stations disagree [um]."""

    mean_um: Known = None
    max_um: Known = None


class CriterionEntry(Entry):
    """A criterion before and after a calibration."""

    before: SpreadEntry = SpreadEntry()
    after: SpreadEntry = SpreadEntry()
    improvement_percent: Known = None


class CriteriaFile(ResultFile):
    """`criteria.json`: from `evaluate` and `verify`."""

    FILE: ClassVar[str] = "criteria.json"
    format: Literal["ltsim-criteria/1"] = "ltsim-criteria/1"
    distance: CriterionEntry
    coordinate: CriterionEntry
    distance_to_first: CriterionEntry | None = None
