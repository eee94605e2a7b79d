"""The whole evaluation: readings to results, uncertainty twice, budget, verdicts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from ltsim.arrays import Bools, Floats
from ltsim.notation import expanded
from ltsim.recording.recording import Recording
from ltsim.results import Column, Result, Table, numbers, texts
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


RESULTS = Table(
    "uncertainty.csv",
    "results of the tasks",
    (
        *texts(task="name", result="name", unit="of all numbers"),
        Column("value", "estimate", form=".9g", like="U"),
        Column("u", "standard uncertainty", form=".9g", shown=".2g"),
        Column("U", "expanded uncertainty for the coverage", form=".9g", like="U"),
        Column("mc_u", "standard uncertainty by Monte Carlo", form=".9g", shown=".2g"),
        Column("mc_low", "end of its interval", form=".9g", like="U"),
        Column("mc_high", "as mc_low", form=".9g", like="U"),
        Column("agrees", "True where both intervals agree", "flag"),
        *texts(judgement="against the tolerance, empty without one", largest_source="of its variance, with its share"),
    ),
)
BUDGET = Table(
    "budget.csv",
    "where the uncertainty comes from",
    (
        *texts(task="name", result="name", source="of uncertainty", type="A or B", unit="of u"),
        *numbers(".6g", share="of the variance", u="standard uncertainty from this source"),
    ),
)


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
        sizes, k = self.linear.expanded(coverage), float(special.ndtri(0.5 + coverage / 2))
        told = [
            f"{task.name}, {o.name}: {expanded(self.linear.values[i] / o.factor, sizes[i] / o.factor, o.unit, k)}"
            for i, (task, o) in enumerate(self.results[:MOST_TOLD])
        ]
        more = len(self.results) - len(told)
        head = f"{len(self.results)} results, {100 * coverage:g} % intervals, {self.drawn.trials} trials"
        return [head, *told, *([f"and {more} more: to_dataframe()"] if more > 0 else [])]

    def _tables(self) -> Mapping[str, Callable[[], Table]]:
        return {"results": lambda: RESULTS.filled(self._results()), "budget": lambda: BUDGET.filled(self._budget())}

    def _results(self) -> Iterator[list[Any]]:
        wide, judged = self.linear.expanded(self.tasks.monte_carlo.coverage), dict(self.conformities())
        for i, (task, output) in enumerate(self.results):
            sizes = self.linear.values[i], self.linear.sigma[i], wide[i], self.drawn.sigma[i], *self.drawn.symmetric[i]
            largest, share = worst_first(self.linear.shares, i)[0]
            yield [
                *(task.name, output.name, output.unit),
                *(float(size) / output.factor for size in sizes),
                bool(self.agrees[i]),
                judged[i].judgement if i in judged else "",
                f"{largest} ({100 * share:.0f} %)",
            ]

    def _budget(self) -> Iterator[list[Any]]:
        for i, (task, o) in enumerate(self.results):
            for name, share in worst_first(self.linear.shares, i):
                u = float(np.sqrt(share) * self.linear.sigma[i]) / o.factor
                kind = "B" if self.linear.kinds[name] == "B" else "A"
                yield [task.name, o.name, name, kind, o.unit, share, u]

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
