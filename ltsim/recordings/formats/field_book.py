"""Field book of a total station: set-ups over points and pointings, collected by the readers of several formats."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.core.errors import RecordError
from ltsim.core.limits import MAX_FIELD_BOOK_POINTINGS
from ltsim.core.units import MILLIMETRE
from ltsim.recordings.air import NO_AIR_UNCERTAINTY
from ltsim.recordings.circle_orientations import circle_orientation_numbers, circle_rotation_note
from ltsim.recordings.curvature import with_earth_curvature
from ltsim.recordings.files import SourceLocation
from ltsim.recordings.pointings import (
    NOT_MEASURED,
    Pointing,
    index_names,
    numbered_name,
    numbered_names,
    readings_of_pointings,
    recording_from_pointings,
    separate_constant_heights,
)
from ltsim.recordings.recording import DISTANCE_KIND_COLUMN, HEIGHT_COLUMNS, Recording
from ltsim.recordings.resolution import total_station_with_assumed_noise
from ltsim.recordings.setup import Setup, Station, Target, Vector
from ltsim.recordings.tables.setups import marks_with_other_spelling, spelling_notes


@dataclass
class FieldBook:
    """Set-ups and pointings that the reader of a total station's file has collected so far."""

    path: Path
    station: str = ""
    """Name of the latest set-up."""
    setups: dict[str, tuple[str, float, Vector | None]] = field(default_factory=dict)
    """Point under each set-up, height of its instrument [m] and coordinates [mm] of the point (None if unknown), by
    name of the set-up."""
    n_setups_by_point: Counter[str] = field(default_factory=Counter)
    """Number of set-ups over each point, by name of the point."""
    pointings: list[Pointing] = field(default_factory=list)
    n_skipped: int = 0
    """Number of records of the file that are not used."""
    _interned: dict[object, Any] = field(default_factory=dict)
    """Names and additional columns of pointings; equal ones share one object, which halves the memory of a pointing."""

    def add_setup(self, name: str, height: float, coordinates_mm: Vector | None, location: SourceLocation) -> None:
        """Addition of a set-up over the point `name`: instrument height [m], and coordinates [mm] of the point or None.

        A further set-up over one point gets the name of the point with a number.
        """
        self.station = numbered_name(location.checked_name(name, "station"), self.n_setups_by_point[name])
        self.n_setups_by_point[name] += 1
        self.setups[self.station] = (name, height, coordinates_mm)

    def add_pointing(
        self,
        target: str,
        location: SourceLocation,
        *,
        distance: float,
        horizontal: float,
        zenith: float,
        height: float = NOT_MEASURED,
        is_horizontal_distance: bool = False,
    ) -> None:
        """Addition of a pointing: distance [m], clockwise direction and zenith angle [rad], height of the target [m].

        A reading that was not measured is NaN. `horizontal` is the direction. `is_horizontal_distance` is True for a
        distance reduced to the horizontal plane.

        Raises RecordError if there is no set-up yet, for impossible readings, and for too many pointings.
        """
        if len(self.pointings) >= MAX_FIELD_BOOK_POINTINGS:
            raise location.error(
                f"more than {MAX_FIELD_BOOK_POINTINGS} measurements, the limit for reading; divide the file"
            )
        if not self.station:
            raise location.error("this measurement is before the first station; name it with --hint station=NAME")
        distance = distance or NOT_MEASURED
        if not (np.isnan(distance) or 0 < distance < 1e6):
            raise location.error(f"found a distance of {distance:g} m, expected one above 0 and below 1000 km")
        if not (np.isnan(zenith) or 0 <= zenith <= 2 * np.pi):
            raise location.error(f"found a zenith angle of {zenith:g} rad, expected one from 0 to a full circle")
        elevation = np.pi / 2 - zenith + (2 * np.pi if zenith > np.pi else 0.0)
        if np.all(np.isnan([distance, horizontal, zenith])):
            self.n_skipped += 1
            return
        self.pointings.append(
            Pointing(
                self.station,
                self._interned.setdefault(target, location.checked_name(target, "target")),
                2 if elevation > np.pi / 2 + 1e-9 else 1,
                distance,
                float(np.mod(-horizontal, 2 * np.pi)),
                elevation,
                covariates=self._interned_column(
                    HEIGHT_COLUMNS[1], height / MILLIMETRE if np.isfinite(height) else None
                ),
                labels=self._interned_column(
                    DISTANCE_KIND_COLUMN, "horizontal" if is_horizontal_distance and np.isfinite(distance) else None
                ),
                source=f"{self.path.name}, line {location.row}",
            )
        )

    def _interned_column(self, name: str, value: object) -> dict[str, Any]:
        """Dictionary with the value of an additional column of a pointing; empty if the value is None."""
        column: dict[str, Any] = self._interned.setdefault((name, value), {} if value is None else {name: value})
        return column

    def make_recording(self, kind: str, *notes: str) -> Recording:
        """Recording with levelled set-ups over points, and with the assumed noise of a total station.

        `kind` is the format of the file, for a note; `notes` are further notes. All set-ups over one point have one
        position.

        Raises RecordError if there are no measurements.
        """
        if not self.pointings:
            raise RecordError("the file contains no measurements", file=self.path)
        orientation_notes = self._separate_orientations()
        pointings, _, heights = separate_constant_heights(self.pointings)
        names = dict.fromkeys(p.station for p in pointings)
        marks = {p.target for p in pointings}
        respelled_marks = marks_with_other_spelling(
            [self.setups[p.station][0] for p in pointings], [p.target for p in pointings]
        )
        points = {name: respelled_marks.get(self.setups[name][0], self.setups[name][0]) for name in names}
        marks |= {point for point, count in Counter(points.values()).items() if count > 1}
        stations = {}
        shared_position = self._shared_position(points)
        for name, point in points.items():
            _, height, coordinates_mm = self.setups[name]
            stations[name] = Station(
                levelled=True,
                over=point if point in marks else None,
                instrument_height_mm=round(height / MILLIMETRE, 6),
                position_mm=None if shared_position is not None else coordinates_mm,
            )
        readings = readings_of_pointings(pointings)
        instrument, noise = total_station_with_assumed_noise(readings, f"it is {kind}")
        setup = Setup(
            title=self.path.stem,
            air=NO_AIR_UNCERTAINTY,
            instrument=instrument,
            stations=stations,
            targets={name: Target(height_mm=height) for name, height in heights.items()},
        )
        spelled = spelling_notes({name: mark for name, mark in respelled_marks.items() if mark in marks})
        placeholders = []
        if shared_position is not None:
            coordinates = ", ".join(f"{value * MILLIMETRE:g}" for value in shared_position)
            placeholders = [f"the stations have the same coordinates ({coordinates}) m, which are therefore not used"]
        all_notes = [noise, *orientation_notes, *spelled, *placeholders, *notes]
        return with_earth_curvature(recording_from_pointings(pointings, setup, notes=all_notes, file=self.path))

    def _shared_position(self, points: Mapping[str, str]) -> Vector | None:
        """Coordinates [mm] that all set-ups have, although they are over several points; None if they differ.

        `points` is the name of the point under each set-up. Instruments write equal coordinates, mostly zeros, if
        nobody entered the coordinates of a station.
        """
        positions = {self.setups[name][2] for name in points}
        shared = next(iter(positions))
        return shared if len(positions) == 1 and len(set(points.values())) > 1 else None

    def _separate_orientations(self) -> list[str]:
        """Replacement, in place, of each set-up with a rotated circle by one set-up for each orientation of the circle.

        The result is a list of notes for the user.
        """
        occupations, occupation = index_names([p.station for p in self.pointings], "station", self.path)
        targets, target = index_names([p.target for p in self.pointings], "target", self.path)
        face = np.fromiter((p.face for p in self.pointings), dtype=np.int64, count=len(self.pointings))
        sight = 2 * (occupation * len(targets) + target) + face
        readings = readings_of_pointings(self.pointings)
        orientation = circle_orientation_numbers(occupation, sight, readings)
        if orientation is None:
            return []
        keys = list(zip((p.station for p in self.pointings), orientation.tolist(), strict=True))
        distinct_keys = list(dict.fromkeys(keys))
        names = numbered_names(self.setups[name][0] for name, _ in distinct_keys)
        name_by_key = dict(zip(distinct_keys, names, strict=True))
        self.setups = {new: self.setups[old] for (old, _), new in name_by_key.items()}
        self.pointings = [replace(p, station=name_by_key[key]) for p, key in zip(self.pointings, keys, strict=True)]
        return [circle_rotation_note(len(name_by_key), len(occupations))]
