"""Robust fit of a network with hypotheses on its errors in the model, and log evidence of the fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.identification.equal_displacements import CommonDisplacementLength, common_displacement_length
from ltsim.adjustment.identification.evidence import (
    estimate_noise_factors,
    log_occam_factor_of_centring,
    log_occam_factor_of_shift,
    log_occam_factor_of_variance,
    log_prior_of_kind,
)
from ltsim.adjustment.identification.hypothesis import (
    CauseHypothesis,
    CentringChange,
    NoiseFactorChange,
    ReadingShiftChange,
    ReferenceOmission,
    includes_changed_noise,
)
from ltsim.adjustment.identification.model_changes import (
    apply_corrections_and_omissions,
    hypothesis_with_centring_sigma,
    solve_without_outliers,
    start_parameter_values,
    subtract_shifts,
)
from ltsim.adjustment.identification.resection import resect_contradicted_setups
from ltsim.adjustment.prior import ParameterPrior
from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.reference_values import (
    ReferenceValue,
    ReferenceValueRows,
    common_scale_reference,
    reference_values,
    with_nonzero_reference_sigmas,
)
from ltsim.adjustment.significance import MAX_CHANCE_SIGMAS, MAX_TRACKER_ERROR, MIN_SIGMAS_BEYOND_NOISE
from ltsim.adjustment.snooping import drop_undetermined_targets, prediction_error_sigmas, snoop_readings
from ltsim.adjustment.start import initial_network
from ltsim.adjustment.stochastic_model import fit_robust_state
from ltsim.core.arrays import Bools, Floats
from ltsim.core.units import ARCSECOND, MILLIMETRE
from ltsim.geometry.polar import wrap_angle
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.physics.model.measurement import MeasurementModel, NetworkState, with_spherical_earth_plumb_lines
from ltsim.recordings.occupations import target_occupations
from ltsim.recordings.recording import SIGMA_COLUMNS, Recording
from ltsim.scene.sightings import Sightings
from ltsim.solve.design import robust_sigma
from ltsim.solve.gauss_newton import MAX_DECISION_CHANGES, Solution, solve

MAX_NOISE_ITERATIONS = 3
"""Largest number of iterations for noise factors, or standard deviations of centring errors, in one network fit."""
NOISE_FACTOR_TOLERANCE = 0.05
"""Relative change of noise factors at which their iteration ends; such a change alters the log evidence by 0.1."""
MIN_NOISE_CHANGE_FOR_OUTLIER_SEARCH = 0.2
"""Limit of the relative change of noise factors. After a larger change, outliers are searched again."""
WEAK_SHIFT_PRIOR_FACTOR = 1e6
"""Standard deviation of the prior of a shift of readings, divided by its plausible size: practically no prior."""


@dataclass(frozen=True)
class FitInput:
    """Input of a network fit: the recording and the geometric error model of its trackers."""

    recording: Recording
    """Recording as it was read from its file."""
    construction: GeometricErrorModel
    """Geometric error model of the tracker, whose parameters are estimated."""
    prior: ParameterPrior | None = None
    """Prior of the instrument parameters; None for that of `setup.toml`."""
    is_usable_reading: Bools | None = None
    """Flags (n, 3), True for those readings of n pointings that a fit may use; None for all."""


@dataclass(frozen=True)
class NetworkFit:
    """Network fitted with some hypotheses in its model; readings that contradict the model are rejected as outliers."""

    fit_input: FitInput
    """Recording, geometric error model and prior of the fit."""
    hypotheses: tuple[CauseHypothesis, ...]
    """Hypotheses on errors that the model of the fit contains."""
    problem_with_all_readings: NetworkProblem
    """Least-squares problem of the fit with all usable readings, also outliers."""
    problem: NetworkProblem
    """Least-squares problem of the fit without the outliers."""
    solution: Solution[NetworkState]
    """Solution of `problem`."""

    @classmethod
    def references_with_large_residuals(
        cls, fit_input: FitInput, hypotheses: Sequence[CauseHypothesis]
    ) -> tuple[list[ReferenceValueRows], int, NetworkState]:
        """Reference values with large residuals in a robust fit, number of all reference values, and state of the fit.

        Large residuals exceed `MIN_SIGMAS_BEYOND_NOISE` robust standard deviations; such a value distorts the network.
        """
        problem, start = cls._make_problem(fit_input, hypotheses)
        relaxed_problem = with_nonzero_reference_sigmas(problem, start)
        state, residual = fit_robust_state(relaxed_problem, resect_contradicted_setups(relaxed_problem, start))
        limit = MIN_SIGMAS_BEYOND_NOISE * max(robust_sigma(residual[: int(problem.is_used_reading.sum())]), 1.0)
        references = [v for v in reference_values(problem, state) if v.kind != "mark"]
        large = [v for v in references if float(np.abs(residual[v.equation_indices]).max()) > limit]
        return large, len(references), state

    @classmethod
    def from_start(
        cls,
        fit_input: FitInput,
        hypotheses: Sequence[CauseHypothesis] = (),
        start_state: NetworkState | None = None,
        approximate_sightings: Sightings | None = None,
        robust_state: NetworkState | None = None,
    ) -> NetworkFit | None:
        """Network fit that also estimates the shifts of `hypotheses`; None without convergence or significant shifts.

        The fit starts at `start_state`, by default at `robust_state` (the state of a robust fit, which is computed if
        None). With `approximate_sightings` (approximate ranges and directions of the pointings) the start values of the
        shifts are subtracted from the readings before the fit.
        """
        fit = cls._with_hypotheses(fit_input, tuple(hypotheses), start_state, approximate_sightings, robust_state)
        for _ in range(MAX_NOISE_ITERATIONS):
            revised = tuple(hypothesis_with_centring_sigma(h, fit.estimate_and_covariance) for h in fit.hypotheses)
            if revised == fit.hypotheses or not fit.solution.has_converged:
                break
            fit = cls._with_hypotheses(fit_input, revised, fit.state)
        return fit if fit.solution.has_converged and fit._determines_shifts else None

    @classmethod
    def _with_hypotheses(
        cls,
        fit_input: FitInput,
        hypotheses: tuple[CauseHypothesis, ...],
        start_state: NetworkState | None,
        approximate_sightings: Sightings | None = None,
        robust_state: NetworkState | None = None,
    ) -> NetworkFit:
        """Fit as by `from_start`, but with the standard deviations of centring errors fixed as in the hypotheses."""
        is_first = start_state is None
        problem, start_state = cls._make_problem(fit_input, hypotheses, start_state, approximate_sightings)
        if is_first:
            start = robust_state or fit_robust_state(problem, resect_contradicted_setups(problem, start_state))[0]
            start_state = resect_contradicted_setups(problem, start)
        full_problem = drop_undetermined_targets(problem, start_state)
        fit = cls(fit_input, hypotheses, full_problem, *solve_without_outliers(full_problem, start_state, hypotheses))
        if includes_changed_noise(hypotheses):
            fit = fit._with_estimated_noise()
        return fit

    @property
    def _determines_shifts(self) -> bool:
        """True if every estimated shift of readings exceeds `MAX_CHANCE_SIGMAS` of its standard deviations."""
        return all(self.estimate_length_in_sigmas(h) > MAX_CHANCE_SIGMAS for h, _, _ in self.shifts_with_slices)

    @property
    def shifts_with_slices(self) -> Iterator[tuple[CauseHypothesis, ReadingShiftChange, slice]]:
        """Hypotheses that shift readings, each with its change of the model and the slice of its parameters."""
        start = 0
        for h in self.hypotheses:
            if isinstance(h.model_change, ReadingShiftChange):
                yield h, h.model_change, slice(start, start := start + len(h.model_change.effect.parameters))

    def estimate_and_covariance(self, hypothesis: CauseHypothesis) -> tuple[Floats, Floats]:
        """Estimate (p,) and covariance (p, p) [SI] of the p parameters of a shift of readings or of centring errors."""
        centrings = [h for h in self.hypotheses if isinstance(h.model_change, CentringChange)]
        slices = [(h, at) for h, _, at in self.shifts_with_slices]
        slices += zip(reversed(centrings), reversed(self.problem.model.centring_parameter_slices), strict=False)
        at = next(at for h, at in slices if h is hypothesis)
        return self.state.extra_parameters[at], self.adjustment.effect_covariance[at, at]

    def common_displacement_length(self, hypothesis: CauseHypothesis) -> CommonDisplacementLength | None:
        """Common length of displacements by a hypothesis of centring errors at one set-up; None for unequal lengths."""
        change = hypothesis.model_change
        if not isinstance(change, CentringChange) or len(hypothesis.stations) != 1:
            return None
        displacements = self.estimate_and_covariance(hypothesis)[0].reshape(-1, 3)
        first_rows = np.unique(target_occupations(self.recording, change.centring_uncertainty), return_index=True)[1]
        sight_vectors = self.adjustment.sightings.sight_vectors[first_rows[-len(displacements) :]]
        return common_displacement_length(displacements, sight_vectors)

    def estimate_length_in_sigmas(self, hypothesis: CauseHypothesis) -> float:
        """Length of the estimate of a shift or of centring errors in its standard deviations (Mahalanobis distance)."""
        values, covariance = self.estimate_and_covariance(hypothesis)
        return float(np.sqrt(max(float(values @ np.linalg.pinv(covariance) @ values), 0.0)))

    @staticmethod
    def _make_problem(
        fit_input: FitInput,
        hypotheses: Sequence[CauseHypothesis],
        start_state: NetworkState | None = None,
        approximate_sightings: Sightings | None = None,
    ) -> tuple[NetworkProblem, NetworkState]:
        """Least-squares problem with all usable readings, and its start state; arguments as for `from_start`."""
        recording = apply_corrections_and_omissions(fit_input.recording, hypotheses)
        lost = np.zeros(len(recording.targets), dtype=bool)
        if start_state is None:
            reached, lost = initial_network(
                recording
                if approximate_sightings is None
                else subtract_shifts(recording, hypotheses, approximate_sightings)
            )
            recording = recording.with_readings(np.where(lost[recording.target][:, None], np.nan, recording.readings))
            parameters = np.zeros((len(recording.instruments), fit_input.construction.n_parameters))
            start_state = NetworkState(*reached, parameters if fit_input.prior is None else fit_input.prior.mean)
        recording = with_spherical_earth_plumb_lines(recording, start_state.station_positions)
        effects = tuple(h.model_change.effect for h in hypotheses if isinstance(h.model_change, ReadingShiftChange))
        model = MeasurementModel(recording, fit_input.construction, effects)
        if len(start_state.extra_parameters) != model.n_extra_parameters:
            start_state = replace(
                start_state,
                extra_parameters=start_parameter_values(hypotheses, model.n_extra_parameters, approximate_sightings),
            )
        usable = np.ones((len(recording), 3), dtype=bool) if (mask := fit_input.is_usable_reading) is None else mask
        sigma = recording.reading_sigmas()
        for h in hypotheses:
            if isinstance(h.model_change, NoiseFactorChange):
                sigma = np.where(h.model_change.reading_mask, sigma * h.model_change.start_factor, sigma)
        problem = NetworkProblem.from_model(
            model,
            sigma=sigma,
            reading_mask=usable & ~lost[recording.target][:, None],
            effect_prior_sigma=WEAK_SHIFT_PRIOR_FACTOR,
            prior=fit_input.prior,
        )
        positions = problem.marks.positions_on_marks(start_state.station_positions, start_state.target_points)
        return problem, replace(start_state, station_positions=positions)

    def _with_estimated_noise(self) -> NetworkFit:
        """Fit whose noise factors are estimated from the residuals (restricted maximum likelihood)."""
        fit = self
        for _ in range(MAX_NOISE_ITERATIONS):
            sigma = fit._estimated_sigmas()
            changed = float(np.nanmax(np.abs(np.log(sigma / fit.problem_with_all_readings.reading_sigmas))))
            if not changed > NOISE_FACTOR_TOLERANCE:
                break
            whole = replace(fit.problem_with_all_readings, reading_sigmas=sigma)
            problem = replace(fit.problem, reading_sigmas=sigma)
            solution = solve(problem, fit.state)
            if solution.factor is None or changed > MIN_NOISE_CHANGE_FOR_OUTLIER_SEARCH:
                problem, solution = snoop_readings(whole, fit.state, MAX_DECISION_CHANGES)
            fit = replace(fit, problem_with_all_readings=whole, problem=problem, solution=solution)
        return fit

    def _estimated_sigmas(self) -> Floats:
        """Standard deviations (n, 3) [m, rad, rad] of n pointings: declared ones times estimated noise factors."""
        declared, is_used = self.fit_input.recording.reading_sigmas(), self.problem.is_used_reading
        squares = np.where(is_used, self.residuals / declared, 0.0) ** 2
        masks = [h.model_change.reading_mask for h in self.hypotheses if isinstance(h.model_change, NoiseFactorChange)]
        return declared * estimate_noise_factors(squares, np.where(is_used, np.nan_to_num(self.redundancy), 0.0), masks)

    def residuals_of_recording(self, recording: Recording) -> Floats:
        """Residuals (n, 3) [m, rad, rad] of another recording of the same n pointings, from predictions by this fit."""
        gap = recording.readings - self.problem.model.predict(self.state)
        gap[:, 1:] = wrap_angle(gap[:, 1:])
        return gap

    @property
    def state(self) -> NetworkState:
        """Adjusted poses, targets and parameters."""
        return self.solution.x

    @cached_property
    def adjustment(self) -> Adjustment:
        """Fit as an `Adjustment`, with its tests and covariances."""
        out = self.recording.is_measured.any(axis=1) & ~self.problem.is_used_reading.any(axis=1)
        return Adjustment(self.problem, self.solution, np.asarray(out))

    @property
    def recording(self) -> Recording:
        """Recording with corrected pointings and without excluded reference values, according to the hypotheses."""
        return self.problem.model.recording

    @property
    def effects(self) -> tuple[LinearEffect, ...]:
        """Effects of the shifts in the model, each with a plausible size at least as large as its estimate."""
        effects = list[LinearEffect]()
        for _, shift, at in self.shifts_with_slices:
            times = float(np.max(np.abs(self.state.extra_parameters[at]) / shift.effect.plausible_sizes))
            effects.append(replace(shift.effect, plausible_size_factor=max(1.0, times)))  # type: ignore[type-var]
        return tuple(effects)

    def correct_recording(self, recording: Recording, keeps_outliers: bool = False) -> Recording:
        """Copy of `recording`, corrected for the hypotheses; outliers are deleted unless `keeps_outliers` is True.

        Wrongly recorded pointings are corrected, shifts are subtracted, the declared noise is multiplied by the
        estimated noise factors, and excluded reference values are removed.
        """
        readings = self.recording.readings.copy()
        for _, shift, at in self.shifts_with_slices:
            readings -= shift.effect.reading_change(self.adjustment.sightings, self.state.extra_parameters[at])
        if not keeps_outliers:
            readings[self.is_outlier] = np.nan
        corrected_recording = recording.replace(
            readings=readings, target=self.recording.target, face=self.recording.face, setup=self.recording.setup
        )
        if not includes_changed_noise(self.hypotheses):
            return corrected_recording
        sigma = self.problem.reading_sigmas / [MILLIMETRE, ARCSECOND, ARCSECOND]
        columns = dict(zip(SIGMA_COLUMNS, sigma.T, strict=True))
        return corrected_recording.replace(covariates={**corrected_recording.covariates, **columns})

    @cached_property
    def residuals(self) -> Floats:
        """Observed minus predicted readings (n, 3) [m, rad, rad] of n pointings, including outliers."""
        return self.problem.reading_residuals(self.problem.model.predict(self.state))

    @cached_property
    def whitened_residuals(self) -> Floats:
        """Residuals (n, 3) of n pointings divided by the standard deviations of readings; 0 for unusable readings."""
        whitened = np.nan_to_num(self.residuals / self.problem.reading_sigmas)
        return np.where(self.problem_with_all_readings.is_used_reading, whitened, 0.0)

    @property
    def redundancy(self) -> Floats:
        """Redundancy numbers (n, 3) of the readings of n pointings; NaN for unused readings."""
        return self.adjustment.redundancy

    @cached_property
    def is_outlier(self) -> Bools:
        """Flags (n, 3), True for those usable readings of n pointings that are rejected."""
        return self.problem_with_all_readings.is_used_reading & ~self.problem.is_used_reading

    @cached_property
    def outlier_prediction_error_sigmas(self) -> Floats:
        """Standard deviations (n, 3) of the prediction errors of rejected readings of n pointings; 1 for used readings.

        The unit is the declared standard deviation of the reading.
        """
        is_outlier, spread = self.is_outlier, np.ones(self.is_outlier.shape)
        if is_outlier.any():
            spread[is_outlier] = prediction_error_sigmas(self.problem_with_all_readings, self.solution, is_outlier)
        return spread

    def misclosure_of(self, value: ReferenceValue) -> Floats:
        """Misclosure (q,) [m, rad] of q components of an excluded reference value; 0 at a set-up without readings."""
        declared, centring = self.fit_input.recording, self.problem.model.recording.setup.centring
        declared = declared.replace(setup=declared.setup.model_copy(update={"centring": centring}))
        model = replace(self.problem.model, recording=declared)
        problem = NetworkProblem.from_model(model, reading_mask=self.problem.is_used_reading)
        if value.kind == "mark":
            station = self.recording.stations.index(value.name)
            over = problem.marks.positions_on_marks(self.state.station_positions, self.state.target_points)
            return np.asarray(self.state.station_positions[station] - over[station])
        references = (*reference_values(problem, self.state), *common_scale_reference(problem, self.state))
        same = (v.residual for v in references if (v.kind, v.name) == (value.kind, value.name))
        return next(same, np.zeros_like(value.declared_sigmas))

    @property
    def is_gross_reading(self) -> Bools:
        """Flags (n, 3) of n pointings, True for readings whose residual is a displacement above `MAX_TRACKER_ERROR`."""
        displacements = np.abs(np.nan_to_num(self.residuals)) * self.adjustment.sightings.displacement_per_reading
        return displacements > MAX_TRACKER_ERROR

    @cached_property
    def outlier_log_evidence(self) -> float:
        """Contribution of all outliers to the log evidence: logarithms of Occam factors and prior probabilities."""
        w = np.abs(self.whitened_residuals[self.is_outlier])
        return float(np.sum(log_occam_factor_of_shift(w, 1))) + len(w) * log_prior_of_kind(
            "outlier", int(self.problem_with_all_readings.is_used_reading.sum())
        )

    @cached_property
    def log_evidence(self) -> float:
        """Log evidence (log marginal likelihood up to a constant): chi-square, Occam factors, prior probabilities."""
        log_evidence_sum = -0.5 * self.solution.sum_of_squares + self.outlier_log_evidence
        return log_evidence_sum + sum(h.log_prior + self._log_occam_factor_of(h) for h in self.hypotheses)

    def _log_occam_factor_of(self, hypothesis: CauseHypothesis) -> float:
        """Log Occam factor of a hypothesis, for changed noise including the log determinant of the changed weights."""
        change = hypothesis.model_change
        if isinstance(change, ReadingShiftChange):
            length = self.estimate_length_in_sigmas(hypothesis)
            return float(log_occam_factor_of_shift(length, len(change.effect.parameters)))
        if isinstance(change, NoiseFactorChange):
            chosen = change.reading_mask & self.problem.is_used_reading
            ratio = self.problem.reading_sigmas[chosen] / self.fit_input.recording.reading_sigmas()[chosen]
            redundancy = np.nan_to_num(self.redundancy[chosen])
            return float(log_occam_factor_of_variance(redundancy.sum()) - np.sum(redundancy * np.log(ratio)))
        if isinstance(change, CentringChange):
            common = self.common_displacement_length(hypothesis)
            if change.requires_common_length and (common is None or not common.is_smr_exchange):
                return -np.inf
            covariance = self.estimate_and_covariance(hypothesis)[1]
            occam_factor = log_occam_factor_of_centring(covariance, change.centring_uncertainty.sigma_mm * MILLIMETRE)
            return occam_factor + (0.0 if common is None else common.log_evidence_gain + common.log_prior_ratio)
        if isinstance(change, ReferenceOmission):
            value = change.reference_value
            in_sigmas = self.misclosure_of(value) / np.where(value.declared_sigmas > 0, value.declared_sigmas, np.inf)
            return float(log_occam_factor_of_shift(float(np.linalg.norm(in_sigmas)), len(value.declared_sigmas)))
        return 0.0
