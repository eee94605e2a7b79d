"""Objective of a calibration by distances between targets (Sensors 2021, 21, 7479, eq. 9 and 10), in matrix form.

Distances between all pairs of targets are compared between all pairs of stations. Distances on the gauge (reflectors at
known distances) are compared with their reference lengths. Distances do not depend on poses. The two faces of a station
count as two stations, because their mean would hide errors that change sign with the face.

For least squares the sum over pairs of stations equals the number of stations times the sum of squared deviations from
the mean over stations. The cost of the objective is then linear in the number of stations.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ltsim.adjustment.rows import GaugeRows
from ltsim.core.arrays import MAX_MATRIX_ENTRIES, Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.recording import Recording


@dataclass(frozen=True)
class PairDistances:
    """Distances between pairs of targets within each set of pointings (one station and one face).

    Derivatives are with respect to the readings and to the instrument parameters.
    """

    lengths: Floats
    """Distances between the two targets of each pair, shape (distances,) [m]."""
    target_pair_indices: Ints
    """Index of the pair of targets to which each distance belongs, shape (distances,)."""
    parameter_derivatives: Floats
    """Derivative of each distance with respect to each parameter in prior standard deviations, shape (distances,
    parameters) [m]."""
    reading_derivatives: sp.csr_array
    """Derivative of each distance with respect to each whitened reading, shape (distances, 3 pointings) [m]."""


@dataclass(frozen=True)
class DistanceProblem:
    """Distances within each set of pointings (station and face), as functions of instrument parameters and readings."""

    recording: Recording
    """Recording; pointings without a range or an angle are not used."""
    construction: GeometricErrorModel
    """Geometric error model of the instruments."""
    prior_sigma: Floats
    """Prior standard deviations, shape (instruments, parameters) [SI]; the units of the unknowns."""

    @cached_property
    def reference_lengths(self) -> GaugeRows:
        """Reference lengths (known distances of targets) that `setup.toml` declares."""
        return GaugeRows.from_recording(self.recording)

    @cached_property
    def station_face_indices(self) -> Ints:
        """Index of the set (station and face) of each pointing, from 0, shape (pointings,)."""
        _, number = np.unique(2 * self.recording.station + self.recording.face - 1, return_inverse=True)
        return number.astype(np.int64)

    @cached_property
    def _averaging_matrix(self) -> tuple[sp.csr_array, Floats]:
        """Matrix (mean points, pointings) that averages the pointings of each set to each target, with indices.

        A set is the pointings of one station in one face. The indices (mean points, 2) are the set and the target of
        each mean point.
        """
        n_targets = len(self.recording.targets)
        key = self.station_face_indices * n_targets + self.recording.target
        complete_rows = np.flatnonzero(self.recording.is_measured.all(axis=1))
        keys, inverse, repeats = np.unique(key[complete_rows], return_inverse=True, return_counts=True)
        entries = (1.0 / repeats[inverse], (inverse, complete_rows))
        matrix = sp.csr_array(sp.coo_array(entries, shape=(len(keys), len(key))))
        return matrix, np.stack([keys // n_targets, keys % n_targets], axis=1)

    @cached_property
    def _distance_end_and_pair_indices(self) -> tuple[Ints, Ints, Ints]:
        """Indices of the first and second mean point of each distance, and the index of its pair of targets.

        A mean point is the mean of the pointings of one station and face to a target.
        """
        sets, target = self._averaging_matrix[1].T
        a, b = _pairs_within_groups(
            np.flatnonzero(sets == number) for number in range(int(self.station_face_indices.max(initial=-1)) + 1)
        )
        self._check_matrix_size(len(a))
        return a, b, target[a] * len(self.recording.targets) + target[b]

    def _check_matrix_size(self, n_rows: int) -> None:
        """Check that the matrix of the distances, with `n_rows` rows, is not too large; raises NetworkError if so."""
        if n_rows * (self.prior_sigma.size + 8) > MAX_MATRIX_ENTRIES:
            raise NetworkError(f"the distance objective has too many distances ({n_rows}); use the method network")

    def distances_at(self, unknowns: Floats) -> PairDistances:
        """Distances within all sets (station and face); `unknowns` are instrument parameters in prior sigmas."""
        point, by_reading, by_value = self._points_and_derivatives(self.recording.readings, unknowns)
        group = self._distance_end_and_pair_indices[2]
        length, unit, by_parameter = self._distances_and_derivatives(point, by_value)
        return PairDistances(length, group, by_parameter, self._reading_derivatives(unit, by_reading))

    def parameter_derivatives(self, readings: Floats, unknowns: Floats) -> Floats:
        """Derivative (distances, unknowns) of the distances with respect to the parameters, at given `readings`."""
        point, _, by_value = self._points_and_derivatives(readings, unknowns)
        return self._distances_and_derivatives(point, by_value)[2]

    def _distances_and_derivatives(self, point: Floats, point_derivatives: Floats) -> tuple[Floats, Floats, Floats]:
        """Distances between mean points, unit vectors along them, and derivatives with respect to the parameters.

        A mean point is the mean of the pointings of one station and face to a target. The shapes are (distances,),
        (distances, 3) and (distances, parameters).
        """
        averaging, _ = self._averaging_matrix
        a, b, _ = self._distance_end_and_pair_indices
        points = averaging @ point
        gap = points[a] - points[b]
        distances = np.linalg.norm(gap, axis=1)
        unit = gap / distances[:, None]
        means = (averaging @ point_derivatives.reshape(len(point), -1)).reshape(len(points), 3, -1)
        return distances, unit, np.einsum("di,dip->dp", unit, means[a]) - np.einsum("di,dip->dp", unit, means[b])

    def distances_of_points(self, points: Floats) -> Floats:
        """Distances (distances, trials) [m] within sets (station and face), from points (pointings, 3, trials) [m]."""
        averaging, _ = self._averaging_matrix
        a, b, _ = self._distance_end_and_pair_indices
        means = (averaging @ points.reshape(len(points), -1)).reshape(-1, *points.shape[1:])
        return np.linalg.norm(means[a] - means[b], axis=1)

    def _points_and_derivatives(self, readings: Floats, unknowns: Floats) -> tuple[Floats, Floats, Floats]:
        """Measured points (pointings, 3), and their derivatives by readings and parameters.

        The derivatives are with respect to the whitened readings, shape (pointings, 3, 3), and to the parameters of all
        instruments in prior standard deviations, shape (pointings, 3, parameters).
        """
        recording, (count, size) = self.recording, self.prior_sigma.shape
        parameter_values = unknowns.reshape(self.prior_sigma.shape) * self.prior_sigma
        raw_readings = np.where(recording.is_measured, readings, 1.0)
        index = recording.instrument
        point, by_reading, by_value = self.construction.linearise(raw_readings, parameter_values[index])
        design = np.zeros((len(raw_readings), 3, count * size))
        for i in range(count):
            rows = index == i
            design[rows, :, i * size : (i + 1) * size] = by_value[rows] * self.prior_sigma[i]
        return point, by_reading * recording.reading_sigmas()[:, None, :], design

    def _reading_derivatives(self, directions: Floats, point_derivatives: Floats) -> sp.csr_array:
        """Derivative of the distances with respect to the whitened readings, shape (distances, 3 pointings).

        `directions` (distances, 3) are unit vectors along the distances, `point_derivatives` (pointings, 3, 3) those of
        the points with respect to the readings.
        """
        averaging, _ = self._averaging_matrix
        a, b, _ = self._distance_end_and_pair_indices
        n = len(point_derivatives)
        along = [sp.diags_array(directions[:, i]) for i in range(3)]
        point_rows = sp.csr_array(averaging[a] - averaging[b])
        row = np.repeat(np.arange(n), 3)
        total = sp.csr_array((len(directions), 3 * n))
        for i in range(3):
            block = sp.csr_array(sp.coo_array((point_derivatives[:, i].ravel(), (row, np.arange(3 * n))), (n, 3 * n)))
            total = total + along[i] @ (point_rows @ block)
        return sp.csr_array(total)

    def gauge_match_indices(self, distances: PairDistances) -> tuple[Ints, Ints]:
        """Indices of the distances with a reference length, and for each of them the index of this length."""
        n_targets = len(self.recording.targets)
        lower_targets = np.minimum(self.reference_lengths.first_targets, self.reference_lengths.second_targets)
        upper_targets = np.maximum(self.reference_lengths.first_targets, self.reference_lengths.second_targets)
        index = {int(key): i for i, key in enumerate(lower_targets * n_targets + upper_targets)}
        gauge_indices = np.array([index.get(int(group), -1) for group in distances.target_pair_indices], dtype=np.int64)
        matched_rows = np.flatnonzero(gauge_indices >= 0)
        return matched_rows, gauge_indices[matched_rows]


def mean_removal_matrix(distances: PairDistances) -> tuple[sp.csr_array, Floats]:
    """Matrix (distances, distances) that subtracts from each distance its mean over all sets (station and face).

    The second result is the number of sets in which each distance was measured.
    """
    _, group, count = np.unique(distances.target_pair_indices, return_inverse=True, return_counts=True)
    rows = np.arange(len(group))
    member = sp.csr_array(sp.coo_array((np.ones(len(group)), (rows, group))))
    mean = member @ sp.diags_array(1.0 / count) @ member.T
    return sp.csr_array(sp.eye_array(len(group)) - mean), count[group].astype(np.float64)


def compared_distance_indices(distances: PairDistances) -> tuple[Ints, Ints]:
    """Indices of the first and second distance of each comparison: one pair of targets, measured in two sets.

    A set is the pointings of one station in one face.
    """
    order = np.argsort(distances.target_pair_indices, kind="stable")
    return _pairs_within_groups(np.split(order, np.flatnonzero(np.diff(distances.target_pair_indices[order])) + 1))


def _pairs_within_groups(groups: Iterable[Ints]) -> tuple[Ints, Ints]:
    """First and second index of each pair of indices in the same group; a group is an array of indices."""
    pairs_by_group = [members[np.stack(np.triu_indices(len(members), k=1))] for members in groups]
    first, second = np.concatenate(pairs_by_group, axis=1)
    return first, second
