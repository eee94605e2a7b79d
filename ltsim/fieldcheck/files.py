"""check.json and two_face.csv: what a check found, for programs and for the report."""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Literal

from ltsim.fieldcheck.check import Check
from ltsim.fieldcheck.items import Item
from ltsim.recording.result_file import Finite, ResultFile, SourceEntry, write_result
from ltsim.results import Table, numbers, texts
from ltsim.units import ARCSECOND, MICROMETRE

TWO_FACE = Table(
    "two_face.csv",
    "half two-face differences with their limits, a row a pair",
    (
        *texts(station="name", target="name"),
        *numbers(row_1="of the first face, from 1", row_2="of the second face"),
        *numbers(".4f", half_range_um="half difference", half_across_arcsec="as half_range_um"),
        *numbers(".4f", half_elevation_arcsec="as half_range_um", limit_range_um="limit of half_range_um"),
        *numbers(".4f", limit_across_arcsec="as limit_range_um", limit_elevation_arcsec="as limit_range_um"),
        *texts(passed="yes or no"),
    ),
)


class CheckFile(ResultFile):
    """`check.json`: from `check`."""

    FILE: ClassVar[str] = "check.json"
    format: Literal["ltsim-check/1"] = "ltsim-check/1"
    """Which format and version this file is in."""
    passed: bool
    """Go."""
    sentence: str
    """Go or no-go, and why."""
    level: Finite
    """Chance of one false alarm in the whole recording."""
    items: tuple[Item, ...]
    """Every test, set-up by set-up."""


def check_file(check: Check) -> CheckFile:
    """The contents of `check.json`."""
    return CheckFile(
        recording=SourceEntry.of(check.recording),
        passed=check.passed,
        sentence=check.sentence,
        level=check.level,
        items=check.items,
    )


def two_face_csv(check: Check) -> str:
    """Half two-face differences with their limits, one row a pair."""
    rows = []
    units = (MICROMETRE, ARCSECOND, ARCSECOND)
    for setup in check.setups:
        if setup.faces is None:
            continue
        faces = setup.faces
        for k, pair in enumerate(faces.pairs.rows):
            at = setup.rows[pair]
            target = check.recording.targets[check.recording.target[at[0] - 1]]
            half = [value / unit for value, unit in zip(faces.pairs.half[k], units, strict=True)]
            limit = [value / unit for value, unit in zip(faces.limit[k], units, strict=True)]
            passed = "no" if faces.over[k].any() else "yes"
            rows.append([setup.station, target, *at.tolist(), *half, *limit, passed])
    return TWO_FACE.filled(rows).csv()


def write_check(check: Check, folder: Path, further: Mapping[str, str]) -> CheckFile:
    """Write `check.json`, `two_face.csv` and `further` texts (a picture) into a folder; give what was written.

    Raises
    ------
    RecordError
        When the folder cannot be written.
    """
    return write_result(folder, check_file(check), {TWO_FACE.file: two_face_csv(check), **further})
