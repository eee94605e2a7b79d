"""Expected precision of a layout before measurement: standard deviations, combinations, agreement of stations.

The least-squares problem of the calibration is linearised at the nominal state, a perfect instrument at the planned
places. The covariance does not depend on readings.

The expected improvement by calibration (Sensors 2021, 21, 7479, eq. 11 and 12) is linear in the errors: noise,
reference lengths, instrument parameters and unmodelled effects. A matrix describes the influence of each error on the
criteria before and after a network calibration. Variances add over groups of errors, so that one matrix gives the
results for any sizes of these groups.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.coordinate_uncertainty import air_covariance
from ltsim.adjustment.remedies.undetermined import (
    MeasurementForCombination,
    ParameterCombination,
    measurements_for_undetermined,
    undetermined_combinations,
)
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats
from ltsim.core.errors import NetworkError, unknown_name_error
from ltsim.geometry.rigid import rigid_motion_design
from ltsim.physics.effects.effect import Effect
from ltsim.physics.model.construction import GeometricErrorModel, misalignment_construction
from ltsim.planning.survey import PlannedSurvey


@dataclass(frozen=True)
class LayoutInformation:
    """Expected precision of a planned survey with S stations and T targets, for p instrument parameters."""

    survey: PlannedSurvey
    """Planned survey."""
    adjustment: Adjustment
    """Adjustment at the nominal state; its precision is that of the planned survey."""

    @classmethod
    def from_survey(cls, survey: PlannedSurvey, construction: GeometricErrorModel | None = None) -> LayoutInformation:
        """Expected precision of a survey, by default with the 16 misalignment parameters.

        Raises NetworkError for undetermined poses or targets.
        """
        built = construction or misalignment_construction()
        if not survey.is_visible.size:
            raise NetworkError("no station sees a target")
        unseen = np.flatnonzero(~survey.is_visible.any(axis=0))
        if len(unseen):
            raise NetworkError(f"target {survey.target_names[unseen[0]]} is not visible from any station")
        adjustment = Adjustment.from_plan(survey.noise_free_recording(built), survey.nominal_state(built), built)
        if adjustment.undetermined_targets:
            raise NetworkError(f"the ranges do not determine target {adjustment.undetermined_targets[0]}")
        return cls(survey, adjustment)

    @property
    def construction(self) -> GeometricErrorModel:
        """Geometric error model of the instrument, whose parameters are estimated."""
        return self.adjustment.construction

    @property
    def prior_sigma(self) -> Floats:
        """Prior standard deviations of the first instrument's parameters, (p,) [SI]."""
        return self.adjustment.problem.prior.sigma[0]

    @property
    def instrument_covariance(self) -> Floats:
        """Covariance of the instrument parameters, priors included, (p, p) [SI]."""
        return self.adjustment.instrument_covariance

    @property
    def scaled_covariance(self) -> Floats:
        """Covariance of the instrument parameters in units of the prior sigmas, (p, p).

        Without readings it is the identity matrix.
        """
        return self.instrument_covariance / np.outer(self.prior_sigma, self.prior_sigma)

    @cached_property
    def instrument_sigmas(self) -> Floats:
        """Standard deviation of each instrument parameter, (p,) [SI]."""
        return np.sqrt(np.diag(self.instrument_covariance))

    @cached_property
    def undetermined_combinations(self) -> list[ParameterCombination]:
        """Combinations of parameters whose prior variance the readings reduce by less than one half.

        The least determined combination is first.
        """
        return undetermined_combinations(self.instrument_covariance, self.prior_sigma)

    def measurements_for_undetermined(self) -> list[MeasurementForCombination]:
        """Measurement for each undetermined combination that would determine it."""
        return measurements_for_undetermined(self.adjustment, self.construction, [self.undetermined_combinations])[0]

    @cached_property
    def _inner_datum_adjustment(self) -> Adjustment:
        """Adjustment with inner constraints over all targets."""
        return self.adjustment.with_inner_datum()

    @property
    def pose_covariance(self) -> Floats:
        """Covariance of translation [m] and rotation [rad] of each station, (S, 6, 6).

        The datum is the mean of all targets (inner constraints).
        """
        return self._inner_datum_adjustment.pose_covariance + air_covariance(
            self._inner_datum_adjustment, self._inner_datum_adjustment.problem.unknowns.pose_columns
        )

    @cached_property
    def target_covariance(self) -> Floats:
        """Covariance of each target, (T, 3, 3) [m^2], including the uncertainty of the air.

        The datum is the mean of all targets (inner constraints).
        """
        return self._inner_datum_adjustment.target_covariance + air_covariance(
            self._inner_datum_adjustment, self._inner_datum_adjustment.problem.unknowns.target_columns
        )

    @cached_property
    def target_sigmas(self) -> Floats:
        """Point error of each target, the square root of the trace of its covariance, (T,) [m]."""
        return np.sqrt(np.einsum("tii->t", self.target_covariance))

    @property
    def target_rms(self) -> float:
        """Root mean square [m] of the point errors of all targets, each with equal weight."""
        return float(np.sqrt(np.mean(self.target_sigmas**2)))

    @property
    def weighted_target_rms(self) -> float:
        """Root mean square point error [m] over all targets, weighted as in the survey: part of the objective."""
        return float(np.sqrt(np.mean(self.survey.normalised_target_weights * self.target_sigmas**2)))


PARAMETER_GROUPS = {
    None: "instrument",
    "angle": "angle errors",
    "offset": "offset errors",
    "range_scale": "range scale",
    "range_offset": "range offset",
}
"""Name of the group of errors for each kind of instrument parameter; None is any other kind."""
RANGE_NOISE_GROUP = "range noise"
ANGLE_NOISE_GROUP = "angle noise"
GAUGE_LENGTHS_GROUP = "gauge lengths"
REFLECTORS_GROUP = "reflectors"


@dataclass(frozen=True)
class ExpectedCriteria:
    """Expected mean disagreement of the stations in distances and coordinates [m], before and after calibration.

    These are the criteria of Sensors 2021, 21, 7479, eq. 11 and 12.

    Each field is (k,): one value for each of k assumptions on the sizes of the errors.
    """

    distance_before: Floats
    distance_after: Floats
    coordinate_before: Floats
    coordinate_after: Floats

    @property
    def distance_improvement(self) -> Floats:
        """Expected improvement of the distance criterion [%]."""
        return 100.0 * (1.0 - self.distance_after / self.distance_before)

    @property
    def coordinate_improvement(self) -> Floats:
        """Expected improvement of the coordinate criterion [%]."""
        return 100.0 * (1.0 - self.coordinate_after / self.coordinate_before)


@dataclass(frozen=True)
class CriteriaPredictor:
    """Contribution of each of G groups of errors, at its nominal size, to the disagreement of the stations."""

    error_groups: tuple[str, ...]
    """Names of the groups: noise, gauge lengths, instrument parameters by kind, and the unmodelled effects."""
    distance_variances: Floats
    """Variance of the deviation of each measured distance from its mean over stations, (2, G, rows) [m^2]; the first
    index is before and after calibration, the last one pair of targets and station.
    """
    coordinate_covariances: Floats
    """Covariance of the difference between the positions of each target from two stations, (2, G, rows, 3, 3) [m^2];
    the first index is before and after calibration, the third one target and pair of stations.
    """

    @classmethod
    def from_information(
        cls, layout_information: LayoutInformation, unmodelled_effects: Sequence[Effect] = ()
    ) -> CriteriaPredictor:
        """Predictor for a layout in which all stations see all targets.

        The effects in `unmodelled_effects` act on the readings but are not estimated; each is a separate group of
        errors, with the size of its prior sigma.
        """
        ways, group = _unit_error_displacements(layout_information, unmodelled_effects)
        names = tuple(dict.fromkeys(group))
        lengths, gaps = (
            _distance_deviation_matrix(layout_information),
            _coordinate_difference_matrix(layout_information),
        )
        distance = np.empty((2, len(names), len(lengths)))
        coordinate = np.empty((2, len(names), len(gaps), 3, 3))
        member = np.array([names.index(g) for g in group])
        for i, way in enumerate(ways):
            along, across = lengths @ way, np.einsum("rki,im->rkm", gaps, way, optimize=True)
            for g in range(len(names)):
                at = member == g
                distance[i, g] = (along[:, at] ** 2).sum(axis=1)
                coordinate[i, g] = across[:, :, at] @ np.swapaxes(across[:, :, at], 1, 2)
        return cls(names, distance, coordinate)

    def expected_criteria(self, group_sizes: Mapping[str, Floats | float] | None = None) -> ExpectedCriteria:
        """Expected criteria for k assumptions on the sizes of the errors.

        `group_sizes` holds, by group of errors, k factors (k,) on the nominal size of the group. A group that is
        missing has its nominal size.
        """
        wanted = dict(group_sizes or {})
        for name in wanted:
            if name not in self.error_groups:
                raise unknown_name_error("group of errors", name, self.error_groups)
        scale = np.stack(
            np.broadcast_arrays(*(np.atleast_1d(wanted.get(name, 1.0)) for name in self.error_groups)), axis=1
        )
        square = scale.astype(np.float64) ** 2
        distance = [
            np.sqrt(2 / np.pi) * np.mean(np.sqrt(square @ variance), axis=1) for variance in self.distance_variances
        ]
        coordinate = [_mean_length(square, spread) for spread in self.coordinate_covariances]
        return ExpectedCriteria(distance[0], distance[1], coordinate[0], coordinate[1])


def _mean_length(row_matrices: Floats, variances_by_set: Floats) -> Floats:
    """Mean over rows of the expected length (k,) of normal vectors whose covariance is a sum over groups of errors.

    `row_matrices` hold the covariance of each row by group at its nominal size, `variances_by_set` the k factors on the
    covariance of each group.
    """
    means = [
        expected_length(np.asarray(np.linalg.eigvalsh(np.tensordot(part, variances_by_set, axes=1)))).mean(axis=1)
        for part in np.array_split(row_matrices, max(1, len(row_matrices) // 64))
    ]
    return np.concatenate(means)


def expected_length(variances: Floats, n_nodes: int = 48) -> Floats:
    """Expected length (...) of a normally distributed vector with variances (..., 3) along its axes, to about 1e-6.

    E sqrt(q) = 1 / (2 sqrt(pi)) integral of (1 - E exp(-t q)) t^(-3/2) dt, with E exp(-t q) the product of (1 + 2 t
    variance)^(-1/2). The variable t is replaced by (x / (1 - x))^2 divided by the total variance, and the integral over
    x is computed by Gauss-Legendre quadrature with `n_nodes` nodes.
    """
    total_variance = np.maximum(variances.sum(axis=-1, keepdims=True), np.finfo(np.float64).tiny)
    variance_fractions = np.maximum(variances, 0.0) / total_variance
    at, weight = np.polynomial.legendre.leggauss(n_nodes)
    x, weight = 0.5 * (at + 1.0), 0.5 * weight
    root = x / (1.0 - x)
    product = np.ones((*variance_fractions.shape[:-1], n_nodes))
    for axis in range(3):
        product /= np.sqrt(1.0 + 2.0 * variance_fractions[..., axis, None] * root**2)
    mean_length: Floats = ((1.0 - product) / root**2 * (weight / (1.0 - x) ** 2)).sum(axis=-1) / np.sqrt(np.pi)
    return mean_length * np.sqrt(total_variance[..., 0])


def _unit_error_displacements(
    layout_information: LayoutInformation, unmodelled_effects: Sequence[Effect]
) -> tuple[tuple[Floats, Floats], list[str]]:
    """Displacements of measured points by a unit error of each of e error sources, before and after calibration.

    Two matrices (3 S T, e), for T targets measured from each of S stations, and the names (e) of the groups (noise,
    gauge lengths, parameters) to which the errors belong.
    """
    adjustment, construction = layout_information.adjustment, layout_information.construction
    problem, sightings = adjustment.problem, adjustment.sightings
    design = adjustment.solution.system.design
    count, lengths, params = (
        int(problem.is_used_reading.sum()),
        len(problem.gauge_rows),
        len(layout_information.prior_sigma),
    )
    n_extra = problem.model.n_extra_parameters
    priors = design.shape[0] - problem.free_motions.shape[1] - params - n_extra
    averaging_matrix = _averaging_matrix(layout_information)
    _, by_reading, by_value = construction.linearise(sightings.raw_readings, np.zeros(construction.n_parameters))
    noise = (
        np.einsum("rn,nij->rinj", averaging_matrix, by_reading).reshape(3 * len(averaging_matrix), -1)
        * problem.sigma.ravel()
    )
    parameters = -np.einsum("rn,nij->rij", averaging_matrix, by_value).reshape(3 * len(averaging_matrix), -1)
    places = np.concatenate([problem.unknowns.instrument_columns[0], problem.unknowns.effect_columns])
    columns = np.eye(problem.unknowns.n_columns)[:, places]
    answer = adjustment.factorised_normals.covariance_columns(columns).T @ design.T
    by_extra = (noise / problem.sigma.ravel()) @ problem.model.extra_design(sightings).reshape(noise.shape[1], n_extra)
    errors = np.zeros((design.shape[0], 0))
    if unmodelled_effects:
        space = ResidualSpace.from_adjustment(adjustment)
        errors = np.hstack(
            [space.whitened_design(e) * [p.prior_sigma for p in e.parameters] for e in unmodelled_effects]
        )
    is_used = np.flatnonzero(problem.is_used_reading.ravel())
    columns_used = np.r_[0 : count + lengths, priors : priors + params + n_extra]
    first_response = np.zeros((len(noise), len(columns_used) + errors.shape[1]))
    first_response[:, :count] = noise[:, is_used]
    by_parameter = np.hstack([parameters, by_extra])
    first_response[:, count + lengths : len(columns_used)] = -by_parameter * np.append(
        layout_information.prior_sigma, problem.effect_sigma
    )
    first_response[:, len(columns_used) :] = noise[:, is_used] @ errors[:count]
    second_response = first_response.copy()
    second_response[:, count + lengths : len(columns_used)] = 0.0
    second_response -= by_parameter @ np.hstack([answer[:, columns_used], answer @ errors])
    labels = np.where(is_used % 3 == 0, RANGE_NOISE_GROUP, ANGLE_NOISE_GROUP).tolist() + [GAUGE_LENGTHS_GROUP] * lengths
    labels += [PARAMETER_GROUPS[p.prior_kind] for p in construction.parameters]
    labels += [REFLECTORS_GROUP] * n_extra
    return (first_response, second_response), labels + [e.name for e in unmodelled_effects for _ in e.parameters]


def _averaging_matrix(layout_information: LayoutInformation) -> Floats:
    """Matrix (S T, n) of the means over faces and repeats of each station's pointings to each target."""
    recording = layout_information.adjustment.recording
    place = recording.station * len(recording.targets) + recording.target
    averaging_matrix = np.zeros((len(recording.stations) * len(recording.targets), len(recording)))
    averaging_matrix[place, np.arange(len(recording))] = 1.0
    return averaging_matrix / averaging_matrix.sum(axis=1, keepdims=True)


def _distance_deviation_matrix(layout_information: LayoutInformation) -> Floats:
    """Matrix (rows, 3 S T) from displacements to deviations of each measured distance from its mean over stations."""
    state = layout_information.adjustment.state
    stations, targets = len(state.station_positions), len(state.target_points)
    first, second = np.triu_indices(targets, k=1)
    gap = state.target_points[first] - state.target_points[second]
    unit = gap / np.linalg.norm(gap, axis=1, keepdims=True)
    local_directions = np.einsum("sji,pj->spi", state.station_rotations, unit)
    displacement = np.zeros((stations, len(first), stations, targets, 3))
    pair = np.arange(len(first))
    for s in range(stations):
        displacement[s, pair, s, first] = local_directions[s]
        displacement[s, pair, s, second] = -local_directions[s]
    deviation = displacement - displacement.mean(axis=0)
    return deviation.reshape(stations * len(first), -1)


def _coordinate_difference_matrix(layout_information: LayoutInformation) -> Floats:
    """Matrix (rows, 3, 3 S T) from displacements to differences between the positions of a target from two stations.

    The stations are aligned rigidly first.
    """
    state = layout_information.adjustment.state
    stations, targets = len(state.station_positions), len(state.target_points)
    motion = rigid_motion_design(state.target_points, state.target_points.mean(axis=0))
    non_rigid_projector = np.eye(3 * targets) - motion @ np.linalg.pinv(motion)
    turned = np.einsum("ctl,sli->scti", non_rigid_projector.reshape(3 * targets, targets, 3), state.station_rotations)
    turned = turned.reshape(stations, targets, 3, 3 * targets)
    matrix_rows = []
    for m, n in combinations(range(stations), 2):
        gap = np.zeros((targets, 3, stations, 3 * targets))
        gap[:, :, m], gap[:, :, n] = turned[m], -turned[n]
        matrix_rows.append(gap.reshape(targets, 3, -1))
    return np.concatenate(matrix_rows)
