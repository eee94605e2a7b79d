"""Criteria of Sensors 2021, 21, 7479: disagreement of stations, and deviations from nominal points.

Stations disagree in the distances between targets and in the coordinates of targets (sections 2.3.4 and 3.2.1). Eq. 11
compares distances with the distances measured by station 1 (its missing absolute value is added here); section 3.2.1
and Table 3 compare distances with their mean over the stations. The fields `distance_to_first` and `distance` contain
these two comparisons.

The verification compares a calibrated tracker with nominal points from a coordinate measuring machine. Eq. 13 compares
the distance between two targets, measured from one station, with the distance of the nominal points. Eq. 14 compares
coordinates after a rigid fit of each station to the nominal points. Before calibration, points are computed from the
readings without correction.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, Self

import numpy as np

from ltsim.adjustment.evaluation.clouds import (
    align_to_first_station,
    align_to_points,
    measured_points,
    station_point_clouds,
)
from ltsim.core.arrays import MAX_MATRIX_ENTRIES, Bools, Floats, Ints
from ltsim.core.equality import ValueEquality
from ltsim.core.errors import NetworkError, RecordError
from ltsim.core.notation import MISSING_TEXT
from ltsim.core.results import Column, Table, number_columns, text_columns
from ltsim.core.units import MICROMETRE
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.coordinates import read_points
from ltsim.recordings.recording import Recording
from ltsim.recordings.reflectors import require_equal_radii
from ltsim.recordings.result_file import Entry, OptionalFloat, ResultFile, ResultSource


@dataclass(frozen=True)
class StationDisagreement(ValueEquality):
    """Disagreement of the stations in distances between targets (one value per pair of targets) or in coordinates."""

    disagreements: Floats
    """Disagreements [m]: one value per pair of targets for distances, one value per target for coordinates."""

    @property
    def mean(self) -> float:
        """Mean disagreement [m]."""
        return float(self.disagreements.mean())

    @property
    def maximum(self) -> float:
        """Largest disagreement [m]."""
        return float(self.disagreements.max())


CRITERIA_TABLE = Table(
    "criteria.csv",
    "disagreement of the stations, before and after a calibration",
    (
        Column("criterion", "distance (between targets) or coordinate (of targets)", "text"),
        Column("mean_um", "mean disagreement over the pairs of targets, or over the targets", display_format=".1f"),
        Column("max_um", "maximum disagreement over the pairs of targets, or over the targets", display_format=".1f"),
        Column("mean_after_um", "mean disagreement after correction of the readings", display_format=".1f"),
        Column("max_after_um", "maximum disagreement after correction of the readings", display_format=".1f"),
        Column(
            "improvement_percent",
            "decrease of the mean disagreement by the correction, in percent of its value before",
            display_format=".1f",
        ),
    ),
)


class DisagreementEntry(Entry):
    """Mean and maximum disagreement of the stations [um], in distances between targets or in coordinates of targets."""

    mean_um: OptionalFloat = None
    """Mean disagreement [um] over the pairs of targets (distances), or over the targets (coordinates)."""
    max_um: OptionalFloat = None
    """Largest disagreement [um] over the pairs of targets (distances), or over the targets (coordinates)."""

    @classmethod
    def from_differences(cls, differences: StationDisagreement) -> Self:
        """Entry with the mean and maximum of the disagreements `differences`."""
        return cls(mean_um=differences.mean / MICROMETRE, max_um=differences.maximum / MICROMETRE)


class DisagreementChange(Entry):
    """Disagreement of the stations in one quantity (distances between targets, or coordinates of targets)."""

    before: DisagreementEntry = DisagreementEntry()
    """Disagreement of the stations with uncorrected readings."""
    after: DisagreementEntry | None = None
    """Disagreement of the stations with readings that a calibration corrects; null without a calibration."""
    improvement_percent: OptionalFloat = None
    """Decrease of the mean disagreement of the stations by the calibration, in percent of the mean disagreement before
    it."""

    @classmethod
    def from_differences(cls, uncalibrated: StationDisagreement, calibrated: StationDisagreement | None = None) -> Self:
        """Change of the disagreement by a calibration; only the state before it if `calibrated` is None."""
        if calibrated is None:
            return cls(before=DisagreementEntry.from_differences(uncalibrated))
        percent = None if uncalibrated.mean == 0 else 100.0 * (1.0 - calibrated.mean / uncalibrated.mean)
        return cls(
            before=DisagreementEntry.from_differences(uncalibrated),
            after=DisagreementEntry.from_differences(calibrated),
            improvement_percent=percent,
        )

    @property
    def text(self) -> str:
        """Mean disagreement of the stations before and after calibration, as text in one line with the unit um."""
        if self.before.mean_um is None:
            return MISSING_TEXT
        before = f"{self.before.mean_um:.1f} um"
        if self.after is None or self.after.mean_um is None or self.improvement_percent is None:
            return before
        return f"{before}, {self.after.mean_um:.1f} um after calibration ({self.improvement_percent:.0f} % less)"


class CriteriaEntry(Entry):
    """Disagreement of the stations in distances and coordinates of targets, before and after calibration."""

    distance: DisagreementChange
    """Disagreement of the stations in distances between targets, as deviations from the mean over the stations."""
    coordinate: DisagreementChange
    """Disagreement of the stations in coordinates, after a rigid fit to one frame (Sensors 2021, 21, 7479, eq. 12)."""
    distance_to_first: DisagreementChange | None = None
    """Disagreement of the other stations with station 1 in distances between targets (Sensors 2021, 21, 7479, eq. 11);
    null in a verification."""

    def criteria_table(self) -> Table:
        """Data table of the disagreement of the stations before and after calibration.

        The rows are: distances between targets, distances compared with station 1, coordinates.
        """
        criterion_by_name = {
            "distance": self.distance,
            "distance, compared with station 1": self.distance_to_first,
        }
        table_rows = []
        for name, criterion in {**criterion_by_name, "coordinate": self.coordinate}.items():
            if criterion is not None and criterion.before.mean_um is not None:
                before, after = criterion.before, criterion.after or DisagreementEntry()
                sizes = before.mean_um, before.max_um, after.mean_um, after.max_um
                table_rows.append([name, *sizes, criterion.improvement_percent])
        return CRITERIA_TABLE.with_rows(table_rows)


class Criteria(ResultFile, CriteriaEntry):
    """Result of the commands `evaluate` and `verify`, with the content of `criteria.json`."""

    FILE: ClassVar[str] = "criteria.json"
    format: Literal["ltsim-criteria/1"] = "ltsim-criteria/1"
    """Format and version of this file."""

    @classmethod
    def from_criteria(cls, recording: Recording, criteria: CriteriaEntry) -> Self:
        """Result file for a recording, from the disagreements of its stations, `criteria`."""
        value_by_field = {name: getattr(criteria, name) for name in criteria.model_fields_set}
        return cls(**value_by_field, recording=ResultSource.from_recording(recording))

    def _summary_lines(self) -> list[str]:
        return [f"Criteria: distance {self.distance.text}; coordinate {self.coordinate.text}"]

    def _table_makers(self) -> Mapping[str, Callable[[], Table]]:
        return {"criteria": self.criteria_table}


def iterate_distances_by_target(clouds: Floats, min_observers: int = 1) -> Iterator[tuple[Ints, Floats]]:
    """Indices (s,) of the s stations that measured a target, and distances (s, f) [m] to f later targets, per target.

    `clouds` (S, T, 3) [m] are the points of T targets from S stations, NaN if not measured. Later targets are those
    with a larger index. Pairs of targets measured from fewer than `min_observers` stations are left out, so that the
    memory depends only on measured pairs.
    """
    is_measured = np.isfinite(clouds[:, :, 0])
    for point in range(clouds.shape[1]):
        observers = np.flatnonzero(is_measured[:, point])
        others = point + 1 + np.flatnonzero(is_measured[observers, point + 1 :].sum(axis=0) >= min_observers)
        yield observers, np.linalg.norm(clouds[observers[:, None], others] - clouds[observers, point, None], axis=2)


def distance_disagreement(clouds: Floats) -> StationDisagreement:
    """Disagreement in distances: mean absolute deviation of each distance of two targets from its mean over stations.

    `clouds` (S, T, 3) [m] are the points of T targets from S stations in instrument frames, NaN if not measured. Pairs
    of targets measured from only one station are left out.
    Source: Sensors 2021, 21, 7479, section 3.2.1.
    """
    lengths = (length for _, length in iterate_distances_by_target(clouds, 2))
    means = [np.nanmean(np.abs(length - np.nanmean(length, axis=0)), axis=0) for length in lengths if length.size]
    return StationDisagreement(np.concatenate([np.zeros(0), *means]))


def distance_disagreement_with_first_station(clouds: Floats) -> StationDisagreement:
    """Disagreement in distances: mean absolute difference of each distance of two targets from that of station 1.

    `clouds` (S, T, 3) [m] are the points of T targets from S stations in instrument frames, NaN if not measured.
    Source: Sensors 2021, 21, 7479, eq. 11.
    """
    lengths = (length for _, length in iterate_distances_by_target(clouds[:, np.isfinite(clouds[0, :, 0])], 2))
    means = [np.nanmean(np.abs(length[1:] - length[0]), axis=0) for length in lengths if length.size]
    return StationDisagreement(np.concatenate([np.zeros(0), *means]))


def coordinate_disagreement(aligned_clouds: Floats) -> StationDisagreement:
    """Disagreement in coordinates: distance of the points of a target from two stations, mean over station pairs.

    `aligned_clouds` (S, T, 3) [m] are the points of T targets from S stations in one frame, NaN if not measured.
    Source: Sensors 2021, 21, 7479, eq. 12.
    """
    total, count = np.zeros(aligned_clouds.shape[1]), np.zeros(aligned_clouds.shape[1])
    for targets, gap in iterate_distances_by_target(np.swapaxes(aligned_clouds, 0, 1)):
        total[targets] += np.nansum(gap, axis=1)
        count[targets] += np.isfinite(gap).sum(axis=1)
    is_shared = count >= 1
    return StationDisagreement(total[is_shared] / count[is_shared])


def evaluate_criteria(
    recording: Recording,
    construction: GeometricErrorModel | None = None,
    parameter_values: Floats | None = None,
    *,
    reading_changes: Floats | None = None,
    row_mask: Bools | None = None,
) -> CriteriaEntry:
    """Disagreement of the stations of a recording in distances and coordinates, before and after correction.

    The correction uses the p `parameter_values` [SI] of the error model `construction`, (p,) or for each of n pointings
    (n, p). Before this correction, `reading_changes` (n, 3) [m, rad, rad], the changes by estimated effects, are
    subtracted from the readings. `row_mask` (n,) selects pointings; faces and repeats are averaged by station and
    target. Raises NetworkError if no two stations have common targets, if the network is too large for a comparison of
    all stations, and if SMRs have several radii.
    """
    require_equal_radii(recording, "the comparison of stations")
    stations, targets = len(recording.stations), len(recording.targets)
    if 3 * stations * targets > MAX_MATRIX_ENTRIES:
        raise NetworkError(
            f"the network is too large for a comparison of all stations ({stations} stations, {targets} targets): "
            "evaluate parts of it separately"
        )
    raw_clouds = station_point_clouds(recording, measured_points(recording), row_mask)
    corrected_clouds = None
    if construction is not None and parameter_values is not None:
        corrected_clouds = station_point_clouds(
            recording,
            measured_points(_subtract_reading_changes(recording, reading_changes), construction, parameter_values),
            row_mask,
        )
    if len(recording.stations) < 2:
        raise NetworkError(
            "stations cannot be compared, because the recording has only one; measure from a second station"
        )

    def compare(criterion_function: Callable[[Floats], StationDisagreement], *, is_aligned: bool) -> DisagreementChange:
        def disagreement_of(clouds: Floats) -> StationDisagreement:
            return criterion_function(align_to_first_station(clouds, recording.stations) if is_aligned else clouds)

        raw_disagreement = disagreement_of(raw_clouds)
        if not len(raw_disagreement.disagreements):
            raise NetworkError(
                "no target, or no pair of targets, was measured from two stations; measure common targets"
            )
        return DisagreementChange.from_differences(
            raw_disagreement, None if corrected_clouds is None else disagreement_of(corrected_clouds)
        )

    return CriteriaEntry(
        distance=compare(distance_disagreement, is_aligned=False),
        coordinate=compare(coordinate_disagreement, is_aligned=True),
        **_distance_to_first_criterion(raw_clouds, corrected_clouds),
    )


def _subtract_reading_changes(recording: Recording, reading_changes: Floats | None) -> Recording:
    """Recording from whose readings `reading_changes` (n, 3) [m, rad, rad] of n pointings are subtracted."""
    return recording if reading_changes is None else recording.with_readings(recording.readings - reading_changes)


def _distance_to_first_criterion(uncalibrated: Floats, calibrated: Floats | None) -> dict[str, DisagreementChange]:
    """Entry `distance_to_first` of `CriteriaEntry` as a dictionary; empty if no distance of station 1 is comparable.

    `uncalibrated` and `calibrated` (S, T, 3) [m] are the points of T targets from S stations.
    """
    differences = distance_disagreement_with_first_station(uncalibrated)
    if not len(differences.disagreements):
        return {}
    corrected = None if calibrated is None else distance_disagreement_with_first_station(calibrated)
    return {"distance_to_first": DisagreementChange.from_differences(differences, corrected)}


NOMINAL_TABLE = Table(
    "nominal.csv",
    "nominal points from a coordinate measuring machine, for `verify_against_nominal`",
    (*text_columns(target="name"), *number_columns(".4f", x_mm="coordinate", y_mm="coordinate", z_mm="coordinate")),
)


def read_nominal(path: Path) -> dict[str, Floats]:
    """Nominal coordinates (3,) [m] by target, from a CSV file with columns such as ``target,x_mm,y_mm,z_mm``."""
    points = read_points(path)
    for line, place in zip(points.line_numbers, points.points, strict=True):
        if not np.isfinite(place).all():
            raise RecordError("a coordinate is missing, expected a number in mm", file=path, row=line)
    return points.coordinates_by_name


def distance_errors(clouds: Floats, nominal_points: Floats) -> StationDisagreement:
    """Mean absolute difference, over the stations, of each distance between two targets from its nominal value.

    `clouds` (S, T, 3) [m] are the points of T targets from S stations, NaN if not measured, `nominal_points` (T, 3) [m]
    the points from a coordinate measuring machine.
    Source: Sensors 2021, 21, 7479, eq. 13.
    """
    return distance_disagreement_with_first_station(np.concatenate([nominal_points[None], clouds]))


def coordinate_errors(clouds: Floats, nominal_points: Floats) -> StationDisagreement:
    """Mean distance, over the stations, of each target from its nominal point after a rigid fit of each station.

    `clouds` (S, T, 3) [m] are the points of T targets from S stations, NaN if not measured, `nominal_points` (T, 3) [m]
    the points from a coordinate measuring machine.
    Source: Sensors 2021, 21, 7479, eq. 14.
    """
    gap = np.linalg.norm([align_to_points(cloud, nominal_points) - nominal_points for cloud in clouds], axis=2)
    return StationDisagreement(np.nanmean(gap[:, np.isfinite(gap).any(axis=0)], axis=0))


def verify_against_nominal(
    recording: Recording,
    nominal_points: dict[str, Floats],
    construction: GeometricErrorModel | None = None,
    parameter_values: Floats | None = None,
    *,
    reading_changes: Floats | None = None,
) -> CriteriaEntry:
    """Errors of distances and coordinates relative to nominal points, before and after a calibration.

    `nominal_points` maps target names to coordinates (3,) [m]. The correction uses the p `parameter_values` [SI] of the
    error model `construction`, (p,) or for each of n pointings (n, p). Before this correction, the changes by estimated
    effects, `reading_changes` (n, 3) [m, rad, rad], are subtracted from the readings. Raises NetworkError if a station
    measured fewer than three targets with nominal points.
    """
    nan_vector = np.full(3, np.nan)
    goal = np.stack([nominal_points.get(name, nan_vector) for name in recording.targets])
    has_nominal = np.isfinite(goal[:, 0])
    if int(has_nominal.sum()) < 3:
        raise NetworkError(
            f"only {int(has_nominal.sum())} targets of the recording have nominal points; at least three are needed"
        )

    def disagreements_of_points(points: Floats) -> tuple[StationDisagreement, StationDisagreement]:
        clouds = station_point_clouds(recording, points)[:, has_nominal]
        try:
            return distance_errors(clouds, goal[has_nominal]), coordinate_errors(clouds, goal[has_nominal])
        except NetworkError as problem:
            raise NetworkError(f"a station cannot be fitted to the nominal points: {problem}") from None

    distance, coordinate = disagreements_of_points(measured_points(recording))
    if construction is None or parameter_values is None:
        return CriteriaEntry(
            distance=DisagreementChange.from_differences(distance),
            coordinate=DisagreementChange.from_differences(coordinate),
        )
    after = disagreements_of_points(
        measured_points(_subtract_reading_changes(recording, reading_changes), construction, parameter_values)
    )
    return CriteriaEntry(
        distance=DisagreementChange.from_differences(distance, after[0]),
        coordinate=DisagreementChange.from_differences(coordinate, after[1]),
    )
