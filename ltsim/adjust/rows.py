"""Rows of the adjustment that are not pointings: gauge lengths, priors, control points, levels, datum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.geometry.rotations import cross_matrix
from ltsim.recording.recording import Recording
from ltsim.units import ARCSECOND, MILLIMETRE

VERTICAL = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class GaugeRows:
    """Known lengths brought to the workshop: L (1 + expansion dT) (eq. 15 with its missing length)."""

    first: Ints
    second: Ints
    length: Floats
    sigma: Floats

    @classmethod
    def of(cls, recording: Recording) -> GaugeRows:
        """The gauge of a recording."""
        gauge = recording.gauge
        index = {name: i for i, name in enumerate(recording.targets)}
        grown = 1.0 + gauge.expansion_per_k * (gauge.measured_at_c - gauge.calibrated_at_c)
        rows = [d for d in gauge.distance if d.from_ in index and d.to in index]
        return cls(
            np.array([index[d.from_] for d in rows], dtype=np.int64),
            np.array([index[d.to] for d in rows], dtype=np.int64),
            np.array([d.length_mm * MILLIMETRE * grown for d in rows]),
            np.array([d.sigma_mm * MILLIMETRE for d in rows]),
        )

    def __len__(self) -> int:
        return len(self.length)

    def predict(self, points: Floats) -> Floats:
        """Lengths (g,) [m] between the targets at `points` (T, 3)."""
        lengths: Floats = np.linalg.norm(points[self.first] - points[self.second], axis=1)
        return lengths

    def directions(self, points: Floats) -> Floats:
        """Unit vectors (g, 3) from the second to the first target: derivative of the length."""
        gap = points[self.first] - points[self.second]
        unit: Floats = gap / np.linalg.norm(gap, axis=1, keepdims=True)
        return unit


@dataclass(frozen=True)
class ControlRows:
    """Targets with known coordinates."""

    target: Ints
    points: Floats
    sigma: Floats

    @classmethod
    def of(cls, recording: Recording) -> ControlRows:
        """The control points of a recording."""
        known = [(i, recording.target_setup(name)) for i, name in enumerate(recording.targets)]
        rows = [(i, t) for i, t in known if t.known_mm is not None]
        return cls(
            np.array([i for i, _ in rows], dtype=np.int64),
            np.array([t.known_mm for _, t in rows], dtype=np.float64).reshape(-1, 3) * MILLIMETRE,
            np.array([t.known_sigma_mm for _, t in rows], dtype=np.float64) * MILLIMETRE,
        )

    def __len__(self) -> int:
        return len(self.target)


@dataclass(frozen=True)
class LevelRows:
    """Stations whose vertical axis follows a level: two tilts each."""

    station: Ints
    sigma: Floats

    @classmethod
    def of(cls, recording: Recording) -> LevelRows:
        """The levelled stations of a recording."""
        setups = [(i, recording.station_setup(name)) for i, name in enumerate(recording.stations)]
        rows = [(i, s) for i, s in setups if s.levelled]
        return cls(
            np.array([i for i, _ in rows], dtype=np.int64),
            np.array([s.levelling_sigma_arcsec for _, s in rows], dtype=np.float64) * ARCSECOND,
        )

    def __len__(self) -> int:
        return len(self.station)

    def predict(self, rotation: Floats) -> Floats:
        """Horizontal components (l, 2) of the stations' vertical axes."""
        axis: Floats = rotation[self.station] @ VERTICAL
        return axis[:, :2]

    def derivative(self, rotation: Floats) -> Floats:
        """Derivative (l, 2, 3) of these by the rotation vector in the network frame."""
        turned: Floats = -cross_matrix(rotation[self.station] @ VERTICAL)
        return turned[:, :2]


def free_motions(points: Floats, control: ControlRows, levels: LevelRows) -> Floats:
    """Rigid motions (6, f) that no control point and no level fixes, as columns of (translation, rotation).

    Their number is decided by structure: none with three control points off one line, the four that keep the
    vertical with levels alone, all six without either.
    """
    basis = np.eye(6)
    rows = [np.zeros((0, 6))]
    if len(levels):
        rows.append(np.hstack([np.zeros((2, 3)), np.eye(2, 3)]))
    if len(control):
        centre = points[control.target].mean(axis=0)
        arms = points[control.target] - centre
        reach = max(float(np.abs(arms).max()), 1e-9) if len(control) > 1 else 1.0
        turned = -cross_matrix(arms / reach)
        rows.append(np.concatenate([np.tile(np.eye(3), (len(arms), 1, 1)), turned], axis=2).reshape(-1, 6))
    stack = np.vstack(rows)
    if not len(stack):
        return basis
    _, singular, right = np.linalg.svd(stack)
    rank = int(np.sum(singular > 1e-6 * singular.max(initial=0.0)))
    free = right[rank:].T
    if len(control) and free.shape[1]:
        centre = points[control.target].mean(axis=0)
        free[:3] -= np.cross(free[3:].T, centre).T
    return free
