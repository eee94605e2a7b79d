"""criteria.json: the paper's criteria as a file, also a part of calibration.json."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import ClassVar, Literal

from pydantic import Field

from ltsim.notation import with_sigma
from ltsim.recording.result_file import Entry, Finite, Known, ResultFile
from ltsim.recording.result_table import ResultTable
from ltsim.results import Result, Table, columns_of, numbers, texts

NOMINAL = ResultTable(
    "nominal.csv",
    "points of a measuring machine, which `verify` compares with",
    (*texts(target="name"), *numbers(".4f", x_mm="coordinate", y_mm="coordinate", z_mm="coordinate")),
)
BENCH = ResultTable(
    "bench.csv",
    "a reflector on the roundness table, which `bench` evaluates; empty where a length or the probe was not read",
    numbers(
        ".4f",
        angle_deg="turn of the table, 0 where the reflector looks at the interferometer",
        length_um="length by the interferometer, from any zero",
        probe_um="displacement of the sphere's surface at the probe, outward",
    ),
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


class EstimateEntry(Entry):
    """A length with its standard deviation."""

    value_um: Finite
    """Estimate."""
    sigma_um: Finite
    """Standard deviation."""


class BenchRow(Entry):
    """The reflector at one angle of incidence; all less the value nearest 0 deg."""

    angle_deg: Finite
    """Turn of the table."""
    as_read_um: Finite
    """Length with the eccentricity still in it."""
    error_um: Finite
    """The reflector's own range error, reading minus truth."""
    sigma_um: Finite
    """Standard deviation of the error."""


ANGLES = Table(
    "angles.csv",
    "the reflector's range error against incidence",
    columns_of(
        BenchRow,
        angle_deg={"title": "incidence", "shown": "+.1f"},
        as_read_um={"shown": ".2f"},
        error_um={"title": "range error", "sigma": "sigma_um"},
    ),
)


class BenchFile(ResultFile, Result):
    """`bench.json`: from `bench`."""

    FILE: ClassVar[str] = "bench.json"
    format: Literal["ltsim-bench/1"] = "ltsim-bench/1"
    """Which format and version this file is in."""
    eccentricity_forward: EstimateEntry
    """Sphere's centre off the table's axis at 0 deg, towards the interferometer."""
    eccentricity_side: EstimateEntry
    """The same to the side."""
    run_out_um: Finite
    """Largest less smallest displacement that the probe saw."""
    angles: tuple[BenchRow, ...] = Field(alias="table")
    """Range error against incidence."""
    vertex_axial: EstimateEntry
    """Vertex of the mirrors off the sphere's centre, out of the open face, if an offset is the cause."""
    vertex_side: EstimateEntry
    """The same to the side."""
    remainder_um: Finite
    """Root mean square of what no offset of the vertex explains: optics."""

    __repr__ = __str__ = Result.__repr__

    def _lines(self) -> list[str]:
        worst = max(self.angles, key=lambda row: abs(row.error_um))
        size = with_sigma(worst.error_um, worst.sigma_um, "um")
        return [f"Bench: {len(self.angles)} angles, range error at most {size} at {worst.angle_deg:+.1f} deg"]

    def _tables(self) -> Mapping[str, Callable[[], Table]]:
        return {"angles": lambda: ANGLES.filled(self.angles)}
