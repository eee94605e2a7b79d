"""Rows of the adjustment other than readings: lengths, known points and differences, levels, yaws, datum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.units import ARCSECOND, DEGREE, MILLIMETRE
from ltsim.geometry.polar import wrap
from ltsim.geometry.rigid import COLLINEAR_RATIO, rigid_motion
from ltsim.geometry.rotations import cross_matrix, perpendicular
from ltsim.physics.model.measurement import plumb_directions
from ltsim.recordings.recording import Recording
from ltsim.recordings.references import ReferenceLengths, places_of
from ltsim.recordings.setup import ReferenceDifference, Target, symmetric

VERTICAL = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class GaugeRows(ReferenceLengths):
    """Reference lengths at the workshop's temperature, some of them without weight."""

    idle: Bools | bool = False
    """Flags (g,) of the lengths without weight."""

    @cached_property
    def sigma(self) -> Floats:
        """Standard deviation of each length, infinite for one without weight, (g,) [m]."""
        return np.where(self.idle, np.inf, super().sigma)

    @cached_property
    def root(self) -> Floats | None:
        """Lower triangular root (g, g) of the correlation of the lengths; None for uncorrelated ones."""
        if not self.shared:
            return None
        together = np.array([*self.shared.values()]) / self.sigma
        correlation = together.T @ together
        np.fill_diagonal(correlation, 1.0)
        return np.asarray(np.linalg.cholesky(correlation), dtype=np.float64)

    @property
    def spread(self) -> Floats:
        """Change of the lengths by independent unit errors, the inverse of `whitened`, (g, g) [m]."""
        return np.diag(self.sigma) if self.root is None else self.sigma[:, None] * self.root

    def whitened(self, values: Floats) -> Floats:
        """Values (g,) or (g, q) [m] transformed to independent unit errors."""
        single = values / (self.sigma if values.ndim == 1 else self.sigma[:, None])
        return self.uncorrelated(single)

    def uncorrelated(self, single: Floats) -> Floats:
        """Values (g, ...), in the standard deviation of each length, transformed to independent ones."""
        return single if self.root is None else scipy.linalg.solve_triangular(self.root, single, lower=True)

    def __len__(self) -> int:
        return len(self.length)

    def predict(self, points: Floats) -> Floats:
        """Lengths (g,) [m] between the targets at `points` (T, 3)."""
        return np.linalg.norm(points[self.first] - points[self.second], axis=1)

    def directions(self, points: Floats) -> Floats:
        """Derivative (g, 3) of the lengths: unit vectors from the second to the first target, zero if coincident."""
        gap = points[self.first] - points[self.second]
        length = np.linalg.norm(gap, axis=1, keepdims=True)
        return gap / np.where(length > 0.0, length, 1.0)


@dataclass(frozen=True)
class ControlRows:
    """Rows of places with known coordinates: targets, or stations over marks that are no targets."""

    target: Ints
    """Index of the target, or of the station, (k,)."""
    points: Floats
    """Known coordinates, (k, 3) [m]."""
    axes: Bools
    """Flags of the known coordinates, (k, 3)."""
    root: Floats
    """Matrix R that whitens the misclosure, with R' R the inverse covariance; 0 for unknown coordinates, (k, 3, 3) [1 /
    m].
    """

    @classmethod
    def of(cls, recording: Recording) -> ControlRows:
        """The control points of a recording."""
        return cls._of_places(recording, list(enumerate(recording.targets)))

    @classmethod
    def of_stations(cls, recording: Recording, marks: Marks) -> ControlRows:
        """Rows of known marks under stations that are no targets; `points` are the positions of the instruments."""
        places = [(i, n) for i, n in enumerate(marks.names) if n and marks.target[i] < 0 and marks.first[i] == i]
        rows = cls._of_places(recording, places)
        return replace(rows, points=rows.points + marks.offset[rows.target])

    @classmethod
    def _of_places(cls, recording: Recording, places: list[tuple[int, str]]) -> ControlRows:
        setups = [(i, recording.target_setup(name)) for i, name in places]
        rows = [(i, t) for i, t in setups if t.known_mm is not None]
        return cls(np.array([i for i, _ in rows], dtype=np.int64), *_declared([t for _, t in rows]))

    def __len__(self) -> int:
        return len(self.target)

    @property
    def count(self) -> int:
        """Number of known coordinates."""
        return int(self.axes.sum())

    def no_finer(self, floor: float) -> ControlRows:
        """The same rows with smaller standard deviations raised to `floor` [m]."""
        roots = self.root.copy()
        for i, axes in enumerate(self.axes):
            at = np.ix_(axes, axes)
            inverse = np.linalg.inv(roots[i][at])
            covariance = inverse @ inverse.T
            if np.diag(covariance).min() < floor**2:
                roots[i][at] = np.linalg.inv(np.linalg.cholesky(covariance + floor**2 * np.eye(len(covariance))))
        return self if np.array_equal(roots, self.root) else replace(self, root=roots)

    def residual(self, here: Floats) -> Floats:
        """Whitened residuals (count,) for places `here` (k, 3)."""
        gap = np.where(self.axes, self.points - here, 0.0)
        return np.einsum("kij,kj->ki", self.root, gap)[self.axes]

    def weights(self) -> Floats:
        """Derivative (count, 3) of the whitened coordinates by their place, with the sign of a prediction."""
        return self.root[self.axes]


def _declared(declared: Sequence[Target | ReferenceDifference]) -> tuple[Floats, Bools, Floats]:
    """Known coordinates (k, 3) [m], flags of known ones, and roots of inverse covariances (k, 3, 3) [1 / m]."""
    axes = np.array([[axis in entry.known_axes for axis in "xyz"] for entry in declared], dtype=bool).reshape(-1, 3)
    roots = np.array([_root(entry, given_axes) for entry, given_axes in zip(declared, axes, strict=True)]).reshape(
        -1, 3, 3
    )
    return np.array([entry.known_mm for entry in declared], dtype=np.float64).reshape(-1, 3) * MILLIMETRE, axes, roots


def _root(target: Target | ReferenceDifference, axes: Bools) -> Floats:
    """Root (3, 3) [1 / m] of the inverse covariance of known coordinates."""
    if target.known_covariance_mm2 is None:
        return np.diag(axes / (target.known_sigma_mm * MILLIMETRE))
    at, root = np.ix_(axes, axes), np.zeros((3, 3))
    covariance = symmetric(target.known_covariance_mm2)[at] * MILLIMETRE**2
    root[at] = np.linalg.inv(np.linalg.cholesky(covariance))
    return root


@dataclass(frozen=True)
class DifferenceRows(ControlRows):
    """Rows of known differences of marks: `points` are the coordinates of the places `target` minus those of `start`.

    Places are T targets, then S instruments, then the origin, which represents unmeasured marks: their known
    coordinates, and the heights of the instruments, are included in `points`.
    """

    start: Ints
    """Place at the start of each difference, (k,)."""
    last: int
    """Number of the origin among the places."""
    names: tuple[str, ...]

    @classmethod
    def between(cls, recording: Recording, marks: Marks) -> DifferenceRows:
        """Rows of the differences of a recording whose ends are measured or known."""
        places, count = places_of(recording), len(recording.targets)
        last, differences = count + len(recording.stations), recording.setup.differences
        differences = tuple(
            difference for difference in differences if {difference.from_, difference.to} <= places.keys()
        )
        points, axes, roots = _declared(differences)
        ends = np.array(
            [[places[difference.from_], places[difference.to]] for difference in differences], dtype=np.int64
        ).reshape(-1, 2)
        for k, difference in enumerate(differences):
            for sign, name, place in zip((-1.0, 1.0), (difference.from_, difference.to), ends[k], strict=True):
                if place == last:
                    points[k] -= sign * np.array(recording.target_setup(name).known_mm) * MILLIMETRE
                elif place >= count:
                    points[k] += sign * marks.offset[place - count]
        return cls(
            ends[:, 1], points, axes, roots, ends[:, 0], last, tuple(difference.called for difference in differences)
        )

    @property
    def ends(self) -> Ints:
        """Places at both ends, (2, k)."""
        return np.stack([self.start, self.target])

    def subset(self, chosen: Bools) -> DifferenceRows:
        """Rows of the differences `chosen` (k,)."""
        return DifferenceRows(
            self.target[chosen],
            self.points[chosen],
            self.axes[chosen],
            self.root[chosen],
            self.start[chosen],
            self.last,
            tuple(name for name, is_chosen in zip(self.names, chosen, strict=True) if is_chosen),
        )

    def predict(self, points: Floats, position: Floats) -> Floats:
        """Differences (k, 3) [m] for targets at `points` (T, 3) and instruments at `position` (S, 3)."""
        places = np.concatenate([points, position, np.zeros((1, 3))])
        return places[self.target] - places[self.start]

    def derivatives(self) -> Floats:
        """Derivative (count, 6) of the whitened differences by the places of both ends, 0 for the origin."""
        signs = np.where(self.ends == self.last, 0.0, [[-1.0], [1.0]])[:, :, None, None]
        return np.concatenate([*(signs * self.root)], axis=2)[self.axes]

    def height_free(self, open_: Bools) -> Bools:
        """Flags (T + S + 1,) of undetermined heights that no difference connects to a determined one."""
        open_, ends = open_.copy(), self.ends[:, self.axes[:, 2]]
        while (half := open_[ends[0]] != open_[ends[1]]).any():
            open_[ends[:, half]] = False
        return open_

    def motion(self, centre: Floats, reach: float) -> Floats:
        """Derivatives (count, 6) of the known coordinates by translation and rotation, in units of `free_motions`.

        A difference to the origin is a known place; a difference of two unknown places depends on the rotation alone.
        """
        tied, size = (self.ends == self.last).any(axis=0), np.linalg.norm(self.points, axis=1, keepdims=True)
        place = np.where(self.start == self.last, 1.0, -1.0)[:, None] * self.points
        arm = self.points / np.where(size > 0.0, size, 1.0)
        moved = rigid_motion(np.where(tied[:, None], (place - centre) / reach, arm)).reshape(-1, 3, 6)
        moved[~tied, :, :3] = 0.0
        return moved[self.axes]


@dataclass(frozen=True)
class LevelRows:
    """Rows of levelled stations: two tilts each relative to the plumb line."""

    station: Ints
    sigma: Floats
    vertical: Floats
    across: Floats

    @classmethod
    def of(cls, recording: Recording, used: Bools) -> LevelRows:
        """Rows of the levelled stations of a recording with angles in `used` (n, 3)."""
        angles = np.bincount(recording.station, used[:, 1:].any(axis=1), len(recording.stations)) > 0
        setups = [(i, recording.station_setup(name)) for i, name in enumerate(recording.stations)]
        rows = [(i, s) for i, s in setups if s.levelled and angles[i]]
        station = np.array([i for i, _ in rows], dtype=np.int64)
        vertical = plumb_directions(recording)[station]
        sideways, back = perpendicular(vertical)
        sigma = np.array([s.levelling_sigma_arcsec for _, s in rows], dtype=np.float64) * ARCSECOND
        return cls(station, sigma, vertical, np.stack([-back, sideways], axis=1))

    def __len__(self) -> int:
        return len(self.station)

    def no_finer(self, turn: float) -> LevelRows:
        """The same rows with smaller standard deviations raised to `turn` [rad]."""
        return self if np.all(self.sigma >= turn) else replace(self, sigma=np.maximum(self.sigma, turn))

    def predict(self, rotation: Floats) -> Floats:
        """Horizontal components (l, 2) of the stations' standing axes relative to the plumb line."""
        axis = rotation[self.station] @ VERTICAL
        return np.einsum("lij,lj->li", self.across, axis)

    def derivative(self, rotation: Floats) -> Floats:
        """Derivative (l, 2, 3) of these components with respect to the rotation vector in the network frame."""
        return -self.across @ cross_matrix(rotation[self.station] @ VERTICAL)


@dataclass(frozen=True)
class YawRows:
    """Rows of levelled stations with known azimuth zero, such as by a gyroscope: one rotation each about the z axis."""

    station: Ints
    sigma: Floats
    yaw: Floats
    """Known direction of azimuth zero, counter-clockwise from x, (y,) [rad]."""

    @classmethod
    def of(cls, recording: Recording, used: Bools) -> YawRows:
        """Rows of the oriented stations of a recording with azimuths in `used` (n, 3)."""
        turned = np.bincount(recording.station, used[:, 1], len(recording.stations)) > 0
        setups = [(i, recording.station_setup(name)) for i, name in enumerate(recording.stations)]
        rows = [(i, s.yaw_sigma_arcsec, s.yaw_deg) for i, s in setups if s.yaw_sigma_arcsec and turned[i]]
        station, sigma, yaw = (np.array([row[k] for row in rows], dtype=np.float64) for k in range(3))
        return cls(station.astype(np.int64), sigma * ARCSECOND, yaw * DEGREE)

    def __len__(self) -> int:
        return len(self.station)

    def no_finer(self, turn: float) -> YawRows:
        """The same rows with smaller standard deviations raised to `turn` [rad]."""
        return self if np.all(self.sigma >= turn) else replace(self, sigma=np.maximum(self.sigma, turn))

    def residual(self, rotation: Floats) -> Floats:
        """Declared minus adjusted yaws (y,) [rad]."""
        ahead = rotation[self.station, :, 0]
        return wrap(self.yaw - np.arctan2(ahead[:, 1], ahead[:, 0]))

    def derivative(self, rotation: Floats) -> Floats:
        """Derivative (y, 3) of the adjusted yaws with respect to the rotation vector in the network frame."""
        ahead = rotation[self.station, :, 0]
        flat = ahead * [1.0, 1.0, 0.0]
        return np.cross(ahead, np.cross(VERTICAL, flat) / np.sum(flat**2, axis=1, keepdims=True))


PARALLEL = 1e-2
"""Angle between plumb lines [rad] up to which they do not determine the yaw of the network (64 km on the earth)."""


def free_motions(
    control: ControlRows, marks: ControlRows, differences: DifferenceRows, levels: LevelRows, yaws: YawRows
) -> Floats:
    """Rigid motions (6, f) that no known point, difference, level or yaw fixes, as columns of (translation, rotation).

    Their number follows from the kinds of constraints: none with three control points that are not collinear, four with
    levels alone, six without constraints.
    """
    controls = [group for group in (control, marks) if len(group)]
    points = np.concatenate([group.points for group in controls]) if controls else np.zeros((1, 3))
    centre = points.mean(axis=0)
    reach = max(float(np.abs(points - centre).max()), 1e-9) if len(points) > 1 else 1.0
    rows = [rigid_motion((group.points - centre) / reach)[group.axes.ravel()] for group in controls]
    if len(differences):
        rows.append(differences.motion(centre, reach))
    if len(levels):
        mean = levels.vertical.mean(axis=0)
        is_parallel = float(np.linalg.norm(levels.vertical - mean, axis=1).max()) < PARALLEL
        across = levels.across[:1] if is_parallel else levels.across
        rows.append(np.concatenate([np.zeros((2 * len(across), 3)), across.reshape(-1, 3)], axis=1))
    if len(yaws):
        rows.append(np.eye(6)[5:])
    if not rows:
        return np.eye(6)
    _, singular, right = np.linalg.svd(np.vstack(rows))
    rank = int(np.sum(singular > COLLINEAR_RATIO * singular.max(initial=0.0)))
    free = right[rank:].T
    free[3:] /= reach
    free /= np.linalg.norm(free, axis=0, keepdims=True)
    free[:3] -= np.cross(free[3:].T, centre).T
    return free


@dataclass(frozen=True)
class Marks:
    """Marks under the set-ups of a recording."""

    target: Ints
    """Index of the target whose mark is under each set-up, -1 for none, (S,)."""
    first: Ints
    """Index of the first set-up on the same mark that is no target; otherwise the set-up itself, (S,)."""
    names: tuple[str, ...]
    """Name of the mark under each set-up, '' for none."""
    vertical: Floats
    """Unit vector of the plumb line, (S, 3)."""
    offset: Floats
    """Vector from the mark to the instrument, (S, 3) [m]."""

    @classmethod
    def of(cls, recording: Recording) -> Marks:
        """The marks of a recording."""
        places = {name: i for i, name in enumerate(recording.targets)}
        setups = [recording.station_setup(name) for name in recording.stations]
        names = tuple(s.over or "" for s in setups)
        target = np.array([places.get(name, -1) if name else -1 for name in names], dtype=np.int64)
        first_on_mark: dict[str, int] = {}
        first = [first_on_mark.setdefault(name, i) if name and target[i] < 0 else i for i, name in enumerate(names)]
        vertical = plumb_directions(recording)
        height = np.array([s.instrument_height_mm if s.over else 0.0 for s in setups]) * MILLIMETRE
        return cls(target, np.array(first, dtype=np.int64), names, vertical, vertical * height[:, None])

    def place(self, station: int, position: Floats, points: Floats) -> Floats:
        """Position (3,) [m] of a set-up from its mark, known as a target or by another set-up on it; NaN otherwise.

        `position` (S, 3) and `points` (T, 3) [m] are NaN for undetermined places.
        """
        if self.target[station] >= 0:
            return np.asarray(points[self.target[station]] + self.offset[station])
        others = [k for k, name in enumerate(self.names) if name and name == self.names[station] and k != station]
        placed = (position[k] - self.offset[k] + self.offset[station] for k in others if np.isfinite(position[k, 0]))
        return next(placed, np.full(3, np.nan))

    def on_marks(self, position: Floats, points: Floats) -> Floats:
        """Positions (S, 3) consistent with their marks: from targets at `points` (T, 3), else from the first set-up."""
        settled = position[self.first] - self.offset[self.first] + self.offset
        over = np.flatnonzero(self.target >= 0)
        settled[over] = points[self.target[over]] + self.offset[over]
        return settled
