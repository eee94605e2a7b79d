"""How far the adjustment itself is from linear: a few recordings with drawn errors are adjusted anew, exactly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ltsim.adjustment import adjust
from ltsim.arrays import Floats
from ltsim.randomness import stream
from ltsim.tasks.inputs import Inputs
from ltsim.tasks.measurands import Measurand

CHECKS = 8
CURVED = 0.05
"""Share of a standard uncertainty by which the exact adjustment may miss the linear one before it is said."""


def curvature(inputs: Inputs, measurands: Sequence[Measurand], seed: int) -> Floats:
    """Largest gap (k,) [SI] between exact and linear change of each result over a few draws of the readings' noise."""
    found = inputs.adjustment
    recording, problem = found.recording, found.problem
    at = [recording.targets.index(name) for name in inputs.targets]
    used, count = problem.use, int(problem.use.sum())
    worst = np.zeros(sum(len(m.outputs) for m in measurands))
    for i in range(CHECKS):
        noise = stream(seed, "curvature", i).standard_normal(count)
        readings = recording.readings.copy()
        readings[used] += noise * problem.sigma[used]
        again = adjust(
            recording.with_readings(readings),
            found.construction,
            sigma=problem.sigma,
            use=problem.use,
            start=found.state,
            datum=found.datum.names if found.datum is not None else None,
        )
        shift = (noise @ inputs.reach[:count]).reshape(-1, 3)
        linear = np.concatenate([m.values(inputs.points + shift) for m in measurands])
        exact = np.concatenate([m.values(again.state.points[at]) for m in measurands])
        worst = np.maximum(worst, np.abs(exact - linear))
    return worst
