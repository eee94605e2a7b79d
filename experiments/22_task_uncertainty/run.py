"""Comparison of predicted uncertainties of measurement tasks with the scatter of simulated measurements."""

from typing import Any

import numpy as np

from experiments.common import Options, RunRecord, batches, show_table
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
    """Scenario with the effects of a case, which are drawn anew in each trial."""
    plain = load_scenario(name)
    effects = [EffectEntry(name=case["stations"], stations=(s,), draw=True) for s in plain.stations
               if "stations" in case]  # fmt: skip
    effects += [EffectEntry(name=case["targets"], targets=(t,), draw=True) for t in plain.target_names]
    effects += [EffectEntry(name=case["hall"], draw=True)] if "hall" in case else []
    return plain.model_copy(update={"effects": tuple(effects)})


def errors_of(truth: TrueNetwork, tasks: Tasks, placed: Floats, seed: int, number: int) -> Floats:
    """Errors (b, k) [SI] of the k results in one batch of b simulated and calibrated workshops.

    Each network is fitted over all targets to the true points `placed` (T, 3), which gives the frame of inner
    constraints, as in the prediction.
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
"""Task, result, unit, and SI value of the unit, for each result."""


def predict_uncertainty(truth: TrueNetwork, tasks: Tasks, dropped: str = "") -> tuple[LinearUncertainty, Names, Floats]:
    """Uncertainty of an error-free recording, the names of its results, and its targets (T, 3) [m].

    The effect `dropped` is removed from the uncertainty budget.
    """
    budget = tuple(entry for entry in tasks.type_b if entry.effect != dropped)
    tasks_with_budget = tasks.model_copy(update={"type_b": budget, "datum": truth.recording.targets})
    inputs = TaskInputs.from_recording(truth.recording, tasks_with_budget)
    measurands = [Measurand.from_task(task, inputs.target_names, inputs.points) for task in tasks_with_budget.task]
    names = [(m.task.name, o.name, o.unit, o.si_per_unit) for m in measurands for o in m.outputs]
    points = inputs.network_or_coordinates.state.target_points
    return propagate(inputs, measurands, thermal_expansion_of_part(None)), names, points


def table_of(case: str, errors: Floats, linear: LinearUncertainty, names: Names) -> list[Any]:
    """Row for each result: predicted and observed standard deviation, and coverage of the 95 % interval.

    The observed values have their uncertainties.
    """
    rows, count = [], len(errors)
    inside, scatter = np.mean(np.abs(errors) <= linear.expanded_uncertainty(0.95), axis=0), errors.std(axis=0, ddof=1)
    for i, (task, result, unit, factor) in enumerate(names):
        if "ness" in result or result in ("sphericity", "cylindricity") or result.startswith(("normal", "direction")):
            continue  # form errors are not negative, and directions are dependent: they need the Monte Carlo interval
        rows.append({
            "case": case, "task": task, "result": result, "unit": unit,
            "predicted_sigma": round(float(linear.standard_uncertainties[i]) / factor, 7),
            "observed_over_predicted": round(float(scatter[i] / linear.standard_uncertainties[i]), 4),
            "uncertainty_of_the_ratio": round(float(1 / np.sqrt(2 * (count - 1))), 4),
            "inside_95_percent": round(100 * float(inside[i]), 2),
            "uncertainty_of_the_fraction": round(100 * float(np.sqrt(0.95 * 0.05 / count)), 2),
        })  # fmt: skip
    return rows


def run(options: Options) -> RunRecord:
    """Run all cases, and write results.csv."""
    config, tasks = options.config, load_tasks(options.folder / "tasks.toml")
    trials, seed = options.trials or config["trials"], config["seed"]
    rows: list[Any] = []
    for case in config["cases"]:
        truth = make_true_network(scenario_of(config["scenario"], case), seed)
        linear, names, placed = predict_uncertainty(truth, tasks, case.get("dropped", ""))
        work = [(truth, tasks, placed, seed, number) for number, _ in batches(trials, TRIALS_PER_STREAM)]
        errors = np.concatenate([*run_parallel(errors_of, work, options.jobs)])[:trials]
        rows += table_of(case["title"], errors, linear, names)
    show_table(options.out / "results.csv", rows)
    return RunRecord(seed, trials)
