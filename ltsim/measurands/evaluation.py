"""Complete evaluation: results from readings, their uncertainty by two methods, budget and decisions."""

from dataclasses import dataclass

import numpy as np

from ltsim.adjustment.structure import raise_for_singular_network
from ltsim.calibration.result import frame_text
from ltsim.core.arrays import Bools, Floats
from ltsim.measurands.inputs import Inputs
from ltsim.measurands.measurands import Measurand, Output
from ltsim.measurands.propagation import (
    MAX_CURVATURE,
    LinearUncertainty,
    MonteCarloUncertainty,
    curvature,
    draw,
    expansion_of,
    propagate,
)
from ltsim.measurands.spec import Task, Tasks
from ltsim.measurands.uncertainty import BudgetPart, Distribution, HiddenPart, TaskResult, Uncertainty, conformity
from ltsim.recordings.coordinates import Coordinates
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import SourceEntry
from ltsim.solve.threads import single_threaded

MIN_HIDDEN_SHARE = 0.2
"""Smallest share of the standard uncertainty from which an error without effect on the readings is reported: it would
add 2 % to the uncertainty.
"""


@dataclass(frozen=True, repr=False)
class Evaluation:
    """Results of propagation and Monte Carlo for the tasks on a recording, as arrays.

    `result` is what `uncertainty` returns.
    """

    tasks: Tasks
    inputs: Inputs
    measurands: tuple[Measurand, ...]
    linear: LinearUncertainty
    """Uncertainty by the law of propagation (GUM)."""
    drawn: MonteCarloUncertainty
    """Uncertainty by Monte Carlo (JCGM 101)."""
    agrees: Bools
    """Flags (k,) that the linear interval agrees with that of the distribution (JCGM 101, clause 8)."""
    curved: Floats
    """Difference between the exact adjustment and its linear form, in standard uncertainties, (k,)."""

    @property
    def outputs(self) -> list[tuple[Task, Output]]:
        """Task and output of each of the k results, in order."""
        return [(m.task, output) for m in self.measurands for output in m.outputs]

    @property
    def warnings(self) -> list[str]:
        """Warnings on results that are less reliable than they appear, one sentence each."""
        air = self.inputs.air
        warnings = [f"all budgets include the {air}; change it as [air] of the task file or the set-up"] if air else []
        for i, (task, output) in enumerate(self.outputs):
            what = f"{task.name}, {output.name}"
            if self.curved[i] > MAX_CURVATURE:
                gap = f"deviation {self.curved[i]:.2g} of the uncertainty"
                warnings.append(f"{what}: the result is not linear within its uncertainty ({gap}); improve the network")
            elif not self.agrees[i] and self.drawn.stable[i]:
                warnings.append(f"{what}: the distribution is not normal; take the interval by Monte Carlo")
        if not self.drawn.stable.all():
            count = int(np.sum(~self.drawn.stable))
            warnings.append(
                f"{count} of {len(self.drawn.stable)} results are not stable to {self.tasks.monte_carlo.digits} digits "
                f"after {self.drawn.trials} trials; raise most_trials, or ask for fewer digits"
            )
        return warnings

    @property
    def result(self) -> Uncertainty:
        """Result with values and uncertainties in the units of the tasks."""
        origin = self.inputs.origin
        if isinstance(origin, Coordinates):
            source, frame, sigma0 = SourceEntry.listed(origin), "that of the list of coordinates", None
        else:
            source, frame, sigma0 = SourceEntry.of(origin.recording), frame_text(origin), origin.sigma0
        return Uncertainty(
            recording=source,
            title=self.tasks.title,
            source=self.tasks.source,
            coverage=self.tasks.monte_carlo.coverage,
            trials=self.drawn.trials,
            frame=frame,
            sigma0=sigma0,
            results=tuple(self._result(i, task, output) for i, (task, output) in enumerate(self.outputs)),
            correlation=tuple(tuple(row) for row in self.linear.correlation.tolist()),
            warnings=tuple(self.warnings),
        )

    def _result(self, i: int, task: Task, output: Output) -> TaskResult:
        unit, drawn = output.factor, self.drawn
        value, sigma = float(self.linear.values[i]) / unit, float(self.linear.sigma[i]) / unit
        wide = float(self.linear.expanded(self.tasks.monte_carlo.coverage)[i]) / unit
        tolerance, draws = task.tolerances.get(output.name), drawn.values[:, i] / unit
        return TaskResult(
            task=task.name,
            kind=task.kind,
            name=output.name,
            unit=output.unit,
            value=value,
            standard_uncertainty=sigma,
            coverage_factor=wide / sigma if sigma > 0 else 0.0,
            expanded_uncertainty=wide,
            monte_carlo=Distribution(
                mean=float(drawn.mean[i]) / unit,
                standard_uncertainty=float(drawn.sigma[i]) / unit,
                symmetric=(drawn.symmetric[i] / unit).tolist(),
                shortest=(drawn.shortest[i] / unit).tolist(),
                stable=bool(drawn.stable[i]),
                agrees=bool(self.agrees[i]),
            ),
            curvature=float(self.curved[i]),
            budget=self._budget(i, sigma),
            hidden=self._hidden(i, unit, sigma),
            conformity=None if tolerance is None else conformity(value, sigma, tolerance, self.tasks.decision, draws),
        )

    def _hidden(self, i: int, unit: float, sigma: float) -> tuple[HiddenPart, ...]:
        """Errors without effect on readings that change a result by `MIN_HIDDEN_SHARE` of its uncertainty or more."""
        changes = {
            name: abs(float(self.linear.by_points[i] @ moved)) / unit for name, moved in self.inputs.hidden.items()
        }
        ranked = sorted(changes, key=lambda name: -changes[name])
        return tuple(
            HiddenPart(source=name, change=changes[name]) for name in ranked if changes[name] > MIN_HIDDEN_SHARE * sigma
        )

    def _budget(self, i: int, sigma: float) -> tuple[BudgetPart, ...]:
        """Budget of one result: sources with their fraction of its variance, the largest first.

        The fractions add up to 1.
        """
        shares, kinds = {name: float(share[i]) for name, share in self.linear.shares.items()}, self.linear.kinds
        total = sum(shares.values())
        ranked = [
            (name, shares[name] / total if total > 0 else 0.0) for name in sorted(shares, key=lambda n: -shares[n])
        ]
        return tuple(
            BudgetPart(source=name, type=kinds[name], share=share, standard_uncertainty=float(np.sqrt(share)) * sigma)
            for name, share in ranked
        )


@raise_for_singular_network
def evaluate_tasks(recording: Recording, tasks: Tasks) -> Evaluation:
    """Results of tasks with their uncertainty by propagation and by Monte Carlo; errors as of `lt.uncertainty`."""
    return _evaluated(Inputs.of(recording, tasks), tasks)


def evaluate_listed_tasks(coordinates: Coordinates, tasks: Tasks) -> Evaluation:
    """Results of tasks on a list of coordinates with their covariance."""
    return _evaluated(Inputs.listed(coordinates, tasks), tasks)


@single_threaded
def _evaluated(inputs: Inputs, tasks: Tasks) -> Evaluation:
    """Results of tasks on points with known covariance."""
    measurands = tuple(Measurand.of(task, inputs.targets, inputs.points) for task in tasks.task)
    stretch = expansion_of(tasks.growth)
    linear = propagate(inputs, measurands, stretch)
    drawn = draw(inputs, measurands, stretch, tasks.monte_carlo, linear)
    gap = curvature(inputs, measurands, tasks.monte_carlo.seed)
    curved = gap / np.where(linear.sigma > 0, linear.sigma, np.inf)
    agrees = drawn.agrees(linear, tasks.monte_carlo.coverage)
    return Evaluation(tasks, inputs, measurands, linear, drawn, agrees, curved)
