"""Contributions of candidate set-ups (a station at a position with a yaw) to the normal equations of layouts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints


@dataclass(frozen=True)
class NormalBlocks:
    """Contributions of N set-ups (a station at a position with a yaw) to the normal equations of layouts.

    The shapes refer to T targets and to P parameters of reflectors, instrument and effects.
    """

    setup_positions: Floats
    """Positions of the N set-ups, (N, 3) [m]."""
    setup_yaws: Floats
    """Yaw (direction of azimuth zero, counter-clockwise from x) of each of the N set-ups, (N,) [rad]."""
    is_visible: Bools
    """Flags (N, T): True where one of N set-ups measures one of T targets."""
    has_determined_pose: Bools
    """Flags (N,): True for a set-up whose measured targets determine the pose of the station."""
    target_blocks: Floats
    """Contribution of each of N set-ups to the 3 x 3 block of the normal matrix of each of T targets, (N, T, 3, 3)."""
    coupling_blocks: Floats
    """Contribution of each of N set-ups to the block of the normal matrix that couples each of T targets with the pose
    of the set-up followed by P parameters, (N, T, 3, 6 + P)."""
    pose_blocks: Floats
    """Contribution of each of N set-ups to the block of the normal matrix of its pose followed by P parameters, (N, 6 +
    P, 6 + P)."""

    def select(self, indices: Ints) -> NormalBlocks:
        """Contributions to the normal equations of the set-ups with the given indices, in the order of the indices."""
        return NormalBlocks(*(getattr(self, field.name)[indices] for field in fields(self)))

    @classmethod
    def concatenate(cls, groups: Sequence[NormalBlocks]) -> NormalBlocks:
        """Contributions, to the normal equations, of several groups of set-ups, one group after the other."""
        return cls(*(np.concatenate([getattr(part, field.name) for part in groups]) for field in fields(cls)))

    def with_replaced_station(self, station_index: int, replacement: NormalBlocks) -> NormalBlocks:
        """Contributions of a layout to the normal equations, with the set-up `replacement` in place of a station."""
        stations = np.arange(len(self.setup_positions))
        return self.concatenate([self, replacement]).select(
            np.where(stations == station_index, len(stations), stations)
        )
