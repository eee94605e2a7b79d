"""The law of propagation: uncertainty of each result, its budget, joint covariance of all tasks (JCGM 100, 102)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import special

from ltsim.adjustment import adjust
from ltsim.arrays import Floats
from ltsim.geometry.expansion import Expansion
from ltsim.randomness import stream
from ltsim.saved import Valued
from ltsim.tasks.inputs import Inputs
from ltsim.tasks.measurands import Measurand
from ltsim.tasks.spec import PartExpansion

CHECKS = 8
CURVED = 0.05
"""Share of a standard uncertainty by which the exact adjustment may miss the linear one before it is said."""


def expansion_of(growth: PartExpansion | None) -> Expansion:
    """The part's expansion as an input: it was too long by that factor when it was measured."""
    if growth is None:
        return Expansion()
    kelvin = growth.measured_c - growth.reference_c
    return Expansion.of(growth.expansion_per_k, kelvin, growth.sigma_expansion_per_k, growth.sigma_temperature_k)


def parts_of(stretch: Expansion) -> list[tuple[str, float]]:
    """Name and size of each error of the part's expansion."""
    named = [("expansion of the part", stretch.by_coefficient), ("temperature of the part", stretch.by_temperature)]
    return [(name, change) for name, change in named if change]


@dataclass(frozen=True)
class Propagated(Valued):
    """Results of all tasks together by the law of propagation."""

    values: Floats
    """(k,): results of all tasks, one after another [SI]."""
    covariance: Floats
    """(k, k)."""
    shares: dict[str, Floats]
    """(k,): variance of each result by source; they add up to the diagonal of the covariance."""
    kinds: dict[str, Literal["A", "B"]]
    """``A`` or ``B`` of each source."""
    by_points: Floats
    """(k, 3 T): derivative of the results by the points."""
    by_stretch: Floats
    """(k,): derivative by the part's expansion."""

    @property
    def sigma(self) -> Floats:
        """Standard uncertainty (k,)."""
        return np.sqrt(np.diag(self.covariance))

    def expanded(self, coverage: float) -> Floats:
        """Expanded uncertainty (k,) for a coverage probability, each result by itself (normal)."""
        return float(special.ndtri(0.5 + coverage / 2)) * self.sigma

    @property
    def correlation(self) -> Floats:
        """Correlation (k, k) of the results; NaN where a result has no uncertainty."""
        with np.errstate(invalid="ignore", divide="ignore"):
            correlation: Floats = self.covariance / np.outer(self.sigma, self.sigma)
        return correlation


def propagate(inputs: Inputs, measurands: Sequence[Measurand], stretch: Expansion) -> Propagated:
    """First-order propagation of every source through adjustment and tasks."""
    points = inputs.points
    values = np.concatenate([m.values(points, stretch.factor) for m in measurands])
    by_points = np.concatenate([m.by_points(points, stretch.factor) for m in measurands])
    by_stretch = np.concatenate([m.by_stretch(points, stretch.factor) for m in measurands])
    covariance = np.zeros((len(values), len(values)))
    shares: dict[str, Floats] = {}
    kinds: dict[str, Literal["A", "B"]] = {}
    for source in inputs.sources:
        reached = by_points @ source.response
        covariance += reached @ reached.T
        shares[source.name] = shares.get(source.name, 0.0) + np.sum(reached**2, axis=1)
        kinds[source.name] = source.kind
    for name, sigma in parts_of(stretch):
        reached = by_stretch * sigma
        covariance += np.outer(reached, reached)
        shares[name] = reached**2
        kinds[name] = "B"
    return Propagated(values, covariance, shares, kinds, by_points, by_stretch)


def curvature(inputs: Inputs, measurands: Sequence[Measurand], seed: int) -> Floats:
    """Largest gap (k,) [SI] between exact and linear change of each result, adjusted anew with a few draws of noise."""
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
