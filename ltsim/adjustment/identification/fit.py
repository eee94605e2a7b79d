"""Robust fit of a network with some hypotheses in its model, and its log evidence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.identification.evidence import log_prior_of, occam, occam_of_variance, variance_factor
from ltsim.adjustment.identification.hypothesis import (
    Correction,
    Exchange,
    Hypothesis,
    NoiseFactor,
    Omission,
    Shift,
)
from ltsim.adjustment.identification.resection import resected
from ltsim.adjustment.prior import ParameterPrior
from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.reference_tests import relaxed_references
from ltsim.adjustment.reference_values import (
    ReferenceRows,
    ReferenceValue,
    common_scale,
    drop_reference,
    exchanged,
    reference_values,
)
from ltsim.adjustment.significance import FAR
from ltsim.adjustment.snooping import LARGEST_ERROR, drop_undetermined, prediction_spread, snoop_readings
from ltsim.adjustment.start import initial_network
from ltsim.adjustment.stochastic_model import robust_state
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.core.units import ARCSECOND, MILLIMETRE
from ltsim.geometry.polar import wrap
from ltsim.physics.effects.signature import Signature
from ltsim.physics.model.construction import Construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState, with_plumb_lines
from ltsim.recordings.recording import SIGMA_COLUMNS, Recording
from ltsim.scene.sightings import Sightings
from ltsim.solve.design import median_deviation
from ltsim.solve.gauss_newton import Solution, solve

DETERMINED = 4.0
"""Smallest shift, in its standard deviations, that a fit may contain; chance exceeds four in one of 16,000 cases."""
REWEIGHTED = 3
SAME_NOISE = 0.05
"""Largest number of estimates of noise factors, and relative change that ends them (0.1 in log evidence)."""
OTHER_OUTLIERS = 0.2
"""Relative change of the noise from which the set of outliers is determined again."""
ROUNDS = 6
"""Largest number of solutions in which outliers are rejected and accepted again; readings that still alternate are
rejected and indicate no cause.
"""
FREE = 1e6
"""Standard deviation, in plausible sizes, of the weak prior of a shift; larger shifts do not occur."""


@dataclass(frozen=True)
class Network:
    """Input of a fit: recording, construction, priors of its parameters, and usable readings (n, 3)."""

    recording: Recording
    construction: Construction
    prior: ParameterPrior | None = None
    usable: Bools | None = None


@dataclass(frozen=True)
class Fit:
    """Network fitted with some hypotheses in its model; readings that contradict it are rejected as outliers.

    Attributes
    ----------
    network : Network
    hypotheses : tuple of Hypothesis
    whole : NetworkProblem
        Least-squares problem with all usable readings.
    problem : NetworkProblem
        With the readings in use that fit.
    solution : Solution
    """

    network: Network
    hypotheses: tuple[Hypothesis, ...]
    whole: NetworkProblem
    problem: NetworkProblem
    solution: Solution[NetworkState]

    @classmethod
    def far_references(cls, network: Network, hypotheses: Sequence[Hypothesis]) -> tuple[list[ReferenceRows], int]:
        """Reference values with large residuals at a robust state, and the number of all reference values.

        A network that uses them is distorted as a whole.
        """
        problem, start = cls._problem(network, hypotheses)
        relaxed = relaxed_references(problem, start)
        state, residual = robust_state(relaxed, resected(relaxed, start))
        limit = FAR * max(median_deviation(residual[: int(problem.use.sum())]), 1.0)
        values = [v for v in reference_values(problem, state) if v.kind != "mark"]
        return [v for v in values if float(np.abs(residual[v.rows]).max()) > limit], len(values)

    @classmethod
    def of(
        cls,
        network: Network,
        hypotheses: Sequence[Hypothesis] = (),
        start: NetworkState | None = None,
        near: Sightings | None = None,
    ) -> Fit | None:
        """Fit from a start, by default from the recording alone; None for an undetermined network.

        If the sightings `near` are given, the start is computed from the recording without the guessed shifts of the
        hypotheses.
        """
        fresh = start is None
        problem, start = cls._problem(network, hypotheses, start, near)
        if fresh:
            start = resected(problem, robust_state(problem, resected(problem, start))[0])
        whole = drop_undetermined(problem, start)
        fit = cls(network, tuple(hypotheses), whole, *snoop_readings(whole, start, ROUNDS))
        if any(isinstance(h.change, NoiseFactor) for h in hypotheses):
            fit = fit._reweighted()
        return fit if fit.solution.converged and fit._is_determined else None

    @property
    def _is_determined(self) -> bool:
        """True if the readings determine each shift; one that is equivalent to a change of coordinates has no size."""
        return all(self.length(h) > DETERMINED for h, _, _ in self.shifts)

    @property
    def shifts(self) -> Iterator[tuple[Hypothesis, Shift, slice]]:
        """Hypotheses that are shifts, with the slices of their parameters in the state."""
        first = 0
        for h in self.hypotheses:
            if isinstance(h.change, Shift):
                yield h, h.change, slice(first, first := first + len(h.change.effect.parameters))

    def estimate(self, hypothesis: Hypothesis) -> tuple[Floats, Floats]:
        """Estimate (p,) and covariance (p, p) of a shift of the model [SI]."""
        at = next(at for h, _, at in self.shifts if h is hypothesis)
        return self.state.extra_parameters[at], self.adjustment.extra_covariance[at, at]

    def length(self, hypothesis: Hypothesis) -> float:
        """Length of the estimate of a shift in its standard deviations."""
        values, covariance = self.estimate(hypothesis)
        return float(np.sqrt(max(float(values @ np.linalg.pinv(covariance) @ values), 0.0)))

    @staticmethod
    def _problem(
        network: Network,
        hypotheses: Sequence[Hypothesis],
        start: NetworkState | None = None,
        near: Sightings | None = None,
    ) -> tuple[NetworkProblem, NetworkState]:
        """Problem with all usable readings, and a start, as in `of`."""
        recording = changed_recording(network.recording, hypotheses)
        lost = np.zeros(len(recording.targets), dtype=bool)
        if start is None:
            reached, lost = initial_network(recording if near is None else _unshifted(recording, hypotheses, near))
            recording = recording.with_readings(np.where(lost[recording.target][:, None], np.nan, recording.readings))
            parameters = np.zeros((len(recording.instruments), network.construction.n_parameters))
            start = NetworkState(*reached, parameters if network.prior is None else network.prior.mean)
        recording = with_plumb_lines(recording, start.station_positions)
        effects = tuple(h.change.effect for h in hypotheses if isinstance(h.change, Shift))
        model = MeasurementModel(recording, network.construction, effects)
        if len(start.extra_parameters) != model.n_extra_parameters:
            start = replace(start, extra_parameters=_guesses(hypotheses, model.n_extra_parameters, near))
        usable = np.ones((len(recording), 3), dtype=bool) if network.usable is None else network.usable
        sigma = recording.sigma()
        for h in hypotheses:
            if isinstance(h.change, NoiseFactor):
                sigma = np.where(h.change.readings, sigma * h.change.guess, sigma)
        problem = NetworkProblem.of(
            model,
            sigma=sigma,
            use=usable & ~lost[recording.target][:, None],
            held_to=FREE,
            prior=network.prior,
        )
        positions = problem.marks.on_marks(start.station_positions, start.target_points)
        return problem, replace(start, station_positions=positions)

    def _reweighted(self) -> Fit:
        """Fit with noise factors estimated from its residuals (restricted maximum likelihood)."""
        fit = self
        for _ in range(REWEIGHTED):
            sigma = fit._sigma()
            changed = float(np.nanmax(np.abs(np.log(sigma / fit.whole.sigma))))
            if not changed > SAME_NOISE:
                break
            whole, problem = replace(fit.whole, sigma=sigma), replace(fit.problem, sigma=sigma)
            solution = solve(problem, fit.state)
            if solution.factor is None or changed > OTHER_OUTLIERS:
                problem, solution = snoop_readings(whole, fit.state, ROUNDS)
            fit = replace(fit, whole=whole, problem=problem, solution=solution)
        return fit

    def _sigma(self) -> Floats:
        """Standard deviations (n, 3) with the noise factors that the residuals imply."""
        sigma = self.network.recording.sigma()
        for h in self.hypotheses:
            if isinstance(h.change, NoiseFactor):
                chosen = h.change.readings & self.problem.use
                squares = float(np.sum((self.residuals / sigma)[chosen] ** 2))
                factor, _ = variance_factor(np.array(squares), np.array(float(np.nansum(self.redundancy[chosen]))))
                sigma = np.where(h.change.readings, sigma * factor, sigma)
        return sigma

    def without_distances(self, rows: Ints) -> Fit | None:
        """Fit from the beginning without the distances of some rows; None if they are needed for a network."""
        readings = self.network.recording.readings.copy()
        readings[rows, 0] = np.nan
        network = replace(self.network, recording=self.network.recording.with_readings(readings))
        try:
            return Fit.of(network, self.hypotheses)
        except NetworkError:
            return None

    def residuals_of(self, recording: Recording) -> Floats:
        """Readings (n, 3) of a recording with the same pointings minus the predicted ones [m, rad, rad]."""
        gap = recording.readings - self.problem.model.predict(self.state)
        gap[:, 1:] = wrap(gap[:, 1:])
        return gap

    @property
    def state(self) -> NetworkState:
        """Adjusted poses, targets and parameters."""
        return self.solution.x

    @cached_property
    def adjustment(self) -> Adjustment:
        """Adjustment with the state and readings of the fit."""
        out = self.recording.measured.any(axis=1) & ~self.problem.use.any(axis=1)
        return Adjustment(self.problem, self.solution, np.asarray(out))

    @property
    def recording(self) -> Recording:
        """The recording with the hypotheses' corrections."""
        return self.problem.model.recording

    @property
    def effects(self) -> tuple[Signature, ...]:
        """The shifts in the model, each with a plausible size of at least its estimate."""
        signatures = list[Signature]()
        for _, shift, at in self.shifts:
            times = float(np.max(np.abs(self.state.extra_parameters[at]) / shift.effect.size_scales))
            signatures.append(replace(shift.effect, coarse=max(1.0, times)))  # type: ignore[type-var]
        return tuple(signatures)

    def corrected(self, recording: Recording, outliers: bool = False) -> Recording:
        """Recording corrected for the hypotheses in the model; `outliers` decides whether outliers remain.

        Rows are corrected, shifts are subtracted, estimated noise factors are applied to the declared noise, and
        rejected reference values are removed.
        """
        readings = self.recording.readings.copy()
        for _, shift, at in self.shifts:
            readings -= shift.effect.reading_change(self.adjustment.sightings, self.state.extra_parameters[at])
        if not outliers:
            readings[self.outliers] = np.nan
        corrected = recording.replace(
            readings=readings, target=self.recording.target, face=self.recording.face, setup=self.recording.setup
        )
        if not any(isinstance(h.change, NoiseFactor) for h in self.hypotheses):
            return corrected
        sigma = self.problem.sigma / [MILLIMETRE, ARCSECOND, ARCSECOND]
        columns = dict(zip(SIGMA_COLUMNS, sigma.T, strict=True))
        return corrected.replace(covariates={**corrected.covariates, **columns})

    @cached_property
    def residuals(self) -> Floats:
        """Observed minus predicted readings (n, 3) [m, rad, rad], including outliers."""
        return self.problem.residuals(self.problem.model.predict(self.state))

    @cached_property
    def whitened(self) -> Floats:
        """Residuals divided by the standard deviations, (n, 3); 0 for unusable readings."""
        return np.where(self.whole.use, np.nan_to_num(self.residuals / self.problem.sigma), 0.0)

    @property
    def redundancy(self) -> Floats:
        """Redundancy numbers (n, 3)."""
        return self.adjustment.redundancy

    @cached_property
    def outliers(self) -> Bools:
        """Flags (n, 3) of the usable readings that are rejected."""
        return self.whole.use & ~self.problem.use

    @cached_property
    def prediction_spread(self) -> Floats:
        """Standard deviations (n, 3) of the deviations of outliers from their predictions, over the declared ones.

        They are 1 for other readings.
        """
        spread = np.ones(self.outliers.shape)
        if self.outliers.any():
            spread[self.outliers] = prediction_spread(self.whole, self.solution, self.outliers)
        return spread

    def _missed_by(self, value: ReferenceValue) -> float:
        """Misclosure of an omitted reference value, in its declared standard deviations."""
        return float(np.linalg.norm(self.gap_of(value) / np.where(value.sigma > 0, value.sigma, np.inf)))

    def gap_of(self, value: ReferenceValue) -> Floats:
        """Misclosure (q,) [m, rad] of an omitted reference value in the adjusted network."""
        model = replace(self.problem.model, recording=self.network.recording)
        declared = NetworkProblem.of(model, use=self.problem.use)
        if value.kind == "mark":
            station = self.recording.stations.index(value.name)
            over = declared.marks.on_marks(self.state.station_positions, self.state.target_points)
            return np.asarray(self.state.station_positions[station] - over[station])
        every = (*reference_values(declared, self.state), *common_scale(declared, self.state))
        return next(v.residual for v in every if (v.kind, v.name) == (value.kind, value.name))

    def displacement(self, hypothesis: Hypothesis) -> float:
        """Largest displacement [m] of a reading, or misclosure of a reference value, by a hypothesis in the model."""
        change, sightings = hypothesis.change, self.adjustment.sightings
        if isinstance(change, Omission):
            return float(np.abs(self.gap_of(change.value)).max())
        if not isinstance(change, Shift):
            return 0.0
        moved = np.abs(change.effect.design(sightings) @ self.estimate(hypothesis)[0])
        return float(np.max(moved * _arms(sightings)))

    @property
    def is_gross(self) -> Bools:
        """Flags (n, 3) of the readings with deviations beyond any error of a tracker."""
        return np.abs(np.nan_to_num(self.residuals)) * _arms(self.adjustment.sightings) > LARGEST_ERROR

    @cached_property
    def outlier_terms(self) -> float:
        """Log of the Occam factors and priors of all outliers."""
        w = np.abs(self.whitened[self.outliers])
        return float(np.sum(occam(w, 1))) + len(w) * log_prior_of("outlier", int(self.whole.use.sum()))

    @cached_property
    def log_evidence(self) -> float:
        """Log marginal likelihood up to a constant of the recording: fit, Occam factors and priors of all causes."""
        total = -0.5 * self.solution.cost + sum(h.log_prior for h in self.hypotheses)
        total += self.outlier_terms
        for h in self.hypotheses:
            if isinstance(h.change, Shift):
                total += float(occam(self.length(h), len(h.change.effect.parameters)))
            elif isinstance(h.change, NoiseFactor):
                chosen = h.change.readings & self.problem.use
                redundancy = np.nansum(self.redundancy[chosen])
                ratio = self.problem.sigma[chosen] / self.network.recording.sigma()[chosen]
                total -= float(np.sum(np.nan_to_num(self.redundancy[chosen]) * np.log(ratio)))
                total += float(occam_of_variance(redundancy))
            elif isinstance(h.change, Omission):
                total += float(occam(self._missed_by(h.change.value), len(h.change.value.sigma)))
        return total


def _arms(sightings: Sightings) -> Floats:
    """Lengths (n, 3) [m or m/rad] that convert errors of the readings to displacements."""
    range_ = sightings.range_
    return np.stack([np.ones_like(range_), range_ * np.cos(sightings.elevation), range_], axis=1)


def _guesses(hypotheses: Sequence[Hypothesis], size: int, near: Sightings | None) -> Floats:
    """Start values (q,) of the parameters of the shifts."""
    shifts = [h.change for h in hypotheses if isinstance(h.change, Shift)]
    values = [s.guess if near is not None and s.guess else (0.0,) * len(s.effect.parameters) for s in shifts]
    whole = np.zeros(size)
    flat = [v for value in values for v in value]
    whole[: len(flat)] = flat
    return whole


def _unshifted(recording: Recording, hypotheses: Sequence[Hypothesis], near: Sightings) -> Recording:
    """Recording without the shifts of the hypotheses, at their guessed sizes."""
    readings = recording.readings.copy()
    for h in hypotheses:
        if isinstance(h.change, Shift) and h.change.guess:
            readings -= h.change.effect.reading_change(near, np.array(h.change.guess))
    return recording.with_readings(readings)


def changed_recording(recording: Recording, hypotheses: Sequence[Hypothesis]) -> Recording:
    """Recording with corrected rows, and without rejected reference values."""
    readings, target, face = recording.readings.copy(), recording.target.copy(), recording.face.copy()
    for h in hypotheses:
        if isinstance(h.change, Correction):
            rows = h.change.rows
            readings[rows], target[rows], face[rows] = h.change.readings, h.change.target, h.change.face
    recording = recording.replace(readings=readings, target=target, face=face)
    for h in hypotheses:
        if isinstance(h.change, Omission):
            recording = drop_reference(recording, h.change.value)
        elif isinstance(h.change, Exchange):
            recording = exchanged(recording, *h.change.names)
    return recording
