"""Comparison of predicted uncertainties of measurement tasks with the scatter of simulated measurements."""

from typing import Any

import numpy as np

from experiments.common import Made, Options, batches, show_table
from ltsim.campaigns.trial_calibrators import BatchCalibrator
from ltsim.campaigns.true_network import TRIALS_PER_STREAM, TrueNetwork, make_true_network
from ltsim.core.arrays import Floats
from ltsim.core.parallel import run_parallel
from ltsim.geometry.rigid import align_with_scale
from ltsim.measurands.inputs import TaskInputs
from ltsim.measurands.measurands import Measurand
from ltsim.measurands.propagation import LinearUncertainty, propagate, thermal_expansion_of_part
from ltsim.measurands.spec import Tasks, load_tasks
from ltsim.physics.model.construction import misalignment_construction
from ltsim.simulation.scenario import Scenario, load_scenario
from ltsim.simulation.sections import EffectEntry


def scenario_of(name: str, case: dict[str, str]) -> Scenario:
    """The scenario with the effects of a case drawn anew in every trial."""
    plain = load_scenario(name)
    effects = [EffectEntry(name=case["stations"], stations=(s,), draw=True) for s in plain.stations
               if "stations" in case]  # fmt: skip
    effects += [EffectEntry(name=case["targets"], targets=(t,), draw=True) for t in plain.target_names]
    effects += [EffectEntry(name=case["hall"], draw=True)] if "hall" in case else []
    return plain.model_copy(update={"effects": tuple(effects)})


def errors_of(truth: TrueNetwork, tasks: Tasks, placed: Floats, seed: int, number: int) -> Floats:
    """Errors (BLOCK, k) [SI] of the results of one block of measured and calibrated workshops.

    Each network is fitted over all targets to the true one where the prediction has it, `placed` (T, 3): that is the
    frame of inner constraints, which the prediction is told in.
    """
    engine = BatchCalibrator(truth, misalignment_construction())
    calibrated = engine.calibrate(truth.draw_batch(seed, number))
    drawn = truth.state.target_points + np.moveaxis(calibrated.target_errors, 2, 0)
    rotation, shift, _ = align_with_scale(placed, drawn)
    drawn = np.einsum("bji,btj->bti", rotation, drawn - shift[:, None])
    measurands = [Measurand.from_task(task, truth.recording.targets, placed) for task in tasks.task]
    true = np.concatenate([m.values(placed) for m in measurands])
    return np.concatenate([m.values(drawn) for m in measurands], axis=1) - true


Names = list[tuple[str, str, str, float]]
"""Task, result, unit and its factor of each result."""


def predicted(truth: TrueNetwork, tasks: Tasks, dropped: str = "") -> tuple[LinearUncertainty, Names, Floats]:
    """Uncertainty of an error-free recording, without one source; its results, and where it has the targets (T, 3)."""
    budget = tuple(entry for entry in tasks.type_b if entry.effect != dropped)
    tasks_with_budget = tasks.model_copy(update={"type_b": budget, "datum": truth.recording.targets})
    inputs = TaskInputs.from_recording(truth.recording, tasks_with_budget)
    measurands = [Measurand.from_task(task, inputs.target_names, inputs.points) for task in tasks_with_budget.task]
    names = [(m.task.name, o.name, o.unit, o.si_per_unit) for m in measurands for o in m.outputs]
    points = inputs.network_or_coordinates.state.target_points
    return propagate(inputs, measurands, thermal_expansion_of_part(None)), names, points


def table_of(case: str, errors: Floats, linear: LinearUncertainty, names: Names) -> list[Any]:
    """A row a result: predicted and observed deviation, share inside the 95 % interval, both with their uncertainty."""
    rows, count = [], len(errors)
    inside, scatter = np.mean(np.abs(errors) <= linear.expanded_uncertainty(0.95), axis=0), errors.std(axis=0, ddof=1)
    for i, (task, result, unit, factor) in enumerate(names):
        if "ness" in result or result in ("sphericity", "cylindricity") or result.startswith(("normal", "direction")):
            continue  # Forms are not negative, directions not independent: the Monte Carlo interval is for these.
        rows.append({
            "case": case, "task": task, "result": result, "unit": unit,
            "predicted_sigma": round(float(linear.standard_uncertainties[i]) / factor, 7),
            "observed_over_predicted": round(float(scatter[i] / linear.standard_uncertainties[i]), 4),
            "uncertainty_of_the_ratio": round(float(1 / np.sqrt(2 * (count - 1))), 4),
            "inside_95_percent": round(100 * float(inside[i]), 2),
            "uncertainty_of_the_fraction": round(100 * float(np.sqrt(0.95 * 0.05 / count)), 2),
        })  # fmt: skip
    return rows


def run(given: Options) -> Made:
    """All cases; the table is results.csv."""
    config, tasks = given.config, load_tasks(given.here / "tasks.toml")
    trials, seed = given.trials or config["trials"], config["seed"]
    rows: list[Any] = []
    for case in config["cases"]:
        truth = make_true_network(scenario_of(config["scenario"], case), seed)
        linear, names, placed = predicted(truth, tasks, case.get("dropped", ""))
        work = [(truth, tasks, placed, seed, number) for number, _ in batches(trials, TRIALS_PER_STREAM)]
        errors = np.concatenate([*run_parallel(errors_of, work, given.jobs)])[:trials]
        rows += table_of(case["title"], errors, linear, names)
    show_table(given.out / "results.csv", rows)
    return Made(seed, trials)
