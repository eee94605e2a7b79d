"""Coordinates in each instrument's own axes, as most people export them, turned into readings."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import RecordError
from ltsim.geometry.polar import to_polar
from ltsim.recording.conventions import Hints, PolarTable, length_meaning
from ltsim.recording.recording import SIGMA_COLUMNS
from ltsim.recording.tables import cells
from ltsim.recording.tables.header import PLACE, SIGMA_OF
from ltsim.recording.tables.meaning import Meaning
from ltsim.recording.tables.rows import Table
from ltsim.units import ARCSECOND, FACTOR, MILLIMETRE

ONE_FRAME = 2e-3
"""[m] Common targets of two set-ups that agree so well are in one frame already."""
TOLD = (
    "coordinates in each set-up's own axes are turned into distance, azimuth and elevation; what is stated as noise "
    "is that of the readings, and of both faces together"
)


def is_of_places(table: Table) -> bool:
    """Whether a table holds coordinates in place of readings."""
    roles = {c.role for c in table.columns}
    return {*PLACE} <= roles


def readings_of_places(table: Table, hints: Hints, file: Path) -> tuple[Meaning, Floats, list[dict[str, float]] | None]:
    """Raw readings (n, 3) of face 1, and the standard deviations of each pointing where those of x, y, z are stated.

    Raises
    ------
    RecordError
        Where a coordinate is missing, or all set-ups see their common targets in one frame.
    """
    for p in table.pointings:
        missing = next((axis for axis in PLACE if axis not in p.values), None)
        if missing:
            raise RecordError(f"the coordinate {missing} is missing", file=p.file, row=p.line)
    printed = np.array([[float(p.values[axis]) for axis in PLACE] for p in table.pointings])
    stated = next((c.unit for c in table.columns if c.role in PLACE and c.unit), "")
    length, notes = (stated, []) if stated else _by_size(printed, hints)
    points = printed * FACTOR[length]
    near = np.flatnonzero(np.linalg.norm(points, axis=1) < MILLIMETRE)
    if len(near):
        one = table.pointings[near[0]]
        raise RecordError("lies in the instrument itself, expected coordinates from it", file=one.file, row=one.line)
    _check_frames(table, points, file)
    meaning = Meaning("rad", "rad", length, "elevation", "counter-clockwise", (*notes, TOLD))
    return meaning, to_polar(points), _sigmas(table, points, length)


def _by_size(printed: Floats, hints: Hints) -> tuple[str, list[str]]:
    longest = np.linalg.norm(printed, axis=1)
    nobody = np.zeros(len(printed), dtype=np.int64)
    return length_meaning(PolarTable(nobody, nobody, longest, longest, longest), hints)


def _check_frames(table: Table, points: Floats, file: Path) -> None:
    """Refuse coordinates that were brought into one frame: as readings they would hold no network."""
    first: dict[str, tuple[str, Floats]] = {}
    gaps = []
    for p, point in zip(table.pointings, points, strict=True):
        station, place = first.setdefault(p.target, (p.station, point))
        if station != p.station:
            gaps.append(float(np.linalg.norm(point - place)))
    if len(gaps) > 2 and float(np.median(gaps)) < ONE_FRAME:
        message = (
            f"{len(gaps)} targets have the same coordinates from several set-ups: they are in one frame already; "
            "export them in the axes of each instrument"
        )
        raise RecordError(message, file=file)


def _sigmas(table: Table, points: Floats, length: str) -> list[dict[str, float]] | None:
    """Standard deviations along and across the beam of those of x, y, z."""
    columns = [next((c for c in table.columns if c.role == SIGMA_OF[axis]), None) for axis in PLACE]
    if any(column is None for column in columns):
        return None
    titles = [(c.title, FACTOR[c.unit or length]) for c in columns if c is not None]
    found: list[dict[str, float]] = []
    for p, (x, y, z) in zip(table.pointings, points.tolist(), strict=True):
        given = [cells.value(p.further.pop(title, ""), p.grouping) for title, _ in titles]
        if any(sigma is None or not sigma > 0 for sigma in given):
            found.append({})
            continue
        variance = np.array([float(sigma or 0) * factor for sigma, (_, factor) in zip(given, titles, strict=True)]) ** 2
        level, range_ = np.hypot(x, y), np.sqrt(x * x + y * y + z * z)
        along = np.array([x, y, z]) / range_
        aside = np.array([-y, x, 0.0]) / max(level, 1e-9)
        upward = np.cross(along, aside)
        sigma = [float(np.sqrt(direction**2 @ variance)) for direction in (along, aside, upward)]
        values = (sigma[0] / MILLIMETRE, sigma[1] / max(level, 1e-9) / ARCSECOND, sigma[2] / range_ / ARCSECOND)
        found.append(dict(zip(SIGMA_COLUMNS, values, strict=True)))
    return found
