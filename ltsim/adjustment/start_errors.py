"""Errors for networks in which a station, or all targets, got no approximate coordinates."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ltsim.adjustment.frame import are_collinear
from ltsim.adjustment.marks import StationMarks
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.core.notation import names_text
from ltsim.geometry.rigid import MIN_POINTS_FOR_POSE
from ltsim.recordings.recording import Recording

POSE_ADVICE = (
    "its pose needs at least three common targets (two between levelled stations, more if ranges or angles are "
    "missing), or approximate coordinates of all stations and targets; for a station over a target, set over = "
    '"TARGET" in the set-up'
)
"""Conditions under which a station can be joined to a network."""


def require_connected_stations(
    recording: Recording, marks: StationMarks, is_joined: Bools, points: Floats, undetermined_lines: str
) -> None:
    """Check that all stations have approximate coordinates; raises NetworkError with the undetermined stations.

    The error names separate parts of the network, or the direction that is undetermined at the best connected station.

    Parameters
    ----------
    recording : Recording
    marks : StationMarks
    is_joined : (S,) bool
        True for those of the S stations that have coordinates.
    points : (T, 3) float, [m]
        Positions of the T targets; NaN for targets without coordinates.
    undetermined_lines : str
        Text on lines whose length no reading determines, for the end of the message; may be empty.
    """
    if is_joined.all():
        return
    is_located = np.asarray(np.isfinite(points).all(axis=1))
    parts = _part_numbers(recording, marks)
    station_parts, target_parts = parts[: len(is_joined)], parts[len(is_joined) :]
    reached_parts = {*station_parts[is_joined].tolist(), *target_parts[is_located].tolist()}
    detached_parts = [part for part in dict.fromkeys(station_parts.tolist()) if part not in reached_parts]
    if not is_joined.any():
        raise NetworkError(
            f"no station can be located: no readings determine the start coordinates; {POSE_ADVICE}{undetermined_lines}"
        )
    if detached_parts:
        raise NetworkError(_separate_parts_sentence(recording, station_parts, reached_parts, detached_parts))
    lost_stations = np.flatnonzero(~is_joined).tolist()
    has_mark_position = [
        bool(np.isfinite(_mark_position(marks, station, is_joined, points)).all()) for station in lost_stations
    ]
    shared_targets = [_located_targets(recording, station, is_located) for station in lost_stations]
    best = max(range(len(lost_stations)), key=lambda i: (len(shared_targets[i]), has_mark_position[i]))
    station, targets = recording.stations[lost_stations[best]], shared_targets[best]
    others = names_text([recording.stations[s] for s in lost_stations if s != lost_stations[best]])
    also = f"; for the same reason or as a consequence, {others} cannot be located" if others else ""
    if has_mark_position[best] and not len(targets):
        raise NetworkError(
            f"station {station} stands over a point with coordinates, but measured no other point with coordinates: "
            "the direction of its horizontal circle is undetermined, and with it the targets that only this station "
            f"measured{also}; measure a backsight, or declare yaw_deg and yaw_sigma_arcsec of the station"
            f"{undetermined_lines}"
        )
    what = _undetermined_pose_text(recording, lost_stations[best], targets, points)
    raise NetworkError(f"station {station} {what}{also}; {POSE_ADVICE}{undetermined_lines}")


def _part_numbers(recording: Recording, marks: StationMarks) -> Ints:
    """Number of the connected part of the network of S stations and then T targets, (S + T,).

    Pointings connect stations and targets, and marks connect stations with targets and with other set-ups.
    """
    n_stations = len(recording.stations)
    is_over_target = np.flatnonzero(marks.target_indices >= 0)
    is_used = recording.is_measured.any(axis=1)
    starts = np.concatenate([recording.station[is_used], is_over_target, np.arange(n_stations)])
    ends = np.concatenate(
        [
            n_stations + recording.target[is_used],
            n_stations + marks.target_indices[is_over_target],
            marks.first_setup_on_mark,
        ]
    )
    size = n_stations + len(recording.targets)
    return np.asarray(connected_components(coo_array((np.ones(len(starts)), (starts, ends)), (size, size)), False)[1])


def _separate_parts_sentence(
    recording: Recording, station_parts: Ints, reached_parts: set[int], detached_parts: list[int]
) -> str:
    """Sentence on the parts of a network that have no point in common with the parts with coordinates.

    `station_parts` (S,) are the numbers of the parts of S stations.
    """

    def stations_text(numbers: set[int]) -> str:
        return names_text([recording.stations[s] for s in np.flatnonzero(np.isin(station_parts, [*numbers])).tolist()])

    detached_text = " and ".join(f"stations {stations_text({part})}" for part in detached_parts)
    n_parts = 1 + len(detached_parts)
    return (
        f"the network has {n_parts} separate parts: {detached_text} measured no point that stations "
        f"{stations_text(reached_parts)} measured or stand over, therefore the positions and directions of the parts "
        "relative to each other are undetermined; measure common targets, or give reference coordinates in each part "
        "(three, or two between levelled stations), check that a point has the same name in all parts, or adjust each "
        "part as a separate recording"
    )


def _mark_position(marks: StationMarks, station: int, is_joined: Bools, points: Floats) -> Floats:
    """Coordinates (3,) of the mark under a station that has no coordinates; NaN without mark or coordinates.

    A mark that is no target has the coordinates 0 here if another set-up over it has coordinates, `is_joined` (S,).
    """
    joined_positions = np.where(is_joined[:, None], 0.0, np.full((len(is_joined), 3), np.nan))
    return marks.position_from_mark(station, joined_positions, points)


def _located_targets(recording: Recording, station: int, is_located: Bools) -> Ints:
    """Indices (k,) of the k targets with coordinates that a station measured; `is_located` (T,) flags all of them."""
    targets = np.unique(recording.target[(recording.station == station) & recording.is_measured.any(axis=1)])
    return targets[is_located[targets]]


def _undetermined_pose_text(recording: Recording, station: int, targets: Ints, points: Floats) -> str:
    """Phrase on the rotation of a station that k common targets (k,) do not determine; `points` (T, 3) [m]."""
    names = names_text([recording.targets[target] for target in targets.tolist()])
    is_levelled = recording.station_setup(recording.stations[station]).levelled
    n_targets = len(targets)
    if not n_targets:
        return "measured no point with coordinates: its position and direction are undetermined"
    common = f"{n_targets} target{'s' * (n_targets != 1)} with the network ({names})"
    if n_targets >= MIN_POINTS_FOR_POSE and are_collinear(points[targets]):
        return f"shares {common}, which lie on one line: its rotation about this line is undetermined"
    if n_targets == 1:
        axis = f"about the vertical through {names}" if is_levelled else f"about {names}"
        return f"shares only {common}: its rotation {axis} is undetermined"
    if n_targets < MIN_POINTS_FOR_POSE and not is_levelled:
        return f"shares only {common}: its rotation about the line through them is undetermined"
    return f"shares {common}, but its readings of them do not determine its pose"


def require_located_target(recording: Recording, has_coordinates: Bools) -> None:
    """Check that at least one of T targets has approximate coordinates; raises NetworkError.

    `has_coordinates` (T,) flags the targets with coordinates.
    """
    if not has_coordinates.any():
        raise NetworkError(
            f"target {', '.join(recording.targets[:10])}: no station measured range and both angles, and "
            "the lines of sight from different stations do not meet in one point; measure range and both angles"
        )
