"""Field book of a total station: set-ups over points with heights, and pointings from them."""

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ltsim.core.errors import RecordError
from ltsim.core.units import MILLIMETRE
from ltsim.recordings.air import NO_AIR_UNCERTAINTY
from ltsim.recordings.circle_orientations import circle_orientations, zeroed_circle_note
from ltsim.recordings.curvature import with_earth_curvature
from ltsim.recordings.files import SourceLocation
from ltsim.recordings.pointings import (
    NOT_MEASURED,
    Pointing,
    index_names,
    numbered_name,
    recording_of_pointings,
    separate_constant_heights,
)
from ltsim.recordings.recording import HEIGHT_COLUMNS, KIND_COLUMN, Recording
from ltsim.recordings.resolution import default_total_station
from ltsim.recordings.setup import Setup, Station, Target, Vector
from ltsim.recordings.tables.setups import marks_with_other_spelling, spelling_note


@dataclass
class FieldBook:
    """Content of a total station's file, as far as it is used."""

    path: Path
    station: str = ""
    setups: dict[str, tuple[str, float, Vector | None]] = field(default_factory=dict)
    """Point, height of the instrument [m] and coordinates [mm] of each set-up, by its name."""
    pointings: list[Pointing] = field(default_factory=list)
    skipped: int = 0

    def add_setup(self, name: str, height: float, place: Vector | None, location: SourceLocation) -> None:
        """Addition of a set-up; a station that is occupied again gets a number."""
        count = sum(point == location.name(name, "station") for point, _, _ in self.setups.values())
        self.station = numbered_name(name, count)
        self.setups[self.station] = (name, height, place)

    def add_pointing(
        self,
        target: str,
        location: SourceLocation,
        *,
        distance: float,
        horizontal: float,
        zenith: float,
        height: float = NOT_MEASURED,
        is_horizontal: bool = False,
    ) -> None:
        """Addition of a pointing: distance [m], clockwise circle and zenith angle [rad], NaN if not measured.

        Height [m].

        Raises RecordError before the first station, and for values beyond any instrument.
        """
        if not self.station:
            raise location.error("a measurement before any station is named; give --hint station=NAME")
        distance = distance or NOT_MEASURED
        if not (np.isnan(distance) or 0 < distance < 1e6):
            raise location.error(f"a distance of {distance:g} m")
        if not (np.isnan(zenith) or 0 <= zenith <= 2 * np.pi):
            raise location.error("a zenith angle outside the circle")
        elevation = np.pi / 2 - zenith + (2 * np.pi if zenith > np.pi else 0.0)
        if np.all(np.isnan([distance, horizontal, zenith])):
            self.skipped += 1
            return
        self.pointings.append(
            Pointing(
                self.station,
                location.name(target, "target"),
                2 if elevation > np.pi / 2 + 1e-9 else 1,
                distance,
                float(np.mod(-horizontal, 2 * np.pi)),
                elevation,
                covariates={HEIGHT_COLUMNS[1]: height / MILLIMETRE} if np.isfinite(height) else {},
                labels={KIND_COLUMN: "horizontal"} if is_horizontal and np.isfinite(distance) else {},
                source=f"{self.path.name}, line {location.row}",
            )
        )

    def make_recording(self, kind: str, *notes: str) -> Recording:
        """Recording with levelled set-ups over points and the noise of a total station.

        `kind` names the format in its notes. Set-ups of one point have one position.

        Raises RecordError where nothing was measured.
        """
        if not self.pointings:
            raise RecordError("holds no measurements", file=self.path)
        turned = self._separate_orientations()
        pointings, _, heights = separate_constant_heights(self.pointings)
        names = dict.fromkeys(p.station for p in pointings)
        marks = {p.target for p in pointings}
        other = marks_with_other_spelling([self.setups[p.station][0] for p in pointings], [p.target for p in pointings])
        points = {name: other.get(self.setups[name][0], self.setups[name][0]) for name in names}
        marks |= {point for point, count in Counter(points.values()).items() if count > 1}
        stations = {}
        for name, point in points.items():
            _, height, place = self.setups[name]
            stations[name] = Station(
                levelled=True,
                over=point if point in marks else None,
                instrument_height_mm=round(height / MILLIMETRE, 6),
                position_mm=place,
            )
        readings = np.array([[p.distance, p.azimuth, p.elevation] for p in pointings])
        instrument, noise = default_total_station(readings, f"it is {kind}")
        setup = Setup(
            title=self.path.stem,
            air=NO_AIR_UNCERTAINTY,
            instrument=instrument,
            stations=stations,
            targets={name: Target(height_mm=height) for name, height in heights.items()},
        )
        spelled = spelling_note({name: mark for name, mark in other.items() if mark in marks})
        all_notes = [noise, *turned, *spelled, *notes]
        return with_earth_curvature(recording_of_pointings(pointings, setup, notes=all_notes, file=self.path))

    def _separate_orientations(self) -> list[str]:
        """Separation (in place) of the orientations of a circle that was set anew into separate set-ups, with notes."""
        occupations, occupation = index_names([p.station for p in self.pointings], "station", self.path)
        _, sight = np.unique([f"{p.station}\n{p.target}\n{p.face}" for p in self.pointings], return_inverse=True)
        readings = np.array([[p.distance, p.azimuth, p.elevation] for p in self.pointings])
        orientation = circle_orientations(occupation, sight, readings)
        if orientation is None:
            return []
        keys = list(zip((p.station for p in self.pointings), orientation.tolist(), strict=True))
        name_by_key: dict[tuple[str, int], str] = {}
        counts: Counter[str] = Counter()
        for name, number in dict.fromkeys(keys):
            point = self.setups[name][0]
            name_by_key[name, number] = numbered_name(point, counts[point])
            counts[point] += 1
        self.setups = {new: self.setups[old] for (old, _), new in name_by_key.items()}
        self.pointings = [replace(p, station=name_by_key[key]) for p, key in zip(self.pointings, keys, strict=True)]
        return [zeroed_circle_note(len(name_by_key), len(occupations))]
