"""Calibrators of the methods in a campaign file, for trials with a common geometry and for trials with separate ones.

Trials whose stations see the same targets form a stack: the last index of their geometry arrays is the trial, as for
all other arrays. Large operations (exact readings, residuals and gradients, points, criteria) are done for all trials
together; each trial has its own normal matrix, which determines its steps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Self

import numpy as np
from scipy.linalg.lapack import dpotrs

from ltsim.adjustment.problem import NetworkProblem
from ltsim.campaigns.distance import BatchDistance
from ltsim.campaigns.engine import BatchCalibrator, Calibrated, Calibrator, SerialCalibrator, suspects
from ltsim.campaigns.judge import TrialEvaluator
from ltsim.campaigns.kernels import readings_of
from ltsim.campaigns.network import BatchNetwork, SharedQuantities
from ltsim.campaigns.program import ChainProgram
from ltsim.campaigns.spec import Method
from ltsim.campaigns.truth import CellTruth, TrialBatch
from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import NetworkError, SetupError
from ltsim.physics.effects.effect import Effect
from ltsim.physics.model.construction import Construction, construction_with_orders
from ltsim.physics.model.measurement import NetworkState
from ltsim.simulation.draws import StandardNormalSource


def fitted_construction(method: Method) -> Construction:
    """The construction whose parameters a method estimates."""
    return construction_with_orders(method.construction, method.harmonics, method.degree)


def fitted_effects(method: Method) -> tuple[Effect, ...]:
    """Additional effects that a method estimates; raises SetupError with the entry and the permitted values."""
    return tuple(e.effect(f"methods.{method.title}.effects.{i}") for i, e in enumerate(method.effects, 1))


def calibrator_of(method: Method, truth: CellTruth) -> Calibrator:
    """Calibrator of a method in a campaign file."""
    if method.method != "network" and not truth.recorded.all():
        raise SetupError(f"methods.{method.title}: {method.method} compares points, which need ranges and angles")
    built, effects = fitted_construction(method), fitted_effects(method)
    if method.solver == "single":
        return SerialCalibrator(truth, built, effects, method.method, applied=method.applied)
    if method.method != "network":
        return BatchDistance(truth, built, method=method.method)
    return BatchCalibrator(truth, built, effects)


@dataclass(frozen=True)
class GeometryStack(CellTruth):
    """True geometries of trials whose stations see the same targets; the last index of geometry arrays is the trial."""

    truths: tuple[CellTruth, ...] = ()
    """True geometry of each trial; quantities common to all are those of the first."""
    rows: Ints = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int64))
    """Row of each pointing of the first trial in every trial, (n, B); the order of pointings may differ."""

    @classmethod
    def of(cls, truths: tuple[CellTruth, ...]) -> Self:
        """Stack of true geometries with the same sightings."""
        first = truths[0]
        shared = {f.name: getattr(first, f.name) for f in fields(CellTruth) if f.name != "state"}
        states = [truth.state for truth in truths]
        position, rotation, points = (
            np.ascontiguousarray(np.stack([getattr(state, name) for state in states], axis=-1))
            for name in ("station_positions", "station_rotations", "target_points")
        )
        order = [np.argsort(_keys(truth)) for truth in truths]
        rows = np.empty((len(order[0]), len(truths)), dtype=np.int64)
        rows[order[0]] = np.stack(order, axis=1)
        return cls(
            **shared,
            state=NetworkState(position, rotation, points, first.state.instrument_parameters),
            truths=truths,
            rows=rows,
        )

    def gathered(self, each: Iterable[Floats]) -> Floats:
        """Arrays (n, ...) of the trials in the common order of pointings, stacked along a last index."""
        return np.ascontiguousarray(np.stack([a[r] for a, r in zip(each, self.rows.T, strict=True)], axis=-1))

    def of_trial(self, together: Floats, trial: int) -> Floats:
        """Array (n, ...) of one trial from a stacked array (n, ..., B), in the trial's order of pointings."""
        ordered = np.empty(together.shape[:-1])
        ordered[self.rows[:, trial]] = together[..., trial]
        return ordered

    @cached_property
    def nominal(self) -> Floats:
        """Nominal readings of all trials, (n, 3, B)."""
        return self.gathered(truth.recording.readings for truth in self.truths)

    @cached_property
    def local(self) -> Floats:
        """Targets in the instruments' frames, (n, 3, B) [m]."""
        return self.gathered(truth.sightings.local for truth in self.truths)

    @cached_property
    def jacobian(self) -> Floats:
        """Derivative of an ideal tracker's readings with respect to the local point, (n, 3, 3, B)."""
        return self.gathered(truth.sightings.jacobian for truth in self.truths)

    def _design_of(self, effects: tuple[Effect, ...]) -> Floats:
        return self.gathered(truth.design_of(effects)[..., 0] for truth in self.truths)

    def _laid_out(self, built: Construction) -> tuple[ChainProgram, Floats]:
        """Kinematic chain of all trials, and derivative (n, 3, p, B) of the readings by its parameters."""
        flat = np.swapaxes(self.nominal, 1, 2).reshape(-1, 3)
        by_value = built.reading_design(flat, np.zeros(built.n_parameters))[1]
        by_trial = np.moveaxis(by_value.reshape(*self.rows.shape, *by_value.shape[1:]), 1, -1)
        return ChainProgram.of(built, flat).spread(len(self.truths)), np.ascontiguousarray(by_trial)

    def _exact(self, values: Floats) -> Floats:
        which, (program, by_value) = self.recording.instrument, self.chain_of(self.construction)
        deviation = np.einsum("nckb,nkb->ncb", by_value, values[which])
        readings_of(program, which, self.local, self.jacobian, values, deviation)
        return deviation

    def draw_trials(self, seed: int, numbers: Ints) -> TrialBatch:
        """Random values of the trials with these numbers."""
        each = StandardNormalSource(seed, numbers).single_trial_sources()
        draws = [
            truth.population.draw(numbers_of_trial) for truth, numbers_of_trial in zip(self.truths, each, strict=True)
        ]
        values = np.concatenate([draw.instrument_values for draw in draws], axis=2)
        exact = self._exact(values)
        alone = tuple(
            truth.read(draw, self.of_trial(exact, k)[:, :, None])
            for k, (truth, draw) in enumerate(zip(self.truths, draws, strict=True))
        )
        amounts = tuple(
            np.concatenate(parts, axis=1) for parts in zip(*(block.amounts for block in alone), strict=True)
        )
        gauge_error = np.concatenate([block.gauge_error for block in alone], axis=1)
        deviation = self.gathered(block.deviation[:, :, 0] for block in alone)
        return TrialBatch(numbers, values, amounts, deviation, gauge_error, alone)


def stacks(truths: dict[int, CellTruth]) -> Iterator[tuple[GeometryStack, Ints]]:
    """Stacks of trials with equal sightings and equal criteria, with the numbers of their trials."""
    groups: dict[tuple[object, ...], list[int]] = {}
    for number, truth in truths.items():
        judge = TrialEvaluator(truth)
        names = truth.recording.stations, truth.recording.targets
        whole = truth.recording.measured.all(axis=0).all()
        pattern = np.sort(_keys(truth)).tobytes() if whole else number
        key = (*names, pattern, judge.comparable, judge.fitted.tobytes())
        groups.setdefault(key, []).append(number)
    for numbers in groups.values():
        yield GeometryStack.of(tuple(truths[number] for number in numbers)), np.array(numbers)


def _keys(truth: CellTruth) -> Ints:
    """Keys (n,) that identify a pointing within its recording."""
    r = truth.recording
    return ((r.repeat * len(r.stations) + r.station) * 3 + r.face) * len(r.targets) + r.target


@dataclass(frozen=True)
class StackCalibrator(Calibrator):
    """Calibrator of trials of one geometry, in a batch; those that fail there or have no batch method one by one."""

    truth: GeometryStack
    asked: Method = field(default_factory=Method)

    @classmethod
    def of(cls, method: Method, stack: GeometryStack) -> Self:
        """Calibrator of a stack by a method of the campaign file."""
        first = calibrator_of(method, stack.truths[0])
        return cls(stack, first.construction, first.effects, method.method, method)

    def alone(self, trial: int) -> Calibrator:
        """Calibrator of a single trial."""
        return calibrator_of(self.asked, self.truth.truths[trial])

    def calibrate(self, block: TrialBatch, wanted: Ints) -> Calibrated:
        """Calibrated trials of a block; a trial whose geometry leaves parameters undetermined has failed."""
        calibrated = Calibrated.none(self.truth, self.construction, self.effects, len(block.alone))
        together = self.method == "network" and self.asked.solver == "batch" and not self.effects
        remaining = self._together(block, calibrated) if together else wanted
        for trial in remaining.tolist():
            try:
                single = self.alone(trial).calibrate(block.alone[trial], np.zeros(1, dtype=np.int64))
            except (NetworkError, SetupError):
                continue
            calibrated.take(trial, single, 0)
        return calibrated

    def _together(self, block: TrialBatch, calibrated: Calibrated) -> Ints:
        """Trials that the batch did not calibrate; results of the others are stored in `calibrated`."""
        stack, built = self.truth, self.construction
        program, by_value = stack.chain_of(built)
        parts: list[BatchNetwork] = []
        for k, truth in enumerate(stack.truths):
            recording = stack.recording.with_readings(stack.nominal[:, :, k])
            shared = SharedQuantities(parts[0], stack.jacobian[..., k], by_value[..., k]) if parts else None
            parts.append(BatchNetwork(recording, truth.state, built, program, shared=shared, recorded=truth.recorded))
        network = StackedNetwork(stack.recording, stack.state, built, program, parts=tuple(parts))
        try:
            fit = network.fit(block.deviation, block.gauge_error)
        except SetupError:
            return np.arange(len(parts))
        status = np.zeros(len(parts), dtype=np.int64)
        together = Calibrated(fit.values, network.sigma_values, fit.points, fit.chi2, status, reflectors=fit.reflectors)
        doubtful = ~fit.converged | suspects(block.deviation, stack.local)
        for trial in np.flatnonzero(~doubtful):
            calibrated.take(int(trial), together, int(trial))
        return np.flatnonzero(doubtful)

    def difference(self, block: TrialBatch, trial: int, calibrated: Calibrated) -> float:
        """Difference between a trial and the full solver, as in `Calibrator`."""
        selected = slice(trial, trial + 1)
        arrays = calibrated.values[..., selected], calibrated.sigma[..., trial], calibrated.points[..., selected]
        single = Calibrated(*arrays, calibrated.chi2[selected], calibrated.status[selected])
        return self.alone(trial).difference(block.alone[trial], 0, single)


@dataclass(frozen=True)
class StackedNetwork(BatchNetwork):
    """Networks with equal pointings at different positions, one per trial, adjusted together.

    The last index of its state and program is the trial; `recording` is that of the first trial.
    """

    parts: tuple[BatchNetwork, ...] = ()
    """Network of each trial."""

    @cached_property
    def problem(self) -> NetworkProblem:
        """Least-squares problem of the first trial."""
        return self.parts[0].problem

    def step(self, gradient: Floats) -> Floats:
        """Step of each trial with its own normal matrix."""
        step = np.empty_like(gradient)
        for trial, (root, scale) in enumerate(part.root for part in self.parts):
            step[:, trial] = scale * dpotrs(root.T, scale * gradient[:, trial])[0]
        return step

    @cached_property
    def sigma_values(self) -> Floats:
        """Standard deviation of the parameters, (I, p, B) [SI]."""
        return np.stack([part.sigma_values for part in self.parts], axis=-1)

    @cached_property
    def sigma(self) -> Floats:
        """Standard deviation of the readings, (n, 3, B)."""
        return np.stack([part.sigma for part in self.parts], axis=-1)

    @cached_property
    def _by_point(self) -> Floats:
        return np.stack([part._by_point for part in self.parts], axis=-1)

    @cached_property
    def _expected_shift(self) -> Floats | None:
        shifts = [shift for part in self.parts if (shift := part._expected_shift) is not None]
        return np.concatenate(shifts, axis=-1) if shifts else None

    @cached_property
    def _affected_readings(self) -> tuple[Ints, Floats, Floats]:
        count = 3 * len(self.recording)
        flat = [part._extra_design.reshape(count, -1) for part in self.parts]
        rows = np.flatnonzero(np.any([design.any(axis=1) for design in flat], axis=0))
        design = np.stack([design[rows] for design in flat])
        sigma = np.stack([part.sigma.ravel()[rows] for part in self.parts])
        return rows, design, design / sigma[:, :, None]

    @cached_property
    def _other_design(self) -> tuple[Floats, Floats]:
        designs, nominal = zip(*(part._other_design for part in self.parts), strict=True)
        return np.stack(designs), np.concatenate(nominal, axis=1)

    def _linear_start(self, deviation: Floats, gauge_error: Floats | None) -> tuple[Floats, Floats]:
        x, predicted = np.zeros((self.sizes[-1], deviation.shape[2])), np.zeros_like(deviation)
        gradient, cost = np.empty_like(x), np.empty(x.shape[1])
        arguments = deviation, gauge_error, predicted, gradient, cost
        self._gradient(x, *arguments)
        x += self.step(gradient)
        self._gradient(x, *arguments)  # the predicted readings settle
        return x, predicted
