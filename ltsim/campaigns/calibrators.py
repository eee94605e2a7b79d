"""Calibrators for the calibration methods of a campaign, for trials with one network geometry or separate ones.

Trials with separate geometries whose stations see the same targets form a stack. The last axis of the geometry arrays
of a stack is the trial, as for all other arrays of a campaign. Exact readings, residuals, gradients, points and
criteria are computed for all trials together. The Gauss-Newton steps of each trial use a normal matrix of this trial.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Self

import numpy as np
from scipy.linalg.lapack import dpotrs

from ltsim.adjustment.problem import NetworkProblem
from ltsim.campaigns.batch_distance_calibrator import BatchDistanceCalibrator
from ltsim.campaigns.batch_network import BatchNetwork
from ltsim.campaigns.kernels import compute_readings
from ltsim.campaigns.kinematic_chain import ChainArrays
from ltsim.campaigns.nominal_network import SharedDerivatives
from ltsim.campaigns.spec import CalibrationMethod
from ltsim.campaigns.trial_calibrators import (
    BatchCalibrator,
    CalibratedBatch,
    SerialCalibrator,
    TrialCalibrator,
    possible_gross_error_mask,
)
from ltsim.campaigns.trial_evaluation import TrialEvaluator
from ltsim.campaigns.true_network import TrialBatch, TrueNetwork
from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import InputError, NetworkError
from ltsim.physics.effects.effect import Effect
from ltsim.physics.model.construction import GeometricErrorModel, construction_with_dh_orders
from ltsim.physics.model.measurement import NetworkState
from ltsim.simulation.draws import StandardNormalSource


def estimated_error_model(method: CalibrationMethod) -> GeometricErrorModel:
    """Geometric error model whose parameters a calibration method of a campaign estimates."""
    return construction_with_dh_orders(method.construction, method.harmonics, method.degree)


def estimated_effects(method: CalibrationMethod) -> tuple[Effect, ...]:
    """Effects that a method estimates in addition to instrument parameters; InputError for an invalid entry."""
    return tuple(e.effect(f"methods.{method.title}.effects.{i}") for i, e in enumerate(method.effects, 1))


def make_calibrator(method: CalibrationMethod, true_network: TrueNetwork) -> TrialCalibrator:
    """Calibrator for a method of a campaign file, for trials in the geometry `true_network`; raises InputError."""
    if method.method != "network" and not true_network.is_recorded_observable.all():
        raise InputError(f"methods.{method.title}: method {method.method} needs ranges and angles; use method network")
    built, effects = estimated_error_model(method), estimated_effects(method)
    if method.solver == "single":
        return SerialCalibrator(
            true_network, built, effects, method.method, uses_applied_corrections=method.uses_applied_corrections
        )
    if method.method != "network":
        return BatchDistanceCalibrator(true_network, built, method=method.method)
    return BatchCalibrator(true_network, built, effects)


@dataclass(frozen=True)
class GeometryStack(TrueNetwork):
    """Stack of true network geometries of trials with the same pointings; the last axis of its arrays is the trial."""

    true_networks: tuple[TrueNetwork, ...] = ()
    """True network geometry of each trial. Quantities that all trials share are taken from the first trial."""
    recording_row_of_pointing: Ints = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int64))
    """Row of each pointing in the recording of each trial, (pointings, trials), because the recordings may list the
    pointings in different orders. Pointings are in the order of the first trial."""

    @classmethod
    def from_true_networks(cls, true_networks: tuple[TrueNetwork, ...]) -> Self:
        """Stack of the true network geometries of trials with the same pointings."""
        first_network = true_networks[0]
        shared_fields = {f.name: getattr(first_network, f.name) for f in fields(TrueNetwork) if f.name != "state"}
        states = [true_network.state for true_network in true_networks]
        position, rotation, points = (
            np.ascontiguousarray(np.stack([getattr(state, name) for state in states], axis=-1))
            for name in ("station_positions", "station_rotations", "target_points")
        )
        order = [np.argsort(_pointing_keys(true_network)) for true_network in true_networks]
        row_order = np.empty((len(order[0]), len(true_networks)), dtype=np.int64)
        row_order[order[0]] = np.stack(order, axis=1)
        return cls(
            **shared_fields,
            state=NetworkState(position, rotation, points, first_network.state.instrument_parameters),
            true_networks=true_networks,
            recording_row_of_pointing=row_order,
        )

    def stack_arrays(self, arrays: Iterable[Floats]) -> Floats:
        """Array (pointings, ..., trials) from one array (pointings, ...) per trial, in the order of the first trial."""
        return np.ascontiguousarray(
            np.stack([a[r] for a, r in zip(arrays, self.recording_row_of_pointing.T, strict=True)], axis=-1)
        )

    def array_of_trial(self, stacked_array: Floats, trial: int) -> Floats:
        """Array (pointings, ...) of one trial, in the order of its recording, from one (pointings, ..., trials)."""
        trial_array = np.empty(stacked_array.shape[:-1])
        trial_array[self.recording_row_of_pointing[:, trial]] = stacked_array[..., trial]
        return trial_array

    @cached_property
    def nominal_readings(self) -> Floats:
        """Nominal readings of all trials, (pointings, 3, trials) [m, rad, rad]."""
        return self.stack_arrays(true_network.recording.readings for true_network in self.true_networks)

    @cached_property
    def local_points(self) -> Floats:
        """Positions of the targets in the instruments' frames, (pointings, 3, trials) [m]."""
        return self.stack_arrays(true_network.sightings.local_points for true_network in self.true_networks)

    @cached_property
    def reading_derivatives(self) -> Floats:
        """Derivative (pointings, 3, 3, trials) of an ideal tracker's readings by the targets in instrument frames."""
        return self.stack_arrays(true_network.sightings.local_derivatives for true_network in self.true_networks)

    def _effect_design(self, effects: tuple[Effect, ...]) -> Floats:
        """Change of the readings per unit of each effect parameter, (pointings, 3, effect parameters, trials)."""
        return self.stack_arrays(true_network.effect_design(effects)[..., 0] for true_network in self.true_networks)

    def _compute_kinematic_chain_and_reading_derivatives(
        self, construction: GeometricErrorModel
    ) -> tuple[ChainArrays, Floats]:
        """Kinematic chain of all trials, and derivative of the readings by the instrument parameters.

        `construction` is the geometric error model. The derivative has the shape (pointings, 3, parameters, trials).
        """
        flattened = np.swapaxes(self.nominal_readings, 1, 2).reshape(-1, 3)
        by_value = construction.reading_design(flattened, np.zeros(construction.n_parameters))[1]
        by_trial = np.moveaxis(by_value.reshape(*self.recording_row_of_pointing.shape, *by_value.shape[1:]), 1, -1)
        return ChainArrays.from_construction(construction, flattened).with_trial_axis(
            len(self.true_networks)
        ), np.ascontiguousarray(by_trial)

    def _exact_reading_deviations(self, true_parameters: Floats) -> Floats:
        """Exact minus nominal readings (pointings, 3, trials) for the true instrument parameters [SI]."""
        which, (program, by_value) = (
            self.recording.instrument,
            self.kinematic_chain_and_reading_derivatives(self.construction),
        )
        deviation = np.einsum("nckb,nkb->ncb", by_value, true_parameters[which])
        compute_readings(program, which, self.local_points, self.reading_derivatives, true_parameters, deviation)
        return deviation

    def draw_numbered_trials(self, seed: int, trial_numbers: Ints) -> TrialBatch:
        """Batch of the trials `trial_numbers`, one for each geometry of the stack, with values drawn with `seed`."""
        sources = StandardNormalSource(seed, trial_numbers).single_trial_sources()
        draws = [
            true_network.distributions.draw(numbers_of_trial)
            for true_network, numbers_of_trial in zip(self.true_networks, sources, strict=True)
        ]
        instrument_values = np.concatenate([draw.instrument_values for draw in draws], axis=2)
        exact = self._exact_reading_deviations(instrument_values)
        single_trial_batches = tuple(
            true_network.batch_from_draw(draw, self.array_of_trial(exact, k)[:, :, None])
            for k, (true_network, draw) in enumerate(zip(self.true_networks, draws, strict=True))
        )
        effect_values = tuple(
            np.concatenate(parts, axis=1)
            for parts in zip(*(batch.effect_values for batch in single_trial_batches), strict=True)
        )
        length_errors = np.concatenate([batch.length_errors for batch in single_trial_batches], axis=1)
        deviation = self.stack_arrays(batch.reading_deviations[:, :, 0] for batch in single_trial_batches)
        return TrialBatch(
            trial_numbers, instrument_values, effect_values, deviation, length_errors, single_trial_batches
        )


def stack_geometries(true_networks: dict[int, TrueNetwork]) -> Iterator[tuple[GeometryStack, Ints]]:
    """Stacks of the trials whose stations see the same targets, each with the numbers of its trials.

    `true_networks` holds the true network geometry of each trial by its number. A trial in which a reading of a
    pointing is missing forms a stack of one trial.
    """
    trials_by_pattern: dict[tuple[object, ...], list[int]] = {}
    for number, true_network in true_networks.items():
        evaluator = TrialEvaluator(true_network)
        names = true_network.recording.stations, true_network.recording.targets
        is_complete = true_network.recording.is_measured.all(axis=0).all()
        pattern = np.sort(_pointing_keys(true_network)).tobytes() if is_complete else number
        key = (*names, pattern, evaluator.can_compute_criteria, evaluator.is_frame_determined.tobytes())
        trials_by_pattern.setdefault(key, []).append(number)
    for numbers in trials_by_pattern.values():
        yield GeometryStack.from_true_networks(tuple(true_networks[number] for number in numbers)), np.array(numbers)


def _pointing_keys(true_network: TrueNetwork) -> Ints:
    """Integer key of each pointing, (pointings,), from its repeat, station, face and target."""
    r = true_network.recording
    return ((r.repeat * len(r.stations) + r.station) * 3 + r.face) * len(r.targets) + r.target


@dataclass(frozen=True)
class StackCalibrator(TrialCalibrator):
    """Calibrator of a stack of trials with separate network geometries but the same pointings.

    The network method calibrates the trials together. All other methods, and trials that do not converge together, are
    calibrated one by one.
    """

    true_network: GeometryStack
    """True network geometries of the trials."""
    requested_method: CalibrationMethod = field(default_factory=CalibrationMethod)
    """Calibration method as the campaign file defines it."""

    @classmethod
    def for_stack(cls, method: CalibrationMethod, stack: GeometryStack) -> Self:
        """Calibrator of the trials in `stack` by a method of the campaign file."""
        first_calibrator = make_calibrator(method, stack.true_networks[0])
        return cls(stack, first_calibrator.construction, first_calibrator.effects, method.method, method)

    def single_trial_calibrator(self, trial: int) -> TrialCalibrator:
        """Calibrator for the single trial with the index `trial` in the stack."""
        return make_calibrator(self.requested_method, self.true_network.true_networks[trial])

    def calibrate(self, trial_batch: TrialBatch, trial_indices: Ints) -> CalibratedBatch:
        """Results for the trials of a batch; a trial with undetermined parameters has the status `failed`."""
        calibrated = CalibratedBatch.from_failed_trials(
            self.true_network, self.construction, self.effects, len(trial_batch.single_trial_batches)
        )
        is_batch = self.method == "network" and self.requested_method.solver == "batch" and not self.effects
        remaining = self._calibrate_batch(trial_batch, calibrated) if is_batch else trial_indices
        for trial in remaining.tolist():
            try:
                single = self.single_trial_calibrator(trial).calibrate(
                    trial_batch.single_trial_batches[trial], np.zeros(1, dtype=np.int64)
                )
            except (NetworkError, InputError):
                continue
            calibrated.copy_results_of_trial(trial, single, 0)
        return calibrated

    def _calibrate_batch(self, trial_batch: TrialBatch, calibrated_batch: CalibratedBatch) -> Ints:
        """Indices of the trials whose joint calibration did not converge.

        The estimates of the solved trials are written to `calibrated_batch`.
        """
        stack, built = self.true_network, self.construction
        program, by_value = stack.kinematic_chain_and_reading_derivatives(built)
        networks: list[BatchNetwork] = []
        for k, true_network in enumerate(stack.true_networks):
            recording = stack.recording.with_readings(stack.nominal_readings[:, :, k])
            shared = (
                SharedDerivatives(networks[0], stack.reading_derivatives[..., k], by_value[..., k])
                if networks
                else None
            )
            networks.append(
                BatchNetwork(
                    recording,
                    true_network.state,
                    built,
                    program,
                    shared_derivatives=shared,
                    is_adjusted_observable=true_network.is_recorded_observable,
                )
            )
        network = StackedNetwork(stack.recording, stack.state, built, program, trial_networks=tuple(networks))
        try:
            fit = network.fit_trials(trial_batch.reading_deviations, trial_batch.length_errors)
        except InputError:
            return np.arange(len(networks))
        status = np.zeros(len(networks), dtype=np.int64)
        batch_results = CalibratedBatch(
            fit.instrument_values,
            network.parameter_sigmas,
            fit.target_increments,
            fit.chi2,
            status,
            incidence_parameters=fit.incidence_parameters,
        )
        is_doubtful = ~fit.has_converged | possible_gross_error_mask(trial_batch.reading_deviations, stack.local_points)
        for trial in np.flatnonzero(~is_doubtful):
            calibrated_batch.copy_results_of_trial(int(trial), batch_results, int(trial))
        return np.flatnonzero(is_doubtful)

    def largest_solver_difference(self, trial_batch: TrialBatch, trial: int, results: CalibratedBatch) -> float:
        """Largest difference between the `results` of a trial and `lt.calibrate`, in standard deviations."""
        trial_slice = slice(trial, trial + 1)
        arrays = (
            results.instrument_values[..., trial_slice],
            results.instrument_sigmas[..., trial],
            results.target_errors[..., trial_slice],
        )
        single_batch = CalibratedBatch(*arrays, results.chi2[trial_slice], results.status_indices[trial_slice])
        return self.single_trial_calibrator(trial).largest_solver_difference(
            trial_batch.single_trial_batches[trial], 0, single_batch
        )


@dataclass(frozen=True)
class StackedNetwork(BatchNetwork):
    """Networks of several trials with the same pointings but different coordinates, adjusted together.

    The last axis of the arrays in `state` and `kinematic_chain` is the trial; `recording` belongs to the first trial.
    """

    trial_networks: tuple[BatchNetwork, ...] = ()
    """Network of each trial."""

    @cached_property
    def problem(self) -> NetworkProblem:
        """Least-squares problem of the first trial, which defines the order of the unknowns."""
        return self.trial_networks[0].problem

    def gauss_newton_step(self, gradient: Floats) -> Floats:
        """Gauss-Newton step (unknowns, trials) for the negative gradients, with the normal matrix of each trial."""
        step = np.empty_like(gradient)
        for trial, (root, scale) in enumerate(part.cholesky_and_scales for part in self.trial_networks):
            step[:, trial] = scale * dpotrs(root.T, scale * gradient[:, trial])[0]
        return step

    @cached_property
    def parameter_sigmas(self) -> Floats:
        """Standard deviation of the instrument parameters after adjustment, (instruments, parameters, trials) [SI]."""
        return np.stack([part.parameter_sigmas for part in self.trial_networks], axis=-1)

    @cached_property
    def reading_sigmas(self) -> Floats:
        """Standard deviations of the readings, (pointings, 3, trials) [m, rad, rad]; infinite for missing readings."""
        return np.stack([part.reading_sigmas for part in self.trial_networks], axis=-1)

    @cached_property
    def _point_derivatives(self) -> Floats:
        """Derivative (pointings, 3, 3, trials) of an ideal tracker's readings by the targets in instrument frames."""
        return np.stack([part._point_derivatives for part in self.trial_networks], axis=-1)

    @cached_property
    def _bench_tested_reflector_change(self) -> Floats | None:
        """Expected change (pointings, 3, trials) [m, rad, rad] of readings by bench-tested reflectors, or None."""
        shifts = [shift for part in self.trial_networks if (shift := part._bench_tested_reflector_change) is not None]
        return np.concatenate(shifts, axis=-1) if shifts else None

    @cached_property
    def _affected_readings(self) -> tuple[Ints, Floats, Floats]:
        """Indices of the readings that effects change, and their design matrices, plain and whitened.

        The indices have the shape (affected readings,), the designs (trials, affected readings, effect parameters).
        """
        n_readings = 3 * len(self.recording)
        flattened = [part._additional_parameter_design.reshape(n_readings, -1) for part in self.trial_networks]
        affected_rows = np.flatnonzero(np.any([design.any(axis=1) for design in flattened], axis=0))
        design = np.stack([design[affected_rows] for design in flattened])
        sigma = np.stack([part.reading_sigmas.ravel()[affected_rows] for part in self.trial_networks])
        return affected_rows, design, design / sigma[:, :, None]

    @cached_property
    def _non_reading_design(self) -> tuple[Floats, Floats]:
        """Whitened design (trials, rows, unknowns) and residuals (rows, trials) of all observations except readings."""
        designs, nominal = zip(*(part._non_reading_design for part in self.trial_networks), strict=True)
        return np.stack(designs), np.concatenate(nominal, axis=1)

    def _first_newton_step(self, reading_deviations: Floats, length_errors: Floats | None) -> tuple[Floats, Floats]:
        """First step (unknowns, trials), and predicted minus nominal readings (pointings, 3, trials) after it.

        `reading_deviations` are readings minus nominal readings, `length_errors` (lengths, trials) [m] declared minus
        true reference lengths.
        """
        x, predicted = (
            np.zeros((self.block_end_indices[-1], reading_deviations.shape[2])),
            np.zeros_like(reading_deviations),
        )
        gradient, cost = np.empty_like(x), np.empty(x.shape[1])
        arguments = reading_deviations, length_errors, predicted, gradient, cost
        self._write_gradient_and_cost(x, *arguments)
        x += self.gauss_newton_step(gradient)
        self._write_gradient_and_cost(x, *arguments)  # for a second Newton step of the predicted readings
        return x, predicted
