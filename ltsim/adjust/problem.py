"""A recording as a least-squares problem: whitened residuals and a sparse design."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp

from ltsim.adjust.layout import Layout
from ltsim.adjust.rows import ControlRows, GaugeRows, LevelRows, free_motions
from ltsim.arrays import Bools, Floats, Ints
from ltsim.geometry.polar import wrap
from ltsim.model.construction import Construction
from ltsim.model.measurement import MeasurementModel, Prediction, State
from ltsim.recording.recording import Recording
from ltsim.solve.blocks import BlockSystem

DATUM_SIGMA = np.full(6, 1e-8)
"""Stiffness [m, rad] of the datum rows. Any value gives the same adjustment; the covariance of the first
station's frame wants one far below the sigmas of the network, the numbers one not too far."""
WEAK = 300.0


@dataclass(frozen=True)
class NetworkProblem:
    """Unknown poses, targets, instrument parameters and further effects of a recording.

    Rows of the system, in order: the measured readings (row by row, range azimuth elevation), gauge lengths,
    control points, levels, priors of the instrument parameters, datum.

    Attributes
    ----------
    model : MeasurementModel
    sigma : (n, 3) float
        Standard deviations of the readings.
    prior_sigma : (I, p) float
        Of the instrument parameters; infinite for none.
    extra_sigma : (q,) float
        Of the further effects' parameters; infinite for none.
    free : (6, f) float
        Rigid motions that only the datum holds.
    """

    model: MeasurementModel
    sigma: Floats
    prior_sigma: Floats
    extra_sigma: Floats
    free: Floats
    use: Bools
    gauge: GaugeRows
    control: ControlRows
    levels: LevelRows
    layout: Layout = field(init=False)

    def __post_init__(self) -> None:
        kept = set(self.gauge.first.tolist()) | set(self.gauge.second.tolist())
        object.__setattr__(self, "layout", Layout.of(self.model, kept))

    @classmethod
    def of(
        cls, model: MeasurementModel, points: Floats, *, sigma: Floats | None = None, use: Bools | None = None
    ) -> NetworkProblem:
        """The problem of a model; `points` (T, 3) are rough targets, `use` (n, 3) leaves readings out."""
        recording = model.recording
        control, levels = ControlRows.of(recording), LevelRows.of(recording)
        measured = recording.measured if use is None else recording.measured & use
        return cls(
            model=model,
            sigma=recording.sigma() if sigma is None else sigma,
            prior_sigma=prior_sigmas(recording, model.construction),
            extra_sigma=_weak_priors(model),
            free=free_motions(points, control, levels),
            use=measured,
            gauge=GaugeRows.of(recording),
            control=control,
            levels=levels,
        )

    def residuals(self, readings: Floats) -> Floats:
        """Observed minus predicted readings (n, 3), angles wrapped; NaN where not measured."""
        gap = self.model.recording.readings - readings
        gap[:, 1:] = wrap(gap[:, 1:])
        return gap

    def _residual_rows(self, state: State, readings: Floats) -> Floats:
        pointings = (self.residuals(readings) / self.sigma)[self.use]
        stated = self.gauge.predict(state.points) + self._gauge_by_extra(state) @ state.extra
        gauge = (self.gauge.length - stated) / self.gauge.sigma
        control = (self.control.points - state.points[self.control.target]) / self.control.sigma[:, None]
        levels = -self.levels.predict(state.rotation) / self.levels.sigma[:, None]
        prior = -(state.instrument / self.prior_sigma)[np.isfinite(self.prior_sigma)]
        extra = -(state.extra / self.extra_sigma)[np.isfinite(self.extra_sigma)]
        datum = np.zeros(self.free.shape[1])
        parts = [pointings, gauge, control.ravel(), levels.ravel(), prior, extra, datum]
        return np.concatenate(parts)

    def cost(self, state: State) -> float:
        """Weighted sum of squares at a state."""
        rows = self._residual_rows(state, self.model.predict(state))
        return float(rows @ rows)

    def retract(self, state: State, step: Floats) -> State:
        """The state after a step."""
        return self.layout.retract(state, step)

    def linearise(self, state: State) -> BlockSystem:
        """The whitened system at a state."""
        prediction = self.model.linearised(state)
        design = sp.vstack([self._pointing_design(prediction), self._other_design(state)], format="csr")
        rows = self._residual_rows(state, prediction.readings)
        return BlockSystem(sp.csr_array(design), rows, self.layout.kept)

    def _pointing_design(self, prediction: Prediction) -> sp.csr_array:
        """Design of the measured readings: every row has 6 + 3 + p + q entries."""
        recording, layout = self.model.recording, self.layout
        n = len(recording)
        blocks = np.concatenate(
            [prediction.by_pose, prediction.by_target, prediction.by_instrument, prediction.by_extra],
            axis=2,
        )
        columns = np.concatenate(
            [
                layout.pose[recording.station],
                layout.target[recording.target],
                layout.instrument[recording.instrument],
                np.broadcast_to(layout.extra, (n, len(layout.extra))),
            ],
            axis=1,
        )
        weighted = (blocks / self.sigma[:, :, None])[self.use]
        where = np.repeat(columns[:, None, :], 3, axis=1)[self.use]
        count, width = weighted.shape
        pointers = np.arange(0, (count + 1) * width, width)
        design = sp.csr_array((weighted.ravel(), where.ravel(), pointers), shape=(count, layout.size))
        design.eliminate_zeros()
        design.sort_indices()
        return design

    def _other_design(self, state: State) -> sp.csr_array:
        """Design of gauge, control, level, prior and datum rows."""
        layout, size = self.layout, self.layout.size
        gauge = sp.lil_array((len(self.gauge), size))
        directions = self.gauge.directions(state.points) / self.gauge.sigma[:, None]
        for i in range(len(self.gauge)):
            gauge[[i] * 3, layout.target[self.gauge.first[i]]] = directions[i]
            gauge[[i] * 3, layout.target[self.gauge.second[i]]] = -directions[i]
        gauge[:, layout.extra] = self._gauge_by_extra(state) / self.gauge.sigma[:, None]
        known = len(self.control)
        control = sp.coo_array(
            (
                np.repeat(1 / self.control.sigma, 3),
                (np.arange(3 * known), layout.target[self.control.target].ravel()),
            ),
            shape=(3 * known, size),
        )
        tilts = self.levels.derivative(state.rotation) / self.levels.sigma[:, None, None]
        turn = layout.pose[self.levels.station][:, None, 3:].repeat(2, axis=1)
        levels = sp.coo_array(
            (tilts.ravel(), (np.repeat(np.arange(2 * len(self.levels)), 3), turn.ravel())),
            shape=(2 * len(self.levels), size),
        )
        return sp.vstack(
            [
                sp.csr_array(gauge),
                control,
                levels,
                _diagonal_rows(self.prior_sigma, layout.instrument, size),
                _diagonal_rows(self.extra_sigma, layout.extra, size),
                self._datum_rows(state),
            ],
            format="csr",
        )

    def _gauge_by_extra(self, state: State) -> Floats:
        """Change (g, q) of the known lengths per unit of the further effects' parameters."""
        ends = self.gauge.first, self.gauge.second
        columns = [effect.gauge_design(*ends, state.points) for effect in self.model.effects]
        return np.hstack([np.zeros((len(self.gauge), 0)), *columns])

    def _datum_rows(self, state: State) -> sp.csr_array:
        """Rows that hold the first station against the free rigid motions."""
        motion = self.free / np.linalg.norm(self.free, axis=0)
        shifted = motion.copy()
        shifted[:3] += np.cross(motion[3:].T, state.position[0]).T
        rows = np.zeros((self.free.shape[1], self.layout.size))
        rows[:, self.layout.pose[0]] = (shifted / DATUM_SIGMA[:, None]).T
        return sp.csr_array(rows)

    @property
    def dof(self) -> int:
        """Rows with a value less unknowns; the free rigid motions are no loss, weak priors no gain."""
        priors = int(np.isfinite(self.prior_sigma).sum())
        known = len(self.gauge) + 3 * len(self.control) + 2 * len(self.levels) + priors
        return int(self.use.sum()) + known - self.layout.size + self.free.shape[1]


def prior_sigmas(recording: Recording, construction: Construction) -> Floats:
    """Prior standard deviations (I, p) [SI] of the construction's parameters for each instrument of a recording."""
    setup = recording.setup
    chosen = [setup.instruments.get(name, setup.instrument).prior for name in recording.instruments]
    rows = [[p.sigma_from(prior) for p in construction.parameters] for prior in chosen]
    return np.array(rows, dtype=np.float64).reshape(len(chosen), construction.size)


def _weak_priors(model: MeasurementModel) -> Floats:
    """Sigmas (q,) far beyond any plausible size: they only keep what the readings do not determine from diverging."""
    sizes = [p.prior_sigma for effect in model.effects for p in effect.parameters]
    return WEAK * np.array(sizes, dtype=np.float64)


def _diagonal_rows(sigma: Floats, columns: Ints, size: int) -> sp.csr_array:
    finite = np.isfinite(sigma)
    count = int(finite.sum())
    return sp.csr_array(sp.coo_array((1 / sigma[finite], (np.arange(count), columns[finite])), shape=(count, size)))
