"""Where the linear covariance of a station fails: how far the readings bend within one standard deviation of its pose.

A covariance is right where readings are straight lines over the region it describes. A station that sees its targets
almost on one line, or all of them far away within a hand's breadth, may turn so far that they are not.
"""

from __future__ import annotations

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.arrays import Floats
from ltsim.geometry.polar import wrap

BENT = 0.3
"""Bend [standard deviations of a reading] within one standard deviation from which stated sigmas mislead."""
STRAIGHT = 0.03
"""Bend that a turn can make at most, below which a station need not be asked."""


def curvature(adjustment: Adjustment) -> Floats:
    """(S,) Bend of all readings over one standard deviation of each pose, along its least known direction.

    With f the whitened readings and v a step of one standard deviation of the network: |f(x + v) - 2 f(x) + f(x - v)|
    / 2. Zero where a pose is known so well that its turn cannot bend them, NaN where it is held.

    References
    ----------
    Bates and Watts, Nonlinear Regression Analysis and Its Applications (1988), 7.1: relative curvature, here of the
    parameters as they are and of the expectation surface together.
    """
    problem, state, spread = adjustment.problem, adjustment.state, adjustment.pose_covariance
    bend = np.where(np.isnan(spread).any(axis=(1, 2)), np.nan, 0.0)
    turn = np.trace(np.nan_to_num(spread)[:, 3:, 3:], axis1=1, axis2=2)
    for s in np.flatnonzero(_largest_bend(adjustment, turn) > STRAIGHT):
        columns = problem.unknowns.pose[s]
        size = np.sqrt(np.diag(spread[s]))
        unit = spread[s] / np.outer(size, size)
        worst = np.linalg.eigh(unit)[1][:, -1] / size
        direction = np.zeros((problem.unknowns.size, 1))
        direction[columns, 0] = worst
        carried = adjustment.factor.covariance_columns(direction)[:, 0]
        step = carried / np.sqrt(carried[columns] @ worst)
        here = problem.model.predict(state)
        there = [problem.model.predict(problem.retract(state, sign * step)) - here for sign in (1.0, -1.0)]
        for gap in there:
            gap[:, 1:] = wrap(gap[:, 1:])
        bend[s] = 0.5 * float(np.linalg.norm(((there[0] + there[1]) / problem.sigma)[problem.use]))
    return bend


def _largest_bend(adjustment: Adjustment, turn: Floats) -> Floats:
    """(S,) Most that turns of a variance (S,) can bend a station's readings, in their standard deviations."""
    recording, sightings = adjustment.recording, adjustment.sightings
    across = adjustment.problem.sigma * _reach(sightings.range_)
    finest = np.min(np.where(adjustment.problem.use, across, np.inf), axis=1)
    most = np.zeros(len(recording.stations))
    known = np.isfinite(finest)
    np.maximum.at(most, recording.station[known], (sightings.range_ / finest)[known])
    return 0.5 * turn * most


def _reach(range_: Floats) -> Floats:
    """(n, 3) Metres at the target per unit of a reading."""
    return np.stack([np.ones_like(range_), range_, range_], axis=1)
