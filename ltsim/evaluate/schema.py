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
    """Mean over pairs or targets."""
    max_um: Known = None
    """Largest."""


class CriterionEntry(Entry):
    """A criterion before and after a calibration."""

    before: SpreadEntry = SpreadEntry()
    """Readings as they are."""
    after: SpreadEntry = SpreadEntry()
    """Readings corrected."""
    improvement_percent: Known = None
    """Of the mean."""


class CriteriaFile(ResultFile):
    """`criteria.json`: from `evaluate` and `verify`."""

    FILE: ClassVar[str] = "criteria.json"
    format: Literal["ltsim-criteria/1"] = "ltsim-criteria/1"
    """Which format and version this file is in."""
    distance: CriterionEntry
    """Deviations of distances from their mean over stations."""
    coordinate: CriterionEntry
    """Deviations of coordinates after a rigid fit (eq. 12)."""
    distance_to_first: CriterionEntry | None = None
    """Deviations of distances from the first station's (eq. 11)."""
