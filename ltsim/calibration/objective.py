"""The paper's distance objective (Sensors 2021, 21, 7479, eq. 9 and 10) in matrix form.

Distances between all pairs of targets are compared between all pairs of stations, and those of the gauge with their
reference lengths. Distances do not depend on poses. The two faces of a station count as two stations, because averages
would hide errors that change sign with the face.

For least squares the sum over pairs of stations is the number of stations times the sum of squares of deviations from
the mean over stations, which makes the objective linear in the number of stations.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ltsim.adjustment.rows import GaugeRows
from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.physics.model.construction import Construction
from ltsim.recordings.recording import Recording

LARGEST = 2e8
"""Largest number of entries in one matrix."""


@dataclass(frozen=True)
class Distances:
    """Distances within each set (a station and a face) at given parameters, and their derivatives."""

    length: Floats
    """Distances, (D,) [m]."""
    group: Ints
    """Index of the pair of targets of each distance, (D,)."""
    by_parameter: Floats
    """Derivative with respect to each parameter, per prior sigma, (D, q)."""
    by_reading: sp.csr_array
    """Derivative with respect to each reading, per standard deviation, (D, 3 n)."""


@dataclass(frozen=True)
class DistanceProblem:
    """Distances of a recording as functions of the parameters and the readings."""

    recording: Recording
    """Recording; rows without a range or an angle are not used."""
    construction: Construction
    prior_sigma: Floats
    """Prior sigmas, the units of the unknowns, (I, p) [SI]."""

    @cached_property
    def gauge(self) -> GaugeRows:
        """Reference lengths in the workshop."""
        return GaugeRows.of(self.recording)

    @cached_property
    def sets(self) -> Ints:
        """Number of the set (station and face) of each row, from 0, (n,)."""
        _, number = np.unique(2 * self.recording.station + self.recording.face - 1, return_inverse=True)
        return number.astype(np.int64)

    @cached_property
    def _averaging(self) -> tuple[sp.csr_array, Floats]:
        """Matrix (M, n) that averages repeats to one point per set and target; set and target of each point (M, 2)."""
        count = len(self.recording.targets)
        key = self.sets * count + self.recording.target
        whole = np.flatnonzero(self.recording.measured.all(axis=1))
        keys, inverse, repeats = np.unique(key[whole], return_inverse=True, return_counts=True)
        entries = (1.0 / repeats[inverse], (inverse, whole))
        matrix = sp.csr_array(sp.coo_array(entries, shape=(len(keys), len(key))))
        return matrix, np.stack([keys // count, keys % count], axis=1)

    @cached_property
    def _pairs(self) -> tuple[Ints, Ints, Ints]:
        """First point, second point and pair of targets of every distance."""
        sets, target = self._averaging[1].T
        a, b = _all_pairs(np.flatnonzero(sets == number) for number in range(int(self.sets.max(initial=-1)) + 1))
        self._check_size(len(a))
        return a, b, target[a] * len(self.recording.targets) + target[b]

    def _check_size(self, count: int) -> None:
        if count * (self.prior_sigma.size + 8) > LARGEST:
            raise NetworkError(f"the distance objective has {count} distances, too many; use the network method")

    def at(self, unknowns: Floats) -> Distances:
        """All distances at unknowns (I p,) in units of the prior sigmas."""
        point, by_reading, by_value = self._points(self.recording.readings, unknowns)
        group = self._pairs[2]
        length, unit, by_parameter = self._lengths(point, by_value)
        return Distances(length, group, by_parameter, self._by_reading(unit, by_reading))

    def by_parameter(self, readings: Floats, unknowns: Floats) -> Floats:
        """Derivative (D, q) of all distances with respect to the unknowns (q,) for other readings (n, 3)."""
        point, _, by_value = self._points(readings, unknowns)
        return self._lengths(point, by_value)[2]

    def _lengths(self, point: Floats, by_value: Floats) -> tuple[Floats, Floats, Floats]:
        """Distances (D,), their directions (D, 3) and their derivatives (D, q) by the unknowns."""
        averaging, _ = self._averaging
        a, b, _ = self._pairs
        points = averaging @ point
        gap = points[a] - points[b]
        length = np.linalg.norm(gap, axis=1)
        unit = gap / length[:, None]
        means = (averaging @ by_value.reshape(len(point), -1)).reshape(len(points), 3, -1)
        return length, unit, np.einsum("di,dip->dp", unit, means[a]) - np.einsum("di,dip->dp", unit, means[b])

    def lengths(self, points: Floats) -> Floats:
        """Distances (D, B) within sets, in the order of `at`, for points (n, 3, B) in the instruments' frames."""
        averaging, _ = self._averaging
        a, b, _ = self._pairs
        means = (averaging @ points.reshape(len(points), -1)).reshape(-1, *points.shape[1:])
        return np.linalg.norm(means[a] - means[b], axis=1)

    def _points(self, readings: Floats, unknowns: Floats) -> tuple[Floats, Floats, Floats]:
        """Points (n, 3), derivatives by readings (n, 3, 3) per sigma and by unknowns (n, 3, I p)."""
        recording, (count, size) = self.recording, self.prior_sigma.shape
        values = unknowns.reshape(self.prior_sigma.shape) * self.prior_sigma
        raw = np.where(recording.measured, readings, 1.0)
        which = recording.instrument
        point, by_reading, by_value = self.construction.linearised(raw, values[which])
        wide = np.zeros((len(raw), 3, count * size))
        for i in range(count):
            rows = which == i
            wide[rows, :, i * size : (i + 1) * size] = by_value[rows] * self.prior_sigma[i]
        return point, by_reading * recording.sigma()[:, None, :], wide

    def _by_reading(self, unit: Floats, by_reading: Floats) -> sp.csr_array:
        """Derivative (D, 3 n) of the distances by the whitened readings."""
        averaging, _ = self._averaging
        a, b, _ = self._pairs
        n = len(by_reading)
        along = [sp.diags_array(unit[:, i]) for i in range(3)]
        point_rows = sp.csr_array(averaging[a] - averaging[b])
        row = np.repeat(np.arange(n), 3)
        total = sp.csr_array((len(unit), 3 * n))
        for i in range(3):
            block = sp.csr_array(sp.coo_array((by_reading[:, i].ravel(), (row, np.arange(3 * n))), (n, 3 * n)))
            total = total + along[i] @ (point_rows @ block)
        return sp.csr_array(total)

    def gauge_matches(self, distances: Distances) -> tuple[Ints, Ints]:
        """Rows of `distances` with a reference length, and its index."""
        count = len(self.recording.targets)
        low = np.minimum(self.gauge.first, self.gauge.second)
        high = np.maximum(self.gauge.first, self.gauge.second)
        index = {int(key): i for i, key in enumerate(low * count + high)}
        which = np.array([index.get(int(group), -1) for group in distances.group], dtype=np.int64)
        rows = np.flatnonzero(which >= 0)
        return rows, which[rows]


def centring(distances: Distances) -> tuple[sp.csr_array, Floats]:
    """Matrix (D, D) that subtracts the mean over sets from each pair's distances, and each row's number of sets."""
    _, group, count = np.unique(distances.group, return_inverse=True, return_counts=True)
    rows = np.arange(len(group))
    member = sp.csr_array(sp.coo_array((np.ones(len(group)), (rows, group))))
    mean = member @ sp.diags_array(1.0 / count) @ member.T
    return sp.csr_array(sp.eye_array(len(group)) - mean), count[group].astype(np.float64)


def set_pairs(distances: Distances) -> tuple[Ints, Ints]:
    """Rows of `distances` to be compared: one pair of targets from two sets, for all pairs of sets."""
    order = np.argsort(distances.group, kind="stable")
    return _all_pairs(np.split(order, np.flatnonzero(np.diff(distances.group[order])) + 1))


def _all_pairs(groups: Iterable[Ints]) -> tuple[Ints, Ints]:
    """First and second index of all pairs within groups."""
    pairs = [members[np.stack(np.triu_indices(len(members), k=1))] for members in groups]
    first, second = np.concatenate(pairs, axis=1)
    return first, second
