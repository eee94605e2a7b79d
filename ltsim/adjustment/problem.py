"""Recording as a least-squares problem: whitened residuals and their design."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ltsim.adjustment.prior import ParameterPrior, prior_sigmas
from ltsim.adjustment.rows import (
    ControlRows,
    DifferenceRows,
    GaugeRows,
    LevelRows,
    Marks,
    YawRows,
    free_motions,
)
from ltsim.adjustment.structure import NetworkRows, Unknowns
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.geometry.polar import wrap
from ltsim.geometry.rotations import cross_matrix
from ltsim.physics.model.measurement import MeasurementModel, NetworkState, Prediction
from ltsim.solve.design import PIECE, Design, Pattern, as_dense
from ltsim.solve.elimination import BlockSystem

DATUM_SIGMA = np.full(6, 1e-8)
"""Standard deviation [m, rad] of the datum rows. Any value gives the same adjustment; it must be far below the sigmas
of the network for correct covariances, but not so small that it impairs the numerics.
"""
WEAK = 300.0
"""Standard deviation, in prior sigmas, of weak priors on additional effects: far beyond any plausible size."""


@dataclass(frozen=True)
class NetworkProblem(NetworkRows):
    """Unknown poses, targets, instrument parameters and additional effects of a recording.

    Rows of the system, in order: the measured readings (row by row, range azimuth elevation), gauge lengths, control
    points, known marks under stations, known differences, levels, yaws, constraints of undetermined unknowns, priors of
    the instrument parameters, weak priors of the additional effects, datum.
    """

    sigma: Floats
    """Standard deviations of the readings, (n, 3)."""
    prior: ParameterPrior
    """Prior of the instrument parameters."""
    extra_sigma: Floats
    """Standard deviations of weak priors on the additional effects' parameters, (q,); infinite for none."""
    free: Floats
    """Rigid motions that only the datum fixes, (6, f)."""

    @classmethod
    def of(
        cls,
        model: MeasurementModel,
        *,
        sigma: Floats | None = None,
        use: Bools | None = None,
        held_to: float = WEAK,
        prior: ParameterPrior | None = None,
    ) -> NetworkProblem:
        """Problem of a model.

        `use` (n, 3) selects readings, `held_to` is the weak prior of additional effects in plausible sizes.

        The default `prior` of the instrument parameters is the one declared in the set-up.
        """
        recording = model.recording
        marks = Marks.of(recording)
        used = recording.usable if use is None else recording.usable & use
        gauge, control, levels = GaugeRows.of(recording), ControlRows.of(recording), LevelRows.of(recording, used)
        mark_control, yaws = ControlRows.of_stations(recording, marks), YawRows.of(recording, used)
        differences = DifferenceRows.between(recording, marks)
        plausible = [held_to * size for effect in model.effects for size in effect.size_scales]
        plausible += [size for errors in model.nuisance_errors for size in errors.size_scales]
        return cls(
            model=model,
            sigma=recording.sigma() if sigma is None else sigma,
            prior=prior or ParameterPrior.independent(prior_sigmas(recording, model.construction)),
            extra_sigma=np.array(plausible, dtype=np.float64),
            free=free_motions(control, mark_control, differences, levels, yaws),
            use=used,
            gauge=gauge,
            control=control,
            levels=levels,
            yaws=yaws,
            marks=marks,
            mark_control=mark_control,
            differences=differences,
            unknowns=Unknowns.of(model, gauge, marks, differences),
        )

    def on(self, model: MeasurementModel) -> NetworkProblem:
        """Problem of another model of the same pointings, with its declarations and the present weights."""
        changed = NetworkProblem.of(model, sigma=self.sigma, use=self.use, prior=self.prior)
        differences = changed.differences.subset(np.isin(changed.differences.names, self.differences.names))
        return replace(changed, extra_sigma=self.extra_sigma, differences=differences)

    def elsewhere(self, model: MeasurementModel) -> NetworkProblem:
        """Problem of the same set-up and pointings, in any order, with stations and targets at other positions."""
        moved, mine, theirs = replace(self, model=model), self.model.recording, model.recording
        moved = replace(moved, sigma=theirs.sigma())
        vars(moved)["structure"] = self.structure
        if np.array_equal(mine.station, theirs.station) and np.array_equal(mine.target, theirs.target):
            vars(moved)["_pattern"] = self._pattern
        return moved

    def unplaced(self, lost: Bools) -> Bools:
        """Flags (k,) of the differences to `lost` targets (T,), to unread set-ups, or to an undetermined height."""
        structure, stations = self.structure, len(self.unknowns.pose)
        stands, heights = np.zeros((2, stations + 1), dtype=bool)
        stands[structure.unread_stations], heights[structure.height] = True, True
        gone = np.concatenate([lost, stands])[self.differences.ends].any(axis=0)
        open_ = np.concatenate([structure.height_free_targets, heights])[self.differences.ends].any(axis=0)
        return np.asarray(gone | (open_ & self.differences.axes[:, 2]))

    def residuals(self, readings: Floats) -> Floats:
        """Observed minus predicted readings (n, 3), angles wrapped; NaN if not measured."""
        gap = self.model.recording.readings - readings
        gap[:, 1:] = wrap(gap[:, 1:])
        return gap

    def residual(self, state: NetworkState) -> Floats:
        """Whitened residual (m,) of all rows at a state."""
        return self._residual_rows(state, self.model.predict(state))

    def _residual_rows(self, state: NetworkState, readings: Floats) -> Floats:
        pointings = (self.residuals(readings) / self.sigma)[self.use]
        gauge = self.gauge.whitened(self.length_residuals(state))
        control = self.control.residual(state.target_points[self.control.target])
        marks = self.mark_control.residual(state.station_positions[self.mark_control.target])
        differences = self.differences.residual(self.differences.predict(state.target_points, state.station_positions))
        levels = -self.levels.predict(state.station_rotations) / self.levels.sigma[:, None]
        yaws = self.yaws.residual(state.station_rotations) / self.yaws.sigma
        held = np.zeros(self.structure.held)
        prior = self.prior.residual(state.instrument_parameters)
        extra = -(state.extra_parameters / self.extra_sigma)[np.isfinite(self.extra_sigma)]
        datum = np.zeros(self.free.shape[1])
        references = pointings, gauge, control, marks, differences, levels.ravel(), yaws
        return np.concatenate([*references, held, prior, extra, datum])

    def length_residuals(self, state: NetworkState) -> Floats:
        """Declared minus adjusted lengths (g,) [m]."""
        return (
            self.gauge.length
            - self.gauge.predict(state.target_points)
            - self._gauge_by_extra(state) @ state.extra_parameters
        )

    def retract(self, state: NetworkState, step: Floats) -> NetworkState:
        """State after a step."""
        at = self.unknowns
        return state.incremented(step[at.pose], step[at.target], step[at.instrument], step[at.extra])

    def linearise(self, state: NetworkState) -> BlockSystem:
        """Whitened linear system at a state."""
        return self.system(state, self.model.linearised(state))

    def system(self, state: NetworkState, prediction: Prediction) -> BlockSystem:
        """Whitened linear system at a state whose predicted readings are given."""
        residual, values = self._residual_rows(state, prediction.readings), self._values(state, prediction)
        del prediction  # which takes as much memory as the design
        design = self._pattern.filled(values)
        if self.gauge.root is not None:
            design = self._with_shared_errors(design)
        return BlockSystem(design, residual, self.unknowns.n_reduced)

    def _with_shared_errors(self, design: Design) -> Design:
        """Design in which the rows of lengths with shared errors are transformed to independent ones."""
        first = int(self.use.sum())
        last = first + len(self.gauge)
        lengths = self.gauge.uncorrelated(as_dense(design[first:last]))
        if isinstance(design, np.ndarray):
            return np.vstack([design[:first], lengths, design[last:]])
        return sp.vstack([design[:first], sp.csr_array(lengths), design[last:]], format="csr")

    @cached_property
    def _pattern(self) -> Pattern:
        """Sparsity pattern of the design matrix, common to all states."""
        return Pattern(self._columns(), self.unknowns.size)

    def _columns(self) -> list[Ints]:
        """Columns (rows, width) of each kind of row, in the order of the system."""
        recording, at, gauge = self.model.recording, self.unknowns, self.gauge
        blocks = at.pose[recording.station], at.target[recording.target], at.instrument[recording.instrument]
        pointings = np.concatenate([*blocks, np.tile(at.extra, (len(recording), 1))], axis=1)
        ends = at.target[gauge.first], at.target[gauge.second], np.tile(at.extra, (len(gauge), 1))
        anchors = at.pose[self.structure.anchors].ravel()
        return [
            pointings[np.nonzero(self.use)[0]],
            np.concatenate(ends, axis=1),
            np.repeat(at.target[self.control.target], self.control.axes.sum(axis=1), axis=0),
            np.repeat(at.pose[self.mark_control.target, :3], self.mark_control.axes.sum(axis=1), axis=0),
            np.repeat(at.places[self.differences.ends.T].reshape(-1, 6), self.differences.axes.sum(axis=1), axis=0),
            np.repeat(at.pose[self.levels.station, 3:], 2, axis=0),
            at.pose[self.yaws.station, 3:],
            self.structure.held_columns,
            self._prior_columns(),
            at.extra[np.isfinite(self.extra_sigma)][:, None],
            np.tile(anchors, (self.free.shape[1], 1)),
        ]

    def _values(self, state: NetworkState, prediction: Prediction) -> Iterator[Floats]:
        """Whitened derivatives (rows, width) in the order of `_columns`."""
        yield from self._reading_values(prediction)
        direction = self.gauge.directions(state.target_points)
        gauge = np.concatenate([direction, -direction, self._gauge_by_extra(state)], axis=1)
        yield gauge / self.gauge.sigma[:, None]
        yield self.control.weights()
        yield self.mark_control.weights()
        yield self.differences.derivatives()
        yield self.levels.derivative(state.station_rotations) / self.levels.sigma[:, None, None]
        yield self.yaws.derivative(state.station_rotations) / self.yaws.sigma[:, None]
        yield self.structure.held_directions(state) / DATUM_SIGMA[0]
        yield self.prior.roots if self.prior.correlated else 1.0 / self.prior.sigma[np.isfinite(self.prior.sigma)]
        yield 1.0 / self.extra_sigma[np.isfinite(self.extra_sigma)]
        yield self._datum_values(state)

    def _reading_values(self, prediction: Prediction) -> Iterator[Floats]:
        """Whitened derivatives (r, width) of the readings in use, of some pointings after the others."""
        by = [
            prediction.pose_derivatives,
            prediction.target_derivatives,
            prediction.instrument_derivatives,
            prediction.extra_derivatives,
        ]
        held = self.prior.held[self.model.recording.instrument][:, None]
        step = PIECE // 3
        for first in range(0, len(self.use), step):
            piece = slice(first, first + step)
            parts = [part[piece] for part in by]
            if held.any():  # a held parameter meets its own prior alone, which leaves it at its mean
                parts[2] = np.where(held[piece], 0.0, parts[2])
            use = self.use[piece]
            yield np.concatenate(parts, axis=2)[use] / self.sigma[piece][use][:, None]

    def _prior_columns(self) -> Ints:
        """Columns (m, 1) of the prior's rows, or (m, p) if it correlates parameters."""
        columns = self.unknowns.instrument
        if self.prior.correlated:
            return np.repeat(columns, columns.shape[1], axis=0)
        return columns[np.isfinite(self.prior.sigma)][:, None]

    def _gauge_by_extra(self, state: NetworkState) -> Floats:
        """Change (g, q) of the reference lengths per unit of the additional effects' parameters."""
        ends = self.gauge.first, self.gauge.second
        columns = [effect.gauge_design(*ends, state.target_points) for effect in self.model.extra_effects]
        return np.hstack([np.zeros((len(self.gauge), 0)), *columns])

    def _datum_values(self, state: NetworkState) -> Floats:
        """Datum rows (f, 6 a) that fix the free rigid motions at the anchor stations."""
        anchors = self.structure.anchors
        motion = self.free / np.linalg.norm(self.free, axis=0)
        turn = np.broadcast_to(motion[3:].T[:, None, :], (motion.shape[1], len(anchors), 3))
        across = (cross_matrix(turn) @ state.station_positions[anchors][:, :, None])[..., 0]
        shift = motion[:3].T[:, None, :] + across
        rows = np.concatenate([shift, turn if self.structure.anchors_turn else np.zeros_like(shift)], axis=2)
        return rows.reshape(len(rows), 6 * len(anchors)) / np.tile(DATUM_SIGMA, len(anchors))

    @cached_property
    def level_rows(self) -> slice:
        """Rows of the system that are levels, two per station."""
        first = int(self.use.sum()) + len(self.gauge) + self.control.count + self.mark_control.count
        first += self.differences.count
        return slice(first, first + 2 * len(self.levels))

    @property
    def dof(self) -> int:
        """Degrees of freedom: observations minus unknowns.

        Free rigid motions are not subtracted, weak priors not added.
        """
        priors = int(np.isfinite(self.prior.sigma).sum())
        lengths = int(np.isfinite(self.gauge.sigma).sum())
        lengths -= lengths > 0 and not self.gauge.determine_scale
        nuisances = sum(len(errors.parameters) for errors in self.model.nuisance_errors)
        references = self.control.count + self.mark_control.count + self.differences.count
        references += lengths + 2 * len(self.levels) + len(self.yaws) + priors + nuisances
        free = self.free.shape[1] - self.structure.in_plan
        unknown = self.unknowns.size - free - self.structure.held + self.structure.constraints_on_unseen
        return int(self.use.sum()) + references - unknown
