"""comparison.json and displacements.csv: what two epochs say of each other."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from ltsim.recording.result_file import Entry, Finite, Known, ResultFile, SourceEntry, Vector, write_result
from ltsim.tasks.congruence import DISPLACEMENTS as DISPLACEMENTS, Congruence
from ltsim.units import MICROMETRE, MILLIMETRE


class DisplacementEntry(Entry):
    """One point: place in the first epoch [mm], displacement and its uncertainty [um]."""

    target: str
    """Name of the target."""
    moved: bool
    """The test says so."""
    place_mm: Vector
    """In the first epoch."""
    shift_um: Vector
    """Second minus first epoch."""
    sigma_um: Vector
    """Of each component."""
    semi_axes_um: Vector
    """Of its error ellipsoid."""
    p_value: Finite
    """that the point did not move, paid for all points tested"""
    visible_um: tuple[Finite, Finite]
    """smallest motion found with 80 %: best and worst direction"""
    own_chi2: Known = None
    """of the point's own difference between epochs in one frame, whatever the others did"""


class ComparisonFile(ResultFile):
    """`comparison.json`: from `compare`; `recording` is the first epoch."""

    FILE: ClassVar[str] = "comparison.json"
    format: Literal["ltsim-comparison/1"] = "ltsim-comparison/1"
    """Which format and version this file is in."""
    second: SourceEntry | None
    """The second epoch."""
    sentence: str
    """The answer for a person."""
    level: Finite
    """probability that any point is told to have moved when none did"""
    statistic: Finite
    """of the global test: no point moved; chi-square"""
    dof: int
    """Degrees of freedom of the global test."""
    p_value: Finite
    """Of the global test."""
    p_value_after: Finite
    """of the same test without the points that moved"""
    scale_ppm: Known = None
    """of the second epoch, where it was estimated"""
    displacements: tuple[DisplacementEntry, ...]
    """One a common point."""


def comparison_file(found: Congruence) -> ComparisonFile:
    """The contents of the file."""
    return ComparisonFile(
        recording=found.first,
        second=found.second,
        sentence=found.sentence,
        level=found.level,
        statistic=found.statistic,
        dof=found.dof,
        p_value=found.p_value,
        p_value_after=found.after,
        scale_ppm=None if found.scale is None else 1e6 * found.scale,
        displacements=tuple(
            DisplacementEntry(
                target=d.target,
                moved=d.moved,
                place_mm=(d.place / MILLIMETRE).tolist(),
                shift_um=(d.shift / MICROMETRE).tolist(),
                sigma_um=(d.covariance.diagonal() ** 0.5 / MICROMETRE).tolist(),
                semi_axes_um=(d.semi_axes() / MICROMETRE).tolist(),
                p_value=d.p_value,
                visible_um=(d.least / MICROMETRE, d.surely / MICROMETRE),
                own_chi2=d.own,
            )
            for d in found.displacements
        ),
    )


def write_comparison(found: Congruence, folder: Path) -> ComparisonFile:
    """Write comparison.json and displacements.csv into a folder and give what was written; raises RecordError."""
    return write_result(folder, comparison_file(found), {DISPLACEMENTS.file: found.table().csv()})
