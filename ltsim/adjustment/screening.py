"""Gross errors seen before any adjustment: pointings that land elsewhere by more than any tracker error."""

from __future__ import annotations

import numpy as np

from ltsim.adjustment.loose import without_loose
from ltsim.adjustment.problem import NetworkProblem
from ltsim.arrays import Bools, Floats
from ltsim.geometry.polar import wrap
from ltsim.model.construction import ideal
from ltsim.model.measurement import MeasurementModel, State
from ltsim.recording.recording import Recording
from ltsim.solve.blocks import Factor, SingularSystemError
from ltsim.solve.robust import median_deviation

LARGEST_ERROR = 1e-3
"""[m] what no tracker error of a plausible size reaches at workshop range."""
WORKSHOP = 10.0
"""[m] range up to which that holds; beyond, errors of the angles grow with the range."""
FACTOR = 30.0
PASSES = 20
SETTLED = 0.9
"""A gross miss that still shrinks to less than this share of itself in a pass is not settled yet."""


def gross_pointings(recording: Recording, position: Floats, rotation: Floats, points: Floats) -> Bools:
    """(n,) True where a pointing misses its target by far more than the rest of the recording does.

    A swapped or misnamed reflector, a wrong unit in one row. These rows stay out of the adjustment and are reported.
    """
    return screened(recording, position, rotation, points)[1]


def screened(
    recording: Recording, position: Floats, rotation: Floats, points: Floats
) -> tuple[tuple[Floats, Floats, Floats], Bools]:
    """Positions, rotations and targets freed of the start's own errors, and the gross pointings (n,) left then.

    A long chain of stations that was joined one by one does not close; what looks gross there may only be that. So
    where anything looks gross the network is relaxed, with such pointings held loosely, until the verdict stands.
    """
    model = MeasurementModel(recording, ideal())
    state = State(position, rotation, points, np.zeros((len(recording.instruments), 0)))
    excess = _excess(model, state)
    for _ in range(PASSES if np.any(excess > 1.0) else 0):
        loose = np.maximum(excess, 1.0)[:, None]
        problem = without_loose(NetworkProblem.of(model, sigma=recording.sigma() * loose), state)
        try:
            state = problem.retract(state, Factor(problem.linearise(state)).step())
        except SingularSystemError:
            break
        before, excess = excess, _excess(model, state)
        if not np.any((excess > 1.0) & (excess < SETTLED * before)):
            break
    return (state.position, state.rotation, state.points), excess > 1.0


def _excess(model: MeasurementModel, state: State) -> Floats:
    """Miss (n,) of each pointing in parts of what is still no gross error."""
    readings, predicted = model.recording.readings, model.predict(state)
    gap = readings - predicted
    gap[:, 1:] = wrap(gap[:, 1:])
    range_ = model.geometry(state).range_
    gap[:, 1] *= range_ * np.cos(predicted[:, 2])
    gap[:, 2] *= range_
    miss = np.linalg.norm(np.nan_to_num(gap), axis=1)
    limit = np.maximum(LARGEST_ERROR * np.maximum(1.0, range_ / WORKSHOP), FACTOR * median_deviation(miss))
    return miss / limit
