"""Marks (points on the floor) under the set-ups of a recording, and positions of set-ups derived from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.core.units import MILLIMETRE
from ltsim.physics.model.measurement import plumb_directions
from ltsim.recordings.recording import Recording


@dataclass(frozen=True)
class StationMarks:
    """Marks under the S set-ups of a recording."""

    target_indices: Ints
    """Index (S,) of the target that is the mark under each of S set-ups; -1 for a set-up without a mark, or over a mark
    that is no target."""
    first_setup_on_mark: Ints
    """Index (S,) of the first set-up over the mark of each of S set-ups; index of the set-up itself if its mark is a
    target or if it is not over a mark."""
    mark_names: tuple[str, ...]
    """Name of the mark under each set-up, '' for a set-up without a mark."""
    plumb_directions: Floats
    """Upward unit vectors (S, 3) of the plumb lines at S set-ups."""
    instrument_offsets: Floats
    """Vectors (S, 3) [m] in the network frame from mark to instrument at S set-ups; zero without a mark."""

    @classmethod
    def from_recording(cls, recording: Recording) -> StationMarks:
        """Marks under the set-ups of a recording; raises NetworkError if a set-up measures its mark at equal height."""
        places = {name: i for i, name in enumerate(recording.targets)}
        setups = [recording.station_setup(name) for name in recording.stations]
        names = tuple(s.over or "" for s in setups)
        target = np.array([places.get(name, -1) if name else -1 for name in names], dtype=np.int64)
        _require_height_above_sighted_marks(recording, target)
        first_on_mark: dict[str, int] = {}
        first = [first_on_mark.setdefault(name, i) if name and target[i] < 0 else i for i, name in enumerate(names)]
        vertical = plumb_directions(recording)
        height = np.array([s.instrument_height_mm if s.over else 0.0 for s in setups]) * MILLIMETRE
        return cls(target, np.array(first, dtype=np.int64), names, vertical, vertical * height[:, None])

    def position_from_mark(self, station: int, position: Floats, points: Floats) -> Floats:
        """Position (3,) [m] of a set-up, derived from the coordinates of its mark; NaN if the mark has no coordinates.

        The mark is one of T targets, with coordinates `points` (T, 3) [m], or its coordinates are computed from another
        of S set-ups over the same mark, with positions `position` (S, 3) [m]. Undetermined targets and set-ups are NaN.
        """
        if self.target_indices[station] >= 0:
            return np.asarray(points[self.target_indices[station]] + self.instrument_offsets[station])
        mark, offsets = self.mark_names[station], self.instrument_offsets
        other_setups = [k for k, name in enumerate(self.mark_names) if name and name == mark and k != station]
        positions = (position[k] - offsets[k] + offsets[station] for k in other_setups if np.isfinite(position[k, 0]))
        return next(positions, np.full(3, np.nan))

    def positions_on_marks(self, position: Floats, points: Floats) -> Floats:
        """Positions (S, 3) [m] of S set-ups, made consistent with their marks.

        A set-up over a target gets its position from the target coordinates `points` (T, 3) [m]. A set-up over another
        mark gets it from the position of the first set-up over this mark, in `position` (S, 3) [m]. Other set-ups keep
        `position`.
        """
        mark_positions = (
            position[self.first_setup_on_mark]
            - self.instrument_offsets[self.first_setup_on_mark]
            + self.instrument_offsets
        )
        marked_indices = np.flatnonzero(self.target_indices >= 0)
        mark_positions[marked_indices] = (
            points[self.target_indices[marked_indices]] + self.instrument_offsets[marked_indices]
        )
        return mark_positions


def _require_height_above_sighted_marks(recording: Recording, mark_targets: Ints) -> None:
    """Check that no set-up measures the mark under it at its own height; raises NetworkError.

    `mark_targets` (S,) are the indices of the targets that are marks under the S set-ups, -1 for set-ups over no
    target.
    """
    is_at_mark = (recording.target == mark_targets[recording.station]) & recording.is_measured.any(axis=1)
    for row in np.flatnonzero(is_at_mark).tolist():
        station, target = recording.stations[recording.station[row]], recording.targets[recording.target[row]]
        height = recording.station_setup(station).instrument_height_mm
        if height == recording.target_setup(target).height_mm:
            raise NetworkError(
                f"row {row + 1}: station {station} stands over target {target} and measures it, but both have the same "
                "height; declare the instrument height of the station or remove the row"
            )
