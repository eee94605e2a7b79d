"""Evaluation of tasks: results with uncertainty by propagation and by Monte Carlo, budgets, conformity decisions."""

from dataclasses import dataclass

import numpy as np

from ltsim.adjustment.structure import raise_for_singular_network
from ltsim.calibration.reported_uncertainty import MIN_RELATIVE_HIDDEN_DISPLACEMENT
from ltsim.calibration.result import frame_text
from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import ModelError
from ltsim.core.limits import MAX_UNCERTAINTY_TASK_RESULTS
from ltsim.core.parallel import single_threaded
from ltsim.measurands.inputs import TaskInputs
from ltsim.measurands.measurands import Measurand, TaskOutput
from ltsim.measurands.propagation import (
    MAX_NONLINEARITY_RATIO,
    TRIALS_PER_BATCH,
    LinearUncertainty,
    MonteCarloUncertainty,
    max_nonlinearity_differences,
    propagate,
    run_monte_carlo,
    thermal_expansion_of_part,
)
from ltsim.measurands.spec import Task, Tasks
from ltsim.measurands.uncertainty import (
    BudgetEntry,
    HiddenErrorEntry,
    MonteCarloDistribution,
    TaskResult,
    Uncertainty,
    evaluate_conformity,
)
from ltsim.recordings.epoch_coordinates import EpochCoordinates
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import ResultSource


@dataclass(frozen=True, repr=False)
class TaskEvaluation:
    """Results of all tasks as arrays, with their uncertainty by propagation (GUM) and by Monte Carlo (JCGM 101).

    A task is a measurand (such as a length) with its targets; it can have several results, such as x, y and z.
    `to_result` converts the arrays to the result of `uncertainty`.
    """

    tasks: Tasks
    """Tasks of the task file, with the options of the evaluation."""
    inputs: TaskInputs
    """Points that the tasks use, with the sources of their uncertainty."""
    measurands: tuple[Measurand, ...]
    """Measurand (function of points) of each task."""
    linear_uncertainty: LinearUncertainty
    """Uncertainty by the law of propagation (GUM)."""
    monte_carlo_uncertainty: MonteCarloUncertainty
    """Uncertainty by Monte Carlo (JCGM 101)."""
    intervals_agree: Bools
    """Mask (results,): True if a result's intervals by propagation and by Monte Carlo agree (JCGM 101, clause 8)."""
    nonlinearity_ratios: Floats
    """Difference of each result between the exact and the linearised adjustment, divided by the standard uncertainty of
    the result, shape (results,)."""

    @property
    def outputs(self) -> list[tuple[Task, TaskOutput]]:
        """Task, and name and unit, of each result in the order of the results."""
        return [(m.task, output) for m in self.measurands for output in m.outputs]

    @property
    def warnings(self) -> list[str]:
        """Warnings on the air, on the recording and on single results (nonlinear, not normally distributed)."""
        air = self.inputs.air_text
        warnings = (
            [f"all budgets include the {air}; change these values in the table [air] of the task file or of the set-up"]
            if air
            else []
        )
        warnings += [] if self.inputs.network is None else self.inputs.network.warnings
        for i, (task, output) in enumerate(self.outputs):
            what = f"{task.name}, {output.name}"
            if self.nonlinearity_ratios[i] > MAX_NONLINEARITY_RATIO:
                gap = f"difference of {self.nonlinearity_ratios[i]:.2g} standard uncertainties"
                warnings.append(f"{what}: uncertainty too large for a linear adjustment ({gap}); improve the network")
            elif not self.intervals_agree[i] and self.monte_carlo_uncertainty.is_stable[i]:
                warnings.append(f"{what}: the distribution is not normal; use the interval by Monte Carlo")
        if not self.monte_carlo_uncertainty.is_stable.all():
            count = int(np.sum(~self.monte_carlo_uncertainty.is_stable))
            is_limited = self.monte_carlo_uncertainty.n_trials + TRIALS_PER_BATCH <= self.tasks.monte_carlo.max_trials
            remedy = "divide the tasks among several task files" if is_limited else "increase max_trials"
            warnings.append(
                f"{count} of {len(self.monte_carlo_uncertainty.is_stable)} results are not stable to "
                f"{self.tasks.monte_carlo.digits} digits "
                f"after {self.monte_carlo_uncertainty.n_trials} trials; {remedy}, or ask for fewer digits"
            )
        return warnings

    @property
    def to_result(self) -> Uncertainty:
        """Result of `uncertainty`, with values and uncertainties in the units of the tasks."""
        network_or_coordinates, network = self.inputs.network_or_coordinates, self.inputs.network
        if isinstance(network_or_coordinates, EpochCoordinates):
            source, frame, sigma0 = (
                ResultSource.from_coordinates(network_or_coordinates),
                "that of the list of coordinates",
                None,
            )
        else:
            source = (
                ResultSource.from_recording(network_or_coordinates.recording)
                if network is None
                else network.recording_entry
            )
            frame, sigma0 = frame_text(network_or_coordinates), network_or_coordinates.sigma0
        return Uncertainty(
            recording=source,
            title=self.tasks.title,
            source=self.tasks.source,
            coverage_probability=self.tasks.monte_carlo.coverage_probability,
            trials=self.monte_carlo_uncertainty.n_trials,
            frame=frame,
            sigma0=sigma0,
            results=tuple(self._task_result(i, task, output) for i, (task, output) in enumerate(self.outputs)),
            correlation=tuple(tuple(row) for row in self.linear_uncertainty.correlation.tolist()),
            warnings=tuple(self.warnings),
            uncertainty_factor=1.0 if network is None else network.uncertainty_factor,
            corrections_text="" if network is None else network.corrections_text,
            tests=() if network is None else network.tests,
        )

    def _task_result(self, result_index: int, task: Task, task_output: TaskOutput) -> TaskResult:
        """Entry of uncertainty.json for the result with index `result_index`, with its budget and conformity."""
        unit, drawn = task_output.si_per_unit, self.monte_carlo_uncertainty
        linear, coverage_probability = self.linear_uncertainty, self.tasks.monte_carlo.coverage_probability
        value, sigma = (
            float(linear.result_values[result_index]) / unit,
            float(linear.standard_uncertainties[result_index]) / unit,
        )
        half_width = float(linear.expanded_uncertainty(coverage_probability)[result_index]) / unit
        tolerance, draws = task.tolerances.get(task_output.name), drawn.trial_results[:, result_index] / unit
        return TaskResult(
            task=task.name,
            kind=task.kind,
            name=task_output.name,
            unit=task_output.unit,
            value=value,
            standard_uncertainty=sigma,
            coverage_factor=half_width / sigma if sigma > 0 else 0.0,
            expanded_uncertainty=half_width,
            monte_carlo=MonteCarloDistribution(
                mean=float(drawn.means[result_index]) / unit,
                standard_uncertainty=float(drawn.standard_uncertainties[result_index]) / unit,
                symmetric_interval=(drawn.symmetric_intervals[result_index] / unit).tolist(),
                shortest_interval=(drawn.shortest_intervals[result_index] / unit).tolist(),
                is_stable=bool(drawn.is_stable[result_index]),
                intervals_agree=bool(self.intervals_agree[result_index]),
            ),
            nonlinearity_ratio=float(self.nonlinearity_ratios[result_index]),
            budget=self._budget_entries(result_index, sigma),
            hidden_errors=self._hidden_errors(result_index, unit, sigma),
            conformity=None
            if tolerance is None
            else evaluate_conformity(value, sigma, tolerance, self.tasks.decision, draws),
        )

    def _hidden_errors(self, result_index: int, unit: float, sigma: float) -> tuple[HiddenErrorEntry, ...]:
        """Errors that change no reading but change the result noticeably compared with its standard uncertainty.

        `unit` is the unit of the result in SI units, `sigma` the standard uncertainty of the result in this unit.
        """
        change_by_target = {
            name: abs(float(self.linear_uncertainty.point_derivatives[result_index] @ moved)) / unit
            for name, moved in self.inputs.displacements_by_shared_air_error.items()
        }
        ranked = sorted(change_by_target, key=lambda name: -change_by_target[name])
        return tuple(
            HiddenErrorEntry(error_text=name, result_change=change_by_target[name])
            for name in ranked
            if change_by_target[name] > MIN_RELATIVE_HIDDEN_DISPLACEMENT * sigma
        )

    def _budget_entries(self, result_index: int, sigma: float) -> tuple[BudgetEntry, ...]:
        """Budget of a result: fraction of its variance from each source of uncertainty, the largest fraction first.

        The fractions sum to 1. `sigma` is the standard uncertainty of the result in its unit.
        """
        shares, kinds = (
            {name: float(share[result_index]) for name, share in self.linear_uncertainty.variance_by_source.items()},
            self.linear_uncertainty.evaluation_types,
        )
        total_variance = sum(shares.values())
        ranked = [
            (name, shares[name] / total_variance if total_variance > 0 else 0.0)
            for name in sorted(shares, key=lambda n: -shares[n])
        ]
        return tuple(
            BudgetEntry(
                source=name,
                evaluation_type=kinds[name],
                variance_fraction=fraction,
                standard_uncertainty=float(np.sqrt(fraction)) * sigma,
            )
            for name, fraction in ranked
        )


@raise_for_singular_network
def evaluate_tasks(recording: Recording, tasks: Tasks) -> TaskEvaluation:
    """Results of tasks on a recording, with uncertainty by propagation and Monte Carlo.

    Raises the errors that `lt.uncertainty` lists.
    """
    return _evaluate_tasks(TaskInputs.from_recording(recording, tasks), tasks)


def evaluate_tasks_on_coordinates(coordinates: EpochCoordinates, tasks: Tasks) -> TaskEvaluation:
    """Results of tasks on a list of coordinates with its covariance, with uncertainty by propagation and Monte Carlo.

    Raises the errors that `lt.uncertainty` lists.
    """
    return _evaluate_tasks(TaskInputs.from_coordinates(coordinates, tasks), tasks)


def _require_few_results(tasks: Tasks) -> None:
    """Check that the tasks have at most `MAX_UNCERTAINTY_TASK_RESULTS` results; raises ModelError."""
    n_results = sum(len(Measurand(task, np.zeros(0, dtype=np.int64)).outputs) for task in tasks.task)
    if n_results > MAX_UNCERTAINTY_TASK_RESULTS:
        raise ModelError(
            f"the tasks have {n_results} results, expected at most {MAX_UNCERTAINTY_TASK_RESULTS}: "
            "divide them among task files"
        )


@single_threaded
def _evaluate_tasks(task_inputs: TaskInputs, tasks: Tasks) -> TaskEvaluation:
    """Results of tasks on the points in `task_inputs`, with uncertainty from the sources in `task_inputs`."""
    _require_few_results(tasks)
    measurands = tuple(Measurand.from_task(task, task_inputs.target_names, task_inputs.points) for task in tasks.task)
    stretch = thermal_expansion_of_part(tasks.part_expansion)
    linear = propagate(task_inputs, measurands, stretch)
    drawn = run_monte_carlo(task_inputs, measurands, stretch, tasks.monte_carlo, linear)
    gap = max_nonlinearity_differences(task_inputs, measurands, tasks.monte_carlo.seed)
    curved = gap / np.where(linear.standard_uncertainties > 0, linear.standard_uncertainties, np.inf)
    agrees = drawn.intervals_agree(linear, tasks.monte_carlo.coverage_probability)
    return TaskEvaluation(tasks, task_inputs, measurands, linear, drawn, agrees, curved)
