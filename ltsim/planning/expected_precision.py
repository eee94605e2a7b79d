"""Expected precision of a layout before measurement: standard deviations, undetermined parameters, disagreement.

The least-squares problem of the calibration is linearised for a perfect instrument at the planned positions. Its
covariance matrix does not depend on readings.

Two criteria of Sensors 2021, 21, 7479 (eq. 11 and 12) measure how much the stations disagree in distances and in
coordinates of targets. The disagreements are linear in the errors: noise, reference lengths, instrument parameters and
unmodelled effects. One matrix describes the influence of each error on them before a network calibration, a second
matrix the influence after it. The variances of groups of errors add, so that these two matrices give the criteria for
any sizes of the groups.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.coordinate_uncertainty import covariance_due_to_air
from ltsim.adjustment.remedies.undetermined import (
    MeasurementForCombination,
    ParameterCombination,
    measurements_for_undetermined,
    undetermined_combinations,
)
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats
from ltsim.core.errors import NetworkError, unknown_name_error
from ltsim.geometry.rigid import rigid_motion_jacobian
from ltsim.physics.effects.effect import Effect
from ltsim.physics.model.construction import GeometricErrorModel, misalignment_construction
from ltsim.planning.survey import PlannedSurvey


@dataclass(frozen=True)
class ExpectedPrecision:
    """Expected precision of a planned survey with S stations and T targets, for p instrument parameters."""

    survey: PlannedSurvey
    """Planned survey to which the precision refers."""
    adjustment: Adjustment
    """Least-squares adjustment, linearised for a perfect instrument at the planned positions; its covariance is the
    expected covariance."""

    @classmethod
    def from_survey(cls, survey: PlannedSurvey, construction: GeometricErrorModel | None = None) -> ExpectedPrecision:
        """Expected precision of a survey whose calibration estimates the parameters of `construction`.

        `construction` is the geometric error model of the instrument, by default the model with 16 misalignment
        parameters. Raises NetworkError for undetermined poses or targets.
        """
        built = construction or misalignment_construction()
        if not survey.is_visible.size:
            raise NetworkError("no station sees any target")
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
        """Prior standard deviations (p,) of the p instrument parameters [m, rad or 1]."""
        return self.adjustment.problem.prior.sigma[0]

    @property
    def instrument_covariance(self) -> Floats:
        """Expected covariance matrix (p, p) of the p instrument parameters [SI], from readings and priors."""
        return self.adjustment.first_instrument_covariance

    @property
    def covariance_in_prior_sigmas(self) -> Floats:
        """Covariance matrix (p, p) of the p instrument parameters in prior sigmas; the identity without readings."""
        return self.instrument_covariance / np.outer(self.prior_sigma, self.prior_sigma)

    @cached_property
    def instrument_sigmas(self) -> Floats:
        """Expected standard deviation (p,) of the p instrument parameters [m, rad or 1], from readings and priors."""
        return np.sqrt(np.diag(self.instrument_covariance))

    @cached_property
    def undetermined_combinations(self) -> list[ParameterCombination]:
        """Linear combinations of instrument parameters whose prior variance the readings reduce by less than one half.

        The least determined combination is first.
        """
        return undetermined_combinations(self.instrument_covariance, self.prior_sigma)

    def measurements_for_undetermined(self) -> list[MeasurementForCombination]:
        """Proposed measurement for each undetermined combination of parameters, which would determine it."""
        return measurements_for_undetermined(self.adjustment, self.construction, [self.undetermined_combinations])[0]

    @cached_property
    def _inner_datum_adjustment(self) -> Adjustment:
        """Adjustment whose datum is defined by inner constraints over all targets."""
        return self.adjustment.with_inner_datum()

    @property
    def pose_covariance(self) -> Floats:
        """Covariance matrix (S, 6, 6) of the translation [m] and rotation [rad] of each of the S stations.

        The uncertainty of the air is included. The datum is the mean of all targets (inner constraints).
        """
        return self._inner_datum_adjustment.pose_covariance + covariance_due_to_air(
            self._inner_datum_adjustment, self._inner_datum_adjustment.problem.unknowns.pose_columns
        )

    @cached_property
    def target_covariances(self) -> Floats:
        """Covariance matrix (T, 3, 3) [m^2] of each of the T targets, including the uncertainty of the air.

        The datum is the mean of all targets (inner constraints).
        """
        return self._inner_datum_adjustment.target_covariances + covariance_due_to_air(
            self._inner_datum_adjustment, self._inner_datum_adjustment.problem.unknowns.target_columns
        )

    @cached_property
    def target_point_errors(self) -> Floats:
        """Point error (T,) [m] of each of the T targets: square root of the trace of its covariance matrix."""
        return np.sqrt(np.einsum("tii->t", self.target_covariances))

    @property
    def target_rms(self) -> float:
        """Root mean square [m] of the point errors of all targets, each with equal weight."""
        return float(np.sqrt(np.mean(self.target_point_errors**2)))

    @property
    def weighted_target_rms(self) -> float:
        """Weighted root mean square [m] of the point errors of all targets, with `PlannedSurvey.target_weights`."""
        return float(np.sqrt(np.mean(self.survey.normalised_target_weights * self.target_point_errors**2)))


ERROR_GROUP_BY_SPECIFIED_QUANTITY = {
    None: "instrument",
    "angle": "angle errors",
    "offset": "offset errors",
    "range_scale": "range scale",
    "range_offset": "range offset",
}
"""Name of the error group of an instrument parameter, by the quantity of the data sheet from which its prior standard
deviation follows; the key None stands for a parameter without such a quantity."""
RANGE_NOISE_GROUP_NAME = "range noise"
"""Name of the error group that holds the noise of ranges."""
ANGLE_NOISE_GROUP_NAME = "angle noise"
"""Name of the error group that holds the noise of azimuths and elevations."""
REFERENCE_LENGTHS_GROUP_NAME = "gauge lengths"
"""Name of the error group with the errors of the reference lengths of the gauge (reflectors at known distances)."""
N_QUADRATURE_NODES = 48
"""Number of nodes of the quadrature for the expected length of a vector, which is accurate to about 1e-6."""
REFLECTORS_GROUP_NAME = "reflectors"
"""Name of the error group that holds the errors of reflectors, which depend on the angle of incidence."""


@dataclass(frozen=True)
class ExpectedDisagreement:
    """Expected mean disagreement of the stations in distances and coordinates [m], before and after calibration.

    The disagreements are the criteria of Sensors 2021, 21, 7479, eq. 11 and 12. Each field has the shape (k,), for k
    assumptions on the sizes of the errors.
    """

    distance_disagreement_before: Floats
    """Expected disagreement [m] of the stations in target distances before calibration, (k,) for k error sizes."""
    distance_disagreement_after: Floats
    """Expected disagreement [m] of the stations in target distances after calibration, (k,) for k error sizes."""
    coordinate_disagreement_before: Floats
    """Expected disagreement [m] of the stations in target coordinates before calibration, (k,) for k error sizes."""
    coordinate_disagreement_after: Floats
    """Expected disagreement [m] of the stations in target coordinates after calibration, (k,) for k error sizes."""

    @property
    def distance_improvement(self) -> Floats:
        """Relative reduction (k,) [%] of the disagreement in distances by calibration, for k sets of error sizes."""
        return 100.0 * (1.0 - self.distance_disagreement_after / self.distance_disagreement_before)

    @property
    def coordinate_improvement(self) -> Floats:
        """Relative reduction (k,) [%] of the disagreement in coordinates by calibration, for k sets of error sizes."""
        return 100.0 * (1.0 - self.coordinate_disagreement_after / self.coordinate_disagreement_before)


@dataclass(frozen=True)
class DisagreementPredictor:
    """Predictor of the disagreement of stations in a layout, from the variance that each group of errors contributes.

    A group is, for example, the noise of ranges; their number is G. The variances refer to errors of nominal size (one
    sigma) and add.
    """

    error_groups: tuple[str, ...]
    """Names of the G groups of errors: noise, gauge lengths, kinds of instrument parameters, unmodelled effects."""
    distance_variances: Floats
    """Variance of a measured distance minus its mean over stations, by each of G groups of errors, (2, G, D) [m^2]. The
    first index is 0 before and 1 after calibration; D counts the combinations of a station and a pair of targets."""
    coordinate_covariances: Floats
    """Covariance of the difference between the positions of a target from two stations, by each of G groups of errors,
    (2, G, C, 3, 3) [m^2]. The first index is 0 before and 1 after calibration; C counts the combinations of a pair of
    stations and a target."""

    @classmethod
    def from_expected_precision(
        cls, expected_precision: ExpectedPrecision, unmodelled_effects: Sequence[Effect] = ()
    ) -> DisagreementPredictor:
        """Predictor for a layout in which all stations see all targets, from its expected precision.

        The effects in `unmodelled_effects` act on the readings but are not estimated. Each is a separate group of
        errors, whose nominal size is the prior sigma of the effect.
        """
        ways, group = _unit_error_displacements(expected_precision, unmodelled_effects)
        names = tuple(dict.fromkeys(group))
        lengths, gaps = (
            _distance_deviation_matrix(expected_precision),
            _coordinate_difference_matrix(expected_precision),
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

    def expected_disagreement(self, group_sizes: Mapping[str, Floats | float] | None = None) -> ExpectedDisagreement:
        """Expected disagreement of the stations for k sets of error sizes.

        `group_sizes` holds, by name of the error group, factors (k,) on the nominal size of its errors; the default is
        1.
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
        coordinate = [_mean_expected_vector_length(square, spread) for spread in self.coordinate_covariances]
        return ExpectedDisagreement(distance[0], distance[1], coordinate[0], coordinate[1])


def _mean_expected_vector_length(variance_factors: Floats, group_covariances: Floats) -> Floats:
    """Mean (k,) of the expected lengths of C normally distributed vectors, for k sets of variance factors.

    The covariance of a vector is a sum over G groups of errors. `group_covariances` (G, C, 3, 3) holds the covariance
    by each group at nominal size, `variance_factors` (k, G) the factors on these covariances.
    """
    means = [
        expected_vector_length(np.asarray(np.linalg.eigvalsh(np.tensordot(part, group_covariances, axes=1)))).mean(
            axis=1
        )
        for part in np.array_split(variance_factors, max(1, len(variance_factors) // 64))
    ]
    return np.concatenate(means)


def expected_vector_length(variances: Floats) -> Floats:
    """Expected length (...) of normally distributed vectors with variances (..., 3) along their principal axes.

    With q the squared length of a vector, E sqrt(q) = 1 / (2 sqrt(pi)) integral of (1 - E
    exp(-t q)) t^(-3/2) dt over t > 0. E exp(-t q) is the product over the axes of (1 + 2 t variance)^(-1/2). The
    substitution t = (x / (1 - x))^2 / (total variance) maps t to x between 0 and 1; the integral over x is computed by
    Gauss-Legendre quadrature.
    """
    total_variance = np.maximum(variances.sum(axis=-1, keepdims=True), np.finfo(np.float64).tiny)
    variance_fractions = np.maximum(variances, 0.0) / total_variance
    at, weight = np.polynomial.legendre.leggauss(N_QUADRATURE_NODES)
    x, weight = 0.5 * (at + 1.0), 0.5 * weight
    root = x / (1.0 - x)
    product = np.ones((*variance_fractions.shape[:-1], N_QUADRATURE_NODES))
    for axis in range(3):
        product /= np.sqrt(1.0 + 2.0 * variance_fractions[..., axis, None] * root**2)
    mean_length: Floats = ((1.0 - product) / root**2 * (weight / (1.0 - x) ** 2)).sum(axis=-1) / np.sqrt(np.pi)
    return mean_length * np.sqrt(total_variance[..., 0])


def _unit_error_displacements(
    expected_precision: ExpectedPrecision, unmodelled_effects: Sequence[Effect]
) -> tuple[tuple[Floats, Floats], list[str]]:
    """Displacements of measured points by a one-sigma error of each of e error sources, and the group of each source.

    The displacements are two matrices (3 S T, e) [m], before and after calibration, for T targets measured from each of
    S stations. The groups are e names: noise, gauge lengths, kinds of parameters, unmodelled effects.
    """
    adjustment, construction = expected_precision.adjustment, expected_precision.construction
    problem, sightings = adjustment.problem, adjustment.sightings
    design = adjustment.solution.system.design
    count, lengths, params = (
        int(problem.is_used_reading.sum()),
        len(problem.gauge_rows),
        len(expected_precision.prior_sigma),
    )
    n_extra = problem.model.n_extra_parameters
    priors = design.shape[0] - problem.free_motions.shape[1] - params - n_extra
    averaging_matrix = _averaging_matrix(expected_precision)
    _, by_reading, by_value = construction.linearise(sightings.ideal_raw_readings, np.zeros(construction.n_parameters))
    noise = (
        np.einsum("rn,nij->rinj", averaging_matrix, by_reading).reshape(3 * len(averaging_matrix), -1)
        * problem.reading_sigmas.ravel()
    )
    parameters = -np.einsum("rn,nij->rij", averaging_matrix, by_value).reshape(3 * len(averaging_matrix), -1)
    places = np.concatenate([problem.unknowns.instrument_columns[0], problem.unknowns.effect_columns])
    columns = np.eye(problem.unknowns.n_columns)[:, places]
    answer = adjustment.factorised_normals.multiply_by_covariance(columns).T @ design.T
    by_extra = (noise / problem.reading_sigmas.ravel()) @ problem.model.extra_design(sightings).reshape(
        noise.shape[1], n_extra
    )
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
        expected_precision.prior_sigma, problem.effect_prior_sigmas
    )
    first_response[:, len(columns_used) :] = noise[:, is_used] @ errors[:count]
    second_response = first_response.copy()
    second_response[:, count + lengths : len(columns_used)] = 0.0
    second_response -= by_parameter @ np.hstack([answer[:, columns_used], answer @ errors])
    labels = (
        np.where(is_used % 3 == 0, RANGE_NOISE_GROUP_NAME, ANGLE_NOISE_GROUP_NAME).tolist()
        + [REFERENCE_LENGTHS_GROUP_NAME] * lengths
    )
    labels += [ERROR_GROUP_BY_SPECIFIED_QUANTITY[p.specified_quantity] for p in construction.parameters]
    labels += [REFLECTORS_GROUP_NAME] * n_extra
    return (first_response, second_response), labels + [e.name for e in unmodelled_effects for _ in e.parameters]


def _averaging_matrix(expected_precision: ExpectedPrecision) -> Floats:
    """Matrix (S T, n) that averages n pointings over faces and rounds, for each pair of S stations and T targets."""
    recording = expected_precision.adjustment.recording
    place = recording.station * len(recording.targets) + recording.target
    averaging_matrix = np.zeros((len(recording.stations) * len(recording.targets), len(recording)))
    averaging_matrix[place, np.arange(len(recording))] = 1.0
    return averaging_matrix / averaging_matrix.sum(axis=1, keepdims=True)


def _distance_deviation_matrix(expected_precision: ExpectedPrecision) -> Floats:
    """Matrix (D, 3 S T) from displacements of T points measured from S stations to deviations of D distances.

    There is one distance for each station and pair of targets; its deviation is the difference from the mean over
    stations.
    """
    state = expected_precision.adjustment.state
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


def _coordinate_difference_matrix(expected_precision: ExpectedPrecision) -> Floats:
    """Matrix (C, 3, 3 S T) from displacements of T points measured from S stations to coordinate differences.

    A difference is that between the positions of a target from two stations, which are first aligned by a rigid motion.
    C is the number of combinations of a pair of stations and a target.
    """
    state = expected_precision.adjustment.state
    stations, targets = len(state.station_positions), len(state.target_points)
    motion = rigid_motion_jacobian(state.target_points, state.target_points.mean(axis=0))
    non_rigid_projector = np.eye(3 * targets) - motion @ np.linalg.pinv(motion)
    turned = np.einsum("ctl,sli->scti", non_rigid_projector.reshape(3 * targets, targets, 3), state.station_rotations)
    turned = turned.reshape(stations, targets, 3, 3 * targets)
    matrix_rows = []
    for m, n in combinations(range(stations), 2):
        gap = np.zeros((targets, 3, stations, 3 * targets))
        gap[:, :, m], gap[:, :, n] = turned[m], -turned[n]
        matrix_rows.append(gap.reshape(targets, 3, -1))
    return np.concatenate(matrix_rows)
