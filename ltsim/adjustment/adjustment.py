"""Result of a network adjustment: estimates, covariance, tests and warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special

from ltsim.adjustment.datum import InnerConstraintDatum
from ltsim.adjustment.frame import are_collinear
from ltsim.adjustment.prior import ParameterPrior
from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.reference_tests import ReferenceTest, reference_tests_with_instrument_constants
from ltsim.adjustment.reliability import (
    detect_noisy_targets,
    iterative_snooping,
    normalise_residuals,
    p_value_of_tau,
    redundancy_numbers,
)
from ltsim.adjustment.significance import FAMILY_WISE_LEVEL, MIN_DOF_FOR_ESTIMATED_NOISE
from ltsim.adjustment.snooping import drop_undetermined_targets, pose_defect_sentence
from ltsim.adjustment.stochastic_model import VarianceComponent
from ltsim.adjustment.undetermined_points import undetermined_points_sentence
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.core.parallel import single_threaded
from ltsim.core.results import Result
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.physics.model.construction import GeometricErrorModel, ideal_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.recording import Recording
from ltsim.scene.sightings import Sightings
from ltsim.solve.design import to_dense
from ltsim.solve.elimination import FactorisedNormals, SingularSystemError
from ltsim.solve.gauss_newton import Solution, solution_for_plan, solve

MAX_SUCCESSIVELY_TESTED_READINGS = 300
"""Largest number of suspected readings that are removed one after another. If more readings are suspected, each is
tested as if it were the only outlier."""


@dataclass(frozen=True)
class FlaggedReading:
    """Reading rejected by the w-test (Baarda 1968) or the tau-test (Pope 1976)."""

    pointing_index: int
    """Index of the pointing in the recording, from 0."""
    observable_column: int
    """Index of the observable: 0 range, 1 azimuth, 2 elevation."""
    estimated_error: float
    """Estimated gross error of the reading: [m] for a range, [rad] for an angle."""
    normalised_residual: float
    """Normalised residual, the statistic of the w-test."""
    p_value: float
    """Probability that the largest test statistic of a recording without gross errors exceeds that of this reading."""


@dataclass(frozen=True, repr=False)
class Adjustment(Result):
    """Adjusted network: estimates, covariances, tests and warnings."""

    problem: NetworkProblem
    """Least-squares problem that was solved."""
    solution: Solution[NetworkState]
    """Solution of the problem: adjusted unknowns, factorised normal equations and convergence status."""
    is_gross_pointing: Bools
    """Flags (n,), True for those of the n pointings that were rejected as gross errors before the adjustment."""
    variance_components: tuple[VarianceComponent, ...] = ()
    """Estimated noise of groups of readings, part of `problem.reading_sigmas`; empty if no estimate was requested."""
    unconnected_targets: tuple[str, ...] = ()
    """Names of targets that are not connected to the network and not adjusted; their coordinates are arbitrary."""
    rejected_references: tuple[ReferenceTest, ...] = ()
    """Tests of reference values (known points, lengths, levels) that contradict other observations and were removed."""
    axes_point_tests: tuple[ReferenceTest, ...] = ()
    """Tests of declared coordinates that only define the axes (datum) of the network, including those excluded."""
    n_duplicate_rows: int = 0
    """Number of pointings that are exact copies of another pointing and are not used."""
    cause_sentences: tuple[str, ...] = ()
    """Sentences on identified errors that the model contains and that explain the misfit."""
    noise_sentences: tuple[str, ...] = ()
    """Sentences on noise that is larger than declared and explains the misfit; the weights do not contain it."""
    datum: InnerConstraintDatum | None = None
    """Datum of the covariances by inner constraints; None if the pose of the first station, or constraints, define the
    datum."""

    def _summary_lines(self) -> list[str]:
        """Lines of the summary that `print` shows."""
        return [
            f"Adjustment: {self.recording.headline}",
            f"{self.construction.name}, {self.construction.n_parameters} instrument parameters, "
            f"{len(self.effects)} further effects; {self.solution.status.value}",
            f"chi2/dof {self.chi2:.1f}/{self.dof}, sigma0 {self.sigma0:.3f}; "
            f"{int(self.is_rejected_reading.sum())} readings left out",
        ]

    @classmethod
    def from_plan(
        cls,
        recording: Recording,
        state: NetworkState,
        construction: GeometricErrorModel | None = None,
        effects: Sequence[LinearEffect] = (),
        prior: ParameterPrior | None = None,
    ) -> Adjustment:
        """Adjustment of planned pointings at the planned `state`, for the precision of a plan.

        The values of the readings in `recording` have no influence, only which observables are measured. `state`
        contains planned poses and targets, and instrument parameters. The parameters of `construction` (default: an
        ideal tracker) and `effects` are unknowns; `prior` is the prior of the instrument parameters, by default that in
        `setup.toml`. Raises NetworkError if the pointings do not determine all poses and targets.
        """
        model = MeasurementModel(recording, construction or ideal_construction(), tuple(effects))
        if len(state.extra_parameters) != model.n_extra_parameters:
            state = replace(state, extra_parameters=np.zeros(model.n_extra_parameters))
        problem = drop_undetermined_targets(NetworkProblem.from_model(model, prior=prior), state)
        defect = pose_defect_sentence(problem, state)
        if defect:
            raise NetworkError(defect)
        try:
            solution = solution_for_plan(problem, state)
        except SingularSystemError:
            message = "the pointings do not determine all poses and targets; plan more common targets of the stations"
            if not recording.is_measured[:, 1:].any():
                message = "ranges alone need four stations that are not in one plane and six targets, or known lengths"
            raise NetworkError(message) from None
        return cls(problem, solution, np.zeros(len(recording), dtype=bool))

    @property
    def recording(self) -> Recording:
        """Recording that was adjusted, without excluded reference values."""
        return self.problem.model.recording

    @property
    def construction(self) -> GeometricErrorModel:
        """Geometric error model of the instrument, whose parameters were estimated."""
        return self.problem.model.construction

    @property
    def effects(self) -> tuple[LinearEffect, ...]:
        """Effects (such as drifts) whose parameters were estimated in addition to the instrument parameters."""
        return self.problem.model.effects

    @property
    def state(self) -> NetworkState:
        """Adjusted poses, target coordinates, instrument parameters and parameters of effects."""
        return self.solution.x

    @property
    def chi2(self) -> float:
        """Chi-square: weighted sum of squared residuals of readings, reference values and priors."""
        return self.solution.sum_of_squares

    @property
    def dof(self) -> int:
        """Degrees of freedom: number of observations and priors minus number of unknowns."""
        return self.problem.dof

    @property
    def sigma0(self) -> float:
        """Standard deviation of unit weight, sqrt(chi2 / dof); NaN without redundancy."""
        return float(np.sqrt(self.chi2 / self.dof)) if self.dof > 0 else float("nan")

    @property
    def p_value(self) -> float:
        """p-value of the global test: probability of a larger chi2 if model and declared noise are correct."""
        return float(special.chdtrc(self.dof, self.chi2)) if self.dof > 0 else float("nan")

    def require_solution(self) -> None:
        """Check that the adjustment converged; raises NetworkError with the cause, or ConvergenceError without one."""
        why = "" if self.solution.has_converged else self._missing_solution_sentence()
        if why:
            raise NetworkError(f"the adjustment did not converge; {why}")
        self.solution.require_success()

    def _missing_solution_sentence(self) -> str:
        """Sentence on why there is no solution (no scale, or collinear common targets); empty for other causes."""
        recording, problem = self.recording, self.problem
        held = problem.control_rows.is_declared_coordinate[:, :2].all(axis=1).sum() + len(problem.control_rows_of_marks)
        lengths = problem.is_used_reading[:, 0].any() or len(problem.gauge_rows)
        if held < 2 and not lengths and not problem.difference_rows.is_declared_coordinate[:, :2].any():
            cure = "declare approximate_mm of two datum targets in setup.toml"
            return f"the scale of the network is undetermined: no distance, known length or two known points; {cure}"
        shared = np.zeros((len(recording.stations), len(recording.targets)), dtype=bool)
        shared[recording.station, recording.target] = True
        shared[problem.level_rows.station_indices] = False  # collinear targets determine an upright station
        for name, station_targets in zip(recording.stations, shared & (shared.sum(axis=0) > 1), strict=True):
            if station_targets.sum() > 2 and are_collinear(self.state.target_points[station_targets]):
                which = f"the {station_targets.sum()} targets that it shares with other stations"
                return f"station {name}: {which} lie on or near one line; add a common target off this line"
        return undetermined_points_sentence(problem, self.solution)

    @property
    def factorised_normals(self) -> FactorisedNormals:
        """Factorised normal equations at the solution; raises NetworkError or ConvergenceError without a solution."""
        self.require_solution()
        assert self.solution.factor is not None
        return self.solution.factor

    @cached_property
    def sightings(self) -> Sightings:
        """Range, direction and covariates (such as time) of each pointing, computed from the adjusted network."""
        return self.problem.model.sightings(self.state)

    @cached_property
    def residuals(self) -> Floats:
        """Observed minus adjusted readings (n, 3) [m, rad, rad] of n pointings; NaN if not measured."""
        return self.problem.reading_residuals(self.problem.model.predict(self.state))

    @cached_property
    def redundancy(self) -> Floats:
        """Redundancy numbers (n, 3) of the readings of n pointings, 0 (no check) to 1; NaN for unused readings."""
        return redundancy_numbers(self.problem, self.factorised_normals)

    @cached_property
    def normalised_residuals(self) -> Floats:
        """Residuals (n, 3) of n pointings divided by their standard deviations; standard normal if the model holds."""
        return normalise_residuals(self.problem, self.residuals, self.redundancy)

    @cached_property
    def noisy_targets_and_scatter(self) -> tuple[Ints, float, float]:
        """Indices (k,) of k noisy targets, scatter of the readings to these targets, and scatter of all other readings.

        A scatter is the ratio of observed to declared standard deviation; at noisy targets it is much larger.
        """
        return detect_noisy_targets(self.normalised_residuals, self.redundancy, self.recording.target)

    @cached_property
    def reference_tests(self) -> tuple[ReferenceTest, ...]:
        """Tests of all reference values, each against the other observations; excluded reference values come first."""
        tests = reference_tests_with_instrument_constants(self.problem, self.solution)
        return (*self.rejected_references, *tests, *self.axes_point_tests)

    @property
    def undetermined_targets(self) -> tuple[str, ...]:
        """Names of measured targets whose coordinates the readings in use do not determine; they are not adjusted."""
        targets = self.recording.targets
        measured = np.bincount(self.recording.target, self.recording.is_measured.any(axis=1), len(targets)) > 0
        is_unmeasured = self.problem.undetermined_unknowns.is_unmeasured_target & measured
        return tuple(targets[i] for i in np.flatnonzero(is_unmeasured))

    @property
    def undetermined_stations(self) -> tuple[str, ...]:
        """Names of stations with a partly undetermined pose; its undetermined components keep their start values."""
        held = self.problem.undetermined_unknowns.fixed_pose_components.any(axis=1)
        return tuple(self.recording.stations[s] for s in np.flatnonzero(held))

    @cached_property
    def is_rejected_reading(self) -> Bools:
        """Flags (n, 3), True for the readings of n pointings that were rejected as outliers."""
        problem = replace(self.problem, is_used_reading=self.recording.is_usable_reading)
        return drop_undetermined_targets(problem, self.state).is_used_reading & ~self.problem.is_used_reading

    def flagged_readings(
        self, alpha: float = FAMILY_WISE_LEVEL, *, uses_estimated_noise: bool = False
    ) -> list[FlaggedReading]:
        """Outliers among the readings in use, the most significant first.

        `alpha` is the false-alarm rate for the whole recording. Outliers are detected one after another, because an
        outlier also changes residuals of correct readings. Readings that no test distinguishes from an outlier follow
        this outlier in the list. The test uses the declared noise (w-test). With `uses_estimated_noise` it uses the
        noise estimated from the residuals (tau-test), of each target separately if some targets are noisy.
        """
        use, target = self.problem.is_used_reading, self.recording.target
        count = int(use.sum())
        whitened = np.where(use, self.residuals / self.problem.reading_sigmas, 0.0)
        scale = np.full(use.shape, self.sigma0 if uses_estimated_noise else 1.0)
        dof = np.full(use.shape, float(self.dof) if uses_estimated_noise else np.inf)
        if uses_estimated_noise and len(self.noisy_targets_and_scatter[0]):
            checks = np.bincount(target, np.nansum(self.redundancy, axis=1))
            group = np.where(checks >= MIN_DOF_FOR_ESTIMATED_NOISE, np.arange(len(checks)), -1)[target]
            for rows_of_group in (group == number for number in np.unique(group)):
                dof[rows_of_group] = np.nansum(self.redundancy[rows_of_group])
                scale[rows_of_group] = np.linalg.norm(whitened[rows_of_group]) / np.sqrt(dof[rows_of_group])
        tau = np.nan_to_num(np.abs(self.normalised_residuals)) / np.where(
            scale > 0.0, scale, 1.0
        )  # the scale is 0 in an exact fit
        flagged = use & (p_value_of_tau(tau, dof, count) < alpha)
        rows, columns = np.nonzero(flagged)
        unit, place = self.problem.reading_sigmas[flagged], list(zip(rows.tolist(), columns.tolist(), strict=True))
        block = self._redundancy_block(rows, columns)
        outliers = iterative_snooping(whitened[flagged], block, scale[flagged], dof[flagged], count, alpha)
        return [FlaggedReading(*place[k], float(error * unit[k]), w, p_value) for k, error, w, p_value in outliers]

    def _redundancy_block(self, pointing_indices: Ints, columns: Ints) -> Floats:
        """Block (k, k) of the redundancy matrix for k readings: pointings `pointing_indices`, observables `columns`.

        Element (i, j) is the change of residual i by an error of reading j, in standard deviations. For more than
        `MAX_SUCCESSIVELY_TESTED_READINGS` readings only the diagonal is computed.
        """
        use = self.problem.is_used_reading
        if len(pointing_indices) > MAX_SUCCESSIVELY_TESTED_READINGS:
            return np.diag(self.redundancy[pointing_indices, columns])
        residual_rows = (np.cumsum(use) - 1).reshape(use.shape)[pointing_indices, columns]
        design = to_dense(self.solution.system.design[residual_rows])
        response = self.factorised_normals.multiply_by_covariance(np.ascontiguousarray(design.T))
        return np.asarray(np.eye(len(residual_rows)) - design @ response)

    def covariance_submatrices(self, columns: Ints) -> Floats:
        """Covariances (c, k, k) of c sets of k unknowns, given by their indices in the design matrix, `columns` (c, k).

        Coordinates of targets that are eliminated from the normal equations are not permitted.
        """
        covariance = self.factorised_normals.covariance_submatrices(columns)
        return covariance if self.datum is None else self.datum.transform_covariance(covariance, columns)

    @cached_property
    def retained_covariance(self) -> Floats:
        """Covariance (K, K) of the K unknowns that the solver does not eliminate: poses, some targets, parameters."""
        covariance = self.factorised_normals.retained_covariance()
        if self.datum is None:
            return covariance
        return self.datum.transform_covariance(covariance[None], np.arange(len(covariance))[None])[0]

    @property
    def first_instrument_covariance(self) -> Floats:
        """Covariance (p, p) [SI] of the p estimated parameters of the first instrument."""
        return self.instrument_covariance_of(0)

    def instrument_covariance_of(self, instrument: int) -> Floats:
        """Covariance (p, p) [SI] of the p parameters of the instrument with the index `instrument`."""
        return self.covariance_submatrices(self.problem.unknowns.instrument_columns[[instrument]])[0]

    @cached_property
    def covariance_of_all_instruments(self) -> Floats:
        """Covariance (I p, I p) [SI] of the p parameters of each of I instruments, instrument by instrument."""
        return self.covariance_submatrices(self.problem.unknowns.instrument_columns.reshape(1, -1))[0]

    @property
    def effect_covariance(self) -> Floats:
        """Covariance (q, q) of the q parameters of all additional effects [SI]."""
        return self.covariance_submatrices(self.problem.unknowns.effect_columns[None])[0]

    @property
    def pose_covariance(self) -> Floats:
        """Covariances (S, 6, 6) of position [m] and rotation vector [rad] of each of S stations, in the network frame.

        Components that the readings do not determine have NaN, components that define the frame have 0.
        """
        covariance = self.covariance_submatrices(self.problem.unknowns.pose_columns)
        anchors = self.problem.undetermined_unknowns.datum_stations
        if self.datum is None and len(anchors) == 1:  # without the variance of the numerical constraints of the datum
            directions = self.problem.free_motions_at_datum_stations(self.state)
            variable = np.round(np.eye(6) - np.linalg.pinv(directions) @ directions, 12)
            covariance[anchors] = variable @ covariance[anchors] @ variable
        held = self.problem.undetermined_unknowns.fixed_pose_components
        covariance[held[:, :, None] | held[:, None, :]] = np.nan
        over = self.problem.marks.target_indices
        flat = np.flatnonzero((over >= 0) & self.is_height_undetermined_target[over])
        covariance[flat, 2] = covariance[flat, :, 2] = np.nan
        return covariance

    @cached_property
    def target_covariances(self) -> Floats:
        """Covariances (T, 3, 3) [m^2] of the coordinates of T targets; NaN for undetermined targets and heights."""
        unknowns = self.problem.unknowns
        covariance = np.empty((len(unknowns.target_columns), 3, 3))
        is_retained = unknowns.target_columns[:, 0] < unknowns.n_retained
        covariance[is_retained] = self.factorised_normals.covariance_submatrices(unknowns.target_columns[is_retained])
        blocks = self.factorised_normals.eliminated_covariances()
        covariance[~is_retained] = blocks[(unknowns.target_columns[~is_retained][:, 0] - unknowns.n_retained) // 3]
        if self.datum is not None:
            covariance = self.datum.transform_covariance(covariance, unknowns.target_columns)
            diagonal = np.arange(3)  # a coordinate fixed by the datum has variance 0, up to rounding
            covariance[:, diagonal, diagonal] = np.maximum(covariance[:, diagonal, diagonal], 0.0)
        covariance[self.problem.undetermined_unknowns.is_unmeasured_target] = np.nan
        flat = self.is_height_undetermined_target
        covariance[flat, 2] = covariance[flat, :, 2] = np.nan
        return covariance

    @cached_property
    def is_height_undetermined_target(self) -> Bools:
        """Flags (T,), True for those of the T targets whose height no observation determines."""
        plan = [self.recording.target_setup(name).plan_only for name in self.recording.targets]
        return np.asarray(self.problem.undetermined_unknowns.is_height_undetermined_target | np.array(plan, dtype=bool))

    @single_threaded
    def with_effects(self, effects: Sequence[LinearEffect], start_state: NetworkState) -> Adjustment:
        """New adjustment of the same readings and weights with other `effects`, iterated from `start_state`."""
        old, model = self.problem, replace(self.problem.model, effects=tuple(effects))
        use = old.is_used_reading
        new_problem = NetworkProblem.from_model(model, sigma=old.reading_sigmas, reading_mask=use, prior=old.prior)
        problem = replace(new_problem, gauge_rows=old.gauge_rows, difference_rows=old.difference_rows)
        problem = replace(problem, level_rows=old.level_rows, yaw_rows=old.yaw_rows)
        solution = solve(problem, replace(start_state, extra_parameters=np.zeros(model.n_extra_parameters)))
        return replace(self, problem=problem, solution=solution, datum=None)

    def with_inner_datum(self, datum_names: Sequence[str] | None = None) -> Adjustment:
        """Copy of the adjustment, with covariances in the datum of inner constraints over the targets `datum_names`.

        By default all determined targets define the datum. Raises ModelError for an unknown target, and for targets
        that do not fix the rigid motions which no observation determines.
        """
        every = [name for name in self.recording.targets if name not in self.undetermined_targets]
        datum_names = every if datum_names is None else datum_names
        datum = InnerConstraintDatum.from_points(self.problem, self.state, self.factorised_normals, datum_names)
        return replace(self, datum=datum)
