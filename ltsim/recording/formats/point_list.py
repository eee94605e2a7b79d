"""Lists of points: ``name x y z``, as SpatialAnalyzer writes them, with uncertainties and covariance.

Separated by blanks, tabs, commas or semicolons; a decimal comma where the separator is none. After the
coordinates there may be three or four standard deviations (x, y, z and their length) and the nine numbers
of the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import RecordError
from ltsim.recording.files import check_name, comma_number, is_number, read_lines
from ltsim.recording.recording import Recording
from ltsim.units import FACTOR

Unit = Literal["mm", "m"]
WIDTHS = (4, 7, 8, 16, 17)


@dataclass(frozen=True)
class PointList:
    """Names (n), points (n, 3) [m] and their covariance (n, 3, 3) [m^2], NaN where none is stated."""

    names: tuple[str, ...]
    points: Floats
    covariance: Floats
    notes: tuple[str, ...] = ()


def recognises(path: Path, head: str) -> bool:
    """Whether the first lines are a name and numbers of the right count."""
    lines = [line for line in head.splitlines() if line.strip() and not line.startswith("#")]
    whole = [_fields(line) for line in lines[: max(1, min(6, len(lines) - 1))]]
    return bool(whole) and all(
        len(f) in WIDTHS and all(is_number(x.replace(",", ".", 1)) for x in f[1:]) for f in whole
    )


def read_points(path: Path, unit: Unit | None = None, *, strict: bool = True) -> PointList:
    """Read a list of points; without `unit`, metres where no coordinate reaches 500, otherwise millimetres.

    A point listed twice with other coordinates is refused, or noted and kept as first listed where not `strict`.

    Raises
    ------
    RecordError
        For a malformed line, a point listed twice with other coordinates, or an empty list.
    """
    lines = read_lines(path)
    if lines[-1]:
        raise RecordError("the last line has no line break: it was cut", file=path, row=len(lines))
    rows: dict[str, list[float]] = {}
    notes = []
    for i, line in enumerate(lines):
        if not line.strip() or line.startswith("#"):
            continue
        name, values = _row(line, path, i + 1)
        if name in rows and rows[name] != values:
            message = f"the point {name} was listed before with other coordinates"
            if strict:
                raise RecordError(message, file=path, row=i + 1)
            notes.append(f"{message} in {path.name}: the first are taken")
        rows.setdefault(name, values)
    if not rows:
        raise RecordError("holds no points", file=path)
    points = np.array([values[:3] for values in rows.values()])
    chosen: Unit = unit or ("m" if float(np.abs(points).max()) < 500 else "mm")
    scale = FACTOR[chosen]
    if unit is None:
        notes.append(f"coordinates taken as {chosen}: the largest is {np.abs(points).max():.6g}")
    covariance = np.array([_covariance(values) for values in rows.values()]) * scale**2
    return PointList(tuple(rows), points * scale, covariance, tuple(notes))


def _fields(line: str) -> list[str]:
    for separator in (";", "\t"):
        if separator in line:
            return [f.strip() for f in line.split(separator) if f.strip()]
    commas = [f.strip() for f in line.split(",")]
    return commas if len(commas) in WIDTHS and all(map(is_number, commas[1:])) else line.split()


def _row(line: str, file: Path, row: int) -> tuple[str, list[float]]:
    fields = _fields(line)
    if len(fields) not in WIDTHS:
        raise RecordError(f"{len(fields)} fields, expected a name, x, y and z", file=file, row=row)
    name = check_name(fields[0], "point", file=file, row=row)
    return name, [comma_number(text, file=file, row=row) for text in fields[1:]]


def _covariance(values: list[float]) -> Floats:
    if len(values) >= 15:
        full = np.array(values[-9:]).reshape(3, 3)
        return np.asarray((full + full.T) / 2)
    if len(values) >= 6:
        return np.diag(np.square(values[3:6]))
    return np.full((3, 3), np.nan)


def read(path: Path, _hints: object = None) -> Recording:
    """A list of points is no recording: say so and what it is good for."""
    count = len(read_points(path).names)
    message = f"this is a list of {count} points without readings; it serves as nominal or known coordinates"
    raise RecordError(message, file=path)
