"""What the numbers of a table mean: units, zenith or elevation, the sense of the circle; coordinates for readings.

What the header states is taken; the rest is decided by the data (`ltsim.recording.conventions`) or asked for. The
mirror image of a network is a network: no data decide the sense of the circle, unless places are known. The words of
a header do: `Hz`, `HA` are the horizontal circle of a theodolite, clockwise; azimuth and elevation are the spherical
coordinates of a tracker, counter-clockwise. An azimuth beside a zenith angle can be either and is asked for.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from itertools import product
from pathlib import Path

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import RecordError
from ltsim.geometry.polar import from_polar, to_polar, unit_vectors
from ltsim.recording.conventions import (
    SENSE_UNKNOWN,
    Azimuth,
    Hints,
    PolarTable,
    Pose,
    Vertical,
    angle_meaning,
    known_sense,
    length_meaning,
    sense_by_poses,
)
from ltsim.recording.files import shown
from ltsim.recording.pointings import indices
from ltsim.recording.recording import SIGMA_COLUMNS
from ltsim.recording.slips import SHORTEST_MM
from ltsim.recording.tables import cells
from ltsim.recording.tables.header import DISTANCE, HEIGHTS, HORIZONTAL, PLACE, SIGMA, SIGMA_OF, VERTICAL, TableColumn
from ltsim.recording.tables.rows import PointingTable, Printed
from ltsim.units import ARCSECOND, DEGREE, FACTOR, MILLIMETRE, ratio

FULL, QUARTER = Decimal(360), Decimal(90)
TALL_M = (0.2, 3.0)
"""[m] Heights of instruments and targets over their marks lie here: they tell metres from millimetres."""
AMBIGUOUS_MM = 1000.0
"""Longest distance that may as well be in metres."""
ONE_FRAME = 2e-3
"""[m] Common targets of two set-ups that agree so well are in one frame already."""
TOLD = (
    "coordinates in each set-up's own axes are turned into distance, azimuth and elevation; what is stated as noise "
    "is that of the readings, and of both faces together"
)


@dataclass(frozen=True)
class Meaning:
    """How the printed numbers become raw readings; `notes` says what was decided."""

    horizontal_unit: str
    vertical_unit: str
    length_unit: str
    vertical: Vertical
    azimuth: Azimuth
    notes: tuple[str, ...] = ()

    def readings(self, p: Printed) -> tuple[float, float, float]:
        """Raw range [m], azimuth, elevation [rad] of a pointing, in the numbers that a native file would hold."""
        length = turn = up = Decimal("nan")
        if (printed := _of(p, DISTANCE)) is not None:
            length = printed * ratio(self.length_unit, "mm")
        if (printed := _of(p, HORIZONTAL)) is not None:
            turn = printed * ratio(self.horizontal_unit, "deg")
            if self.azimuth == "clockwise":
                turn = -turn % FULL
                turn += FULL if turn < 0 else 0
        if (printed := _of(p, VERTICAL)) is not None:
            up = printed * ratio(self.vertical_unit, "deg")
            up = QUARTER - up if self.vertical == "zenith" else up
            up += FULL if up < -QUARTER else 0
        return float(length) * MILLIMETRE, float(turn) * DEGREE, float(up) * DEGREE

    def unit_of(self, role: str) -> str:
        """The unit of the readings that a column of sigmas or heights stands beside, where it states none."""
        return {"sigma_azimuth_arcsec": self.horizontal_unit, "sigma_elevation_arcsec": self.vertical_unit}.get(
            role, self.length_unit
        )


def _of(p: Printed, kind: Sequence[str]) -> Decimal | None:
    return next((p.values[role] for role in kind if role in p.values), None)


def readings_of(table: PointingTable, poses: Mapping[int, Pose], hints: Hints, file: Path) -> tuple[Meaning, Floats]:
    """What the table's numbers mean, and the raw readings (n, 3) [m, rad] that they are.

    Rough `poses` of stations, by the order in which the table names them, tell the sense of the circle.

    Raises RecordError, asking for what neither header nor data decide, with the option to type.
    """
    if table.holds_places:
        return _readings_of_places(table, hints, file)
    columns = {kind[0]: table.column(kind) for kind in (HORIZONTAL, VERTICAL, DISTANCE)}
    stated = {kind: c.unit if c is not None else "" for kind, c in columns.items()}
    _, station = indices((p.station for p in table.pointings), "station", file)
    _, target = indices((p.target for p in table.pointings), "target", file)
    printed = [[_of(p, kind) for kind in (HORIZONTAL, VERTICAL, DISTANCE)] for p in table.pointings]
    polar = PolarTable(station, target, *np.array(printed, dtype=np.float64).T)
    units, vertical, notes = _angles(columns, stated, polar, hints, file)
    length, more = _length(stated["distance"], polar, table, hints, file)
    found = Meaning(*units, length, vertical, "counter-clockwise")
    azimuth, why = _sense(table, found, polar, poses, hints, file)
    found = replace(found, azimuth=azimuth, notes=(*notes, *more, *why))
    return found, np.array([found.readings(p) for p in table.pointings])


def _angles(
    columns: Mapping[str, TableColumn | None], stated: Mapping[str, str], polar: PolarTable, hints: Hints, file: Path
) -> tuple[tuple[str, str], Vertical, list[str]]:
    column = columns["vertical"]
    role = column.role if column is not None else ""
    said: Vertical | None = "zenith" if role == "zenith" else "elevation" if role == "elevation" else None
    if column is None:
        said = "elevation"
    one, other = stated["horizontal"], stated["vertical"]
    unit = one or other or hints.angle or ""
    # The data are asked in one unit: angles in different ones are brought to degrees first.
    asked, known = polar, None
    if unit:
        turns = [float(ratio(u or unit, "deg")) for u in (one, other)]
        asked = replace(polar, horizontal=polar.horizontal * turns[0], vertical=polar.vertical * turns[1])
        known = "deg"
    if known and (said or hints.vertical):
        return (one or unit, other or unit), hints.vertical or said or "elevation", []
    answer = replace(hints, angle=known or hints.angle, vertical=hints.vertical or said)  # type: ignore[arg-type]
    angle, vertical, notes = angle_meaning(asked, answer, file)
    if known and column is not None:
        notes = [f"'{column.title}' taken as {vertical} angles: {note.partition(': ')[2]}" for note in notes]
    return (one or unit or angle, other or unit or angle), vertical, notes


def _length(stated: str, polar: PolarTable, table: PointingTable, hints: Hints, file: Path) -> tuple[str, list[str]]:
    """Unit of the distances: as stated, by heights beside them, by their size, or asked for."""
    if stated or not np.isfinite(polar.distance).any():
        return stated or hints.length or "mm", []
    longest = float(np.nanmax(polar.distance))
    if hints.length is not None or not SHORTEST_MM <= longest < AMBIGUOUS_MM:
        return length_meaning(polar.distance, hints)
    if table.column(("flat",)) is not None:
        return "m", ["distances taken as m: they are horizontal ones, as surveyors write them"]
    column = next((c for c in table.columns if c.role in HEIGHTS and not c.unit), None)
    heights = [] if column is None else [cells.value(p.further.get(column.title, "")) for p in table.pointings]
    tall = [abs(float(height)) for height in heights if height]
    if column is not None and tall and TALL_M[0] < float(np.median(tall)) < TALL_M[1]:
        return "m", [f"distances taken as m: '{shown(column.title)}' beside them holds heights of metres"]
    message = f"distances of up to {longest:.6g} may be metres or millimetres; say which: --hint length=m or"
    raise RecordError(f"{message} --hint length=mm", file=file)


def _sense(
    table: PointingTable, meaning: Meaning, polar: PolarTable, poses: Mapping[int, Pose], hints: Hints, file: Path
) -> tuple[Azimuth, list[str]]:
    """The sense of the circle: said, by known places, or by the words of the header."""
    if hints.azimuth is not None or not np.isfinite(polar.horizontal).any():
        return hints.azimuth or "counter-clockwise", []
    local = from_polar(np.array([meaning.readings(p) for p in table.pointings]))
    if hints.points is not None:
        return known_sense(local, polar, list(dict.fromkeys(p.target for p in table.pointings)), hints.points)
    azimuth = sense_by_poses(local, polar, poses) if len(poses) > 1 else None
    if azimuth is not None:
        return azimuth, [f"azimuths taken as {azimuth}: so the set-ups see the same points from their rough places"]
    column = table.column(HORIZONTAL)
    if table.positional or column is None:
        raise RecordError(SENSE_UNKNOWN, file=file)
    if column.role == "horizontal":
        circle = f"'{column.title}' taken as a horizontal circle, clockwise"
        return "clockwise", [
            f"{circle} (--hint azimuth=counter-clockwise says otherwise); this file alone cannot show it"
        ]
    if meaning.vertical == "elevation":
        spherical = "azimuth beside elevation taken as counter-clockwise (--hint azimuth=clockwise says otherwise)"
        return "counter-clockwise", [spherical]
    raise RecordError(SENSE_UNKNOWN, file=file)


def _readings_of_places(table: PointingTable, hints: Hints, file: Path) -> tuple[Meaning, Floats]:
    """Coordinates as readings of face 1.

    Raises RecordError where a coordinate is missing, or all set-ups see their common targets in one frame.
    """
    for p in table.pointings:
        missing = next((axis for axis in PLACE if axis not in p.values), None)
        if missing:
            raise p.where.wrong(f"the coordinate {missing} is missing")
    printed = np.array([[float(p.values[axis]) for axis in PLACE] for p in table.pointings])
    length = next((c.unit for c in table.columns if c.role in PLACE and c.unit), "")
    notes: list[str] = []
    if not length:
        length, notes = length_meaning(np.linalg.norm(printed, axis=1), hints)
    readings = to_polar(printed * FACTOR[length])
    near = np.flatnonzero(readings[:, 0] < MILLIMETRE)
    if len(near):
        raise table.pointings[near[0]].where.wrong("lies in the instrument itself, expected coordinates from it")
    _check_frames(table, printed * FACTOR[length], file)
    return Meaning("rad", "rad", length, "elevation", "counter-clockwise", (*notes, TOLD)), readings


def _check_frames(table: PointingTable, points: Floats, file: Path) -> None:
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


def sigmas_of_places(table: PointingTable, readings: Floats, length: str) -> list[dict[str, float]] | None:
    """Standard deviations of each pointing's readings (n, 3) by those of x, y, z, where the table states them."""
    columns = [table.column((SIGMA_OF[axis],)) or table.column((SIGMA,)) for axis in PLACE]
    titles = [(c.title, FACTOR[c.unit or length]) for c in columns if c is not None]
    if not table.holds_places or len(titles) < len(PLACE):
        return None
    given = [[cells.value(p.further.get(title, ""), p.grouping) for title, _ in titles] for p in table.pointings]
    for p, (title, _) in product(table.pointings, titles):
        p.further.pop(title, None)
    stated = np.array([[float(s) if s is not None and s > 0 else np.nan for s in row] for row in given])
    variance = (stated * [factor for _, factor in titles]) ** 2
    range_, azimuth, elevation = readings.T
    ways = np.stack(unit_vectors(azimuth, elevation), axis=1) ** 2
    level = np.maximum(range_ * np.cos(elevation), 1e-9)
    units = np.stack([np.full(len(range_), MILLIMETRE), level * ARCSECOND, range_ * ARCSECOND], axis=1)
    sigma = np.sqrt(np.einsum("nki,ni->nk", ways, variance)) / units
    return [dict(zip(SIGMA_COLUMNS, row, strict=True)) if row[0] == row[0] else {} for row in sigma.tolist()]
