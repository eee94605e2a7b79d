"""What the numbers of a table mean: units, zenith or elevation, the sense of the circle, faces.

What the header states is taken; the rest is decided by the data (`ltsim.recording.conventions`) or asked for. The
mirror image of a network is a network: no data decide the sense of the circle, unless places are known. The words of
a header do: `Hz`, `HA` are the horizontal circle of a theodolite, clockwise; azimuth and elevation are the spherical
coordinates of a tracker, counter-clockwise. An azimuth beside a zenith angle can be either and is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path

import numpy as np

from ltsim.errors import RecordError
from ltsim.geometry.polar import from_polar
from ltsim.recording.build import indices
from ltsim.recording.conventions import (
    Azimuth,
    Hints,
    PolarTable,
    Vertical,
    angle_meaning,
    known_sense,
    length_meaning,
    poses_of,
    sense_by_poses,
    sense_unknown,
)
from ltsim.recording.files import shown
from ltsim.recording.plausibility import SHORTEST_MM
from ltsim.recording.setup import Setup
from ltsim.recording.tables import cells
from ltsim.recording.tables.header import DISTANCE, HEIGHTS, HORIZONTAL, VERTICAL, Column
from ltsim.recording.tables.rows import Printed, Table
from ltsim.units import DEGREE, MILLIMETRE, ratio

HALF, FULL, QUARTER = Decimal(180), Decimal(360), Decimal(90)
TALL_M = (0.2, 3.0)
"""[m] Heights of instruments and targets over their marks lie here: they tell metres from millimetres."""
AMBIGUOUS_MM = 1000.0
"""Longest distance that may as well be in metres."""


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


def _float(value: Decimal | None) -> float:
    return np.nan if value is None else float(value)


def _of(p: Printed, kind: Sequence[str]) -> Decimal | None:
    return next((p.values[role] for role in kind if role in p.values), None)


def meaning_of(table: Table, setup: Setup, hints: Hints, file: Path) -> Meaning:
    """What the table's numbers mean.

    Raises
    ------
    RecordError
        Asking for what neither header nor data decide, with the option to type.
    """
    columns = {kind[0]: table.column(kind) for kind in (HORIZONTAL, VERTICAL, DISTANCE)}
    stated = {kind: c.unit if c is not None else "" for kind, c in columns.items()}
    polar = _polar(table, file)
    units, vertical, notes = _angles(columns, stated, polar, hints, file)
    length, more = _length(stated["distance"], polar, table, hints, file)
    found = Meaning(*units, length, vertical, "counter-clockwise")
    azimuth, why = _sense(table, found, polar, setup, hints, file)
    return replace(found, azimuth=azimuth, notes=(*notes, *more, *why))


def _polar(table: Table, file: Path) -> PolarTable:
    """The numbers as printed, for whoever decides by them."""
    _, station = indices((p.station for p in table.pointings), "station", file)
    _, target = indices((p.target for p in table.pointings), "target", file)
    kinds = (HORIZONTAL, VERTICAL, DISTANCE)
    numbers = np.array([[_float(_of(p, kind)) for kind in kinds] for p in table.pointings])
    return PolarTable(station, target, *numbers.T)


def _angles(
    columns: Mapping[str, Column | None], stated: Mapping[str, str], polar: PolarTable, hints: Hints, file: Path
) -> tuple[tuple[str, str], Vertical, list[str]]:
    """Units of both angles and what the vertical one is."""
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


def _length(stated: str, polar: PolarTable, table: Table, hints: Hints, file: Path) -> tuple[str, list[str]]:
    """Unit of the distances: as stated, by heights beside them, by their size, or asked for."""
    if stated or not np.isfinite(polar.distance).any():
        return stated or hints.length or "mm", []
    longest = float(np.nanmax(polar.distance))
    if hints.length is not None or not SHORTEST_MM <= longest < AMBIGUOUS_MM:
        return length_meaning(polar, hints)
    column = next((c for c in table.columns if c.role in HEIGHTS and not c.unit), None)
    heights = [] if column is None else [cells.value(p.further.get(column.title, "")) for p in table.pointings]
    tall = [abs(float(height)) for height in heights if height]
    if column is not None and tall and TALL_M[0] < float(np.median(tall)) < TALL_M[1]:
        return "m", [f"distances taken as m: '{shown(column.title)}' beside them holds heights of metres"]
    message = f"distances of up to {longest:.6g} may be metres or millimetres; say which: --hint length=m or"
    raise RecordError(f"{message} --hint length=mm", file=file)


def _sense(
    table: Table, meaning: Meaning, polar: PolarTable, setup: Setup, hints: Hints, file: Path
) -> tuple[Azimuth, list[str]]:
    """The sense of the circle: said, by known places, or by the words of the header."""
    if hints.azimuth is not None or not np.isfinite(polar.horizontal).any():
        return hints.azimuth or "counter-clockwise", []
    readings = np.array([meaning.readings(p) for p in table.pointings])
    targets = tuple(dict.fromkeys(p.target for p in table.pointings))
    by_places = known_sense(from_polar(readings), polar, targets, hints)
    if by_places is not None:
        return by_places
    poses = poses_of(setup, tuple(dict.fromkeys(p.station for p in table.pointings)))
    azimuth = sense_by_poses(from_polar(readings), polar, poses) if len(poses) > 1 else None
    if azimuth is not None:
        return azimuth, [f"azimuths taken as {azimuth}: so the stations see the same points from their rough places"]
    column = table.column(HORIZONTAL)
    if table.positional or column is None:
        raise RecordError(sense_unknown(), file=file)
    if column.role == "horizontal":
        circle = f"'{column.title}' taken as a horizontal circle, clockwise"
        return "clockwise", [circle + " (--hint azimuth=counter-clockwise says otherwise)"]
    if meaning.vertical == "elevation":
        spherical = "azimuth beside elevation taken as counter-clockwise (--hint azimuth=clockwise says otherwise)"
        return "counter-clockwise", [spherical]
    raise RecordError(sense_unknown(), file=file)
