"""comparison.json and displacements.csv: what two epochs say of each other."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from ltsim.arrays import Floats
from ltsim.recording.result_file import Entry, Finite, Known, ResultFile, SourceEntry, Vector, write_result
from ltsim.recording.result_table import ResultTable, numbers, texts
from ltsim.tasks.congruence import Congruence
from ltsim.units import MICROMETRE, MILLIMETRE

DISPLACEMENTS = ResultTable(
    "displacements.csv",
    "what every common point did from the first epoch to the second",
    (
        *texts(target="name", moved="True where it moved"),
        *numbers(".4f", x_mm="place in the first epoch", y_mm="as x_mm", z_mm="as x_mm"),
        *numbers(dx_um="displacement", dy_um="as dx_um", dz_um="as dx_um"),
        *numbers(sx_um="standard deviation of dx_um", sy_um="as sx_um", sz_um="as sx_um"),
        *numbers(a_um="semi-axes of its 95 % ellipsoid", b_um="as a_um", c_um="as a_um"),
        *numbers(p_value="that it did not move", visible_um="smallest that is found with 80 %"),
    ),
)


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
    second: SourceEntry
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


def comparison_file(found: Congruence, first: SourceEntry, second: SourceEntry, places: Floats) -> ComparisonFile:
    """The contents of the file; `places` (T, 3) [m] are the common points in the first epoch."""
    entries = []
    for d, place in zip(found.displacements, places, strict=True):
        entries.append(
            DisplacementEntry(
                target=d.target,
                moved=d.moved,
                place_mm=_vector(place / MILLIMETRE),
                shift_um=_vector(d.shift / MICROMETRE),
                sigma_um=_vector(d.covariance.diagonal() ** 0.5 / MICROMETRE),
                semi_axes_um=_vector(d.semi_axes() / MICROMETRE),
                p_value=d.p_value,
                visible_um=(d.least / MICROMETRE, d.surely / MICROMETRE),
                own_chi2=None if np.isnan(d.own) else d.own,
            )
        )
    return ComparisonFile(
        recording=first,
        second=second,
        sentence=found.sentence,
        level=found.level,
        statistic=found.statistic,
        dof=found.dof,
        p_value=found.p_value,
        p_value_after=found.after,
        scale_ppm=None if found.scale is None else 1e6 * found.scale,
        displacements=tuple(entries),
    )


def _vector(values: Floats) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


def write_comparison(content: ComparisonFile, folder: Path) -> ComparisonFile:
    """Write comparison.json and displacements.csv into a folder and give what was written; raises RecordError."""
    rows = [
        [d.target, d.moved, *d.place_mm, *d.shift_um, *d.sigma_um, *d.semi_axes_um, d.p_value, d.visible_um[1]]
        for d in content.displacements
    ]
    return write_result(folder, content, {DISPLACEMENTS.file: DISPLACEMENTS.text(rows)})
