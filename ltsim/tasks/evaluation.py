"""The whole evaluation: readings to results, uncertainty twice, budget, verdicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Bools, Floats
from ltsim.recording.recording import Recording
from ltsim.results import Columns, Result, by_row
from ltsim.solve.threads import in_one_thread
from ltsim.tasks.inputs import Inputs
from ltsim.tasks.linearity import CURVED, curvature
from ltsim.tasks.measurands import Measurand, Output
from ltsim.tasks.montecarlo import Drawn, draw
from ltsim.tasks.propagation import Propagated, expansion_of, propagate
from ltsim.tasks.spec import Task, Tasks
from ltsim.tasks.verdict import Conformity, conformity

MOST_TOLD = 8
"""Results that stand in the few lines of an evaluation."""


@dataclass(frozen=True, repr=False)
class Evaluation(Result):
    """What tasks on a recording are worth."""

    tasks: Tasks
    inputs: Inputs
    measurands: tuple[Measurand, ...]
    linear: Propagated
    """By the law of propagation."""
    drawn: Drawn
    """By Monte Carlo."""
    agrees: Bools
    """(k,): whether the linear interval is that of the distribution (JCGM 101, clause 8)."""
    curved: Floats
    """(k,): gap between the exact adjustment and its linear form, in standard uncertainties."""

    def _lines(self) -> list[str]:
        coverage = self.tasks.monte_carlo.coverage
        expanded = self.linear.expanded(coverage)
        told = [
            f"{task.name}, {o.name}: {self.linear.values[i] / o.factor:.6f} +- {expanded[i] / o.factor:.2g} {o.unit}"
            for i, (task, o) in enumerate(self.results[:MOST_TOLD])
        ]
        more = len(self.results) - len(told)
        head = f"{len(self.results)} results, {100 * coverage:g} % intervals, {self.drawn.trials} trials"
        return [head, *told, *([f"and {more} more: to_dataframe()"] if more > 0 else [])]

    def _tables(self) -> Mapping[str, Callable[[], Columns]]:
        return {"results": self._results, "budget": self._budget}

    def _results(self) -> Columns:
        factor = np.array([output.factor for _, output in self.results])
        return {
            "task": [task.name for task, _ in self.results],
            "result": [output.name for _, output in self.results],
            "unit": [output.unit for _, output in self.results],
            "value": list(self.linear.values / factor),
            "standard_uncertainty": list(self.linear.sigma / factor),
            "expanded_uncertainty": list(self.linear.expanded(self.tasks.monte_carlo.coverage) / factor),
            "low": list(self.drawn.symmetric[:, 0] / factor),
            "high": list(self.drawn.symmetric[:, 1] / factor),
            "agrees": list(self.agrees),
        }

    def _budget(self) -> Columns:
        rows = [
            {"task": task.name, "result": o.name, "source": name, "type": self.linear.kinds[name], "share": share}
            for i, (task, o) in enumerate(self.results)
            for name, share in worst_first(self.linear.shares, i)
        ]
        return by_row(rows)

    @property
    def results(self) -> list[tuple[Task, Output]]:
        """Task and output of each of the k results, in order."""
        return [(m.task, output) for m in self.measurands for output in m.outputs]

    def conformities(self) -> list[tuple[int, Conformity]]:
        """Index and verdict of every result that has a tolerance."""
        found = []
        for i, (task, output) in enumerate(self.results):
            if output.name in task.tolerances:
                value, sigma = self.linear.values[i] / output.factor, self.linear.sigma[i] / output.factor
                draws = self.drawn.values[:, i] / output.factor
                verdict = conformity(value, sigma, task.tolerances[output.name], self.tasks.decision, draws)
                found.append((i, verdict))
        return found

    @property
    def warnings(self) -> list[str]:
        """What makes a figure less than it seems, one sentence each."""
        told = []
        for i, (task, output) in enumerate(self.results):
            what = f"{task.name}, {output.name}"
            if self.curved[i] > CURVED:
                gap = f"off by {self.curved[i]:.2g} of it"
                told.append(f"{what}: the adjustment is not linear over its uncertainty ({gap}); the network is weak")
            elif not self.agrees[i] and self.drawn.stable[i]:
                told.append(f"{what}: the distribution is not normal; take the interval by Monte Carlo")
        if not self.drawn.stable.all():
            count = int(np.sum(~self.drawn.stable))
            told.append(
                f"{count} of {len(self.drawn.stable)} results are not stable to {self.tasks.monte_carlo.digits} digits "
                f"after {self.drawn.trials} trials; raise most_trials, or ask for fewer digits"
            )
        return told


@in_one_thread
def evaluate_tasks(recording: Recording, tasks: Tasks) -> Evaluation:
    """Evaluate tasks on a recording: results, uncertainty by propagation and by Monte Carlo, verdicts.

    Raises
    ------
    NetworkError, ConvergenceError
        When the recording's network cannot be solved.
    ModelError, SetupError
        When a task names what does not exist or is not determined.
    """
    inputs = Inputs.of(recording, tasks)
    measurands = tuple(Measurand.of(task, inputs.targets, inputs.points) for task in tasks.task)
    stretch = expansion_of(tasks.growth)
    linear = propagate(inputs, measurands, stretch)
    drawn = draw(inputs, measurands, stretch, tasks.monte_carlo, linear)
    gap = curvature(inputs, measurands, tasks.monte_carlo.seed)
    curved = gap / np.where(linear.sigma > 0, linear.sigma, np.inf)
    agrees = drawn.agrees(linear, tasks.monte_carlo.coverage)
    return Evaluation(tasks, inputs, measurands, linear, drawn, agrees, curved)


def worst_first(shares: dict[str, Floats], index: int) -> Sequence[tuple[str, float]]:
    """Sources of one result with their share of its variance, the largest first; they add up to 1."""
    total = float(sum(share[index] for share in shares.values()))
    ranked = sorted(shares, key=lambda name: -shares[name][index])
    return [(name, float(shares[name][index]) / total if total > 0 else 0.0) for name in ranked]
