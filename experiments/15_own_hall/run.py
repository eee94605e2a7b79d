"""Comparison of the predictions of a plan for single reflectors with simulated measurements."""

import numpy as np

from experiments.common import Options, Row, RunRecord, batches, print_line, write_figure, write_table
from ltsim.campaigns.calibrators import make_calibrator
from ltsim.campaigns.cloud_kernels import align_rigidly
from ltsim.campaigns.spec import CalibrationMethod
from ltsim.campaigns.true_network import make_true_network
from ltsim.core.arrays import Floats
from ltsim.core.parallel import run_parallel
from ltsim.core.units import MICROMETRE
from ltsim.planning.loading import load_plan
from ltsim.planning.plan_search import make_plan
from ltsim.planning.reflector_changes import ReflectorChangeEntry
from ltsim.planning.result import Plan, scenario_of_plan
from ltsim.reports.figures.marked_floor_plans import reflector_changes_floor_plan
from ltsim.reports.workshop_scene import workshop_from_scenario
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.sections import PlannedTarget

TRIALS, SEED = 100_000, 15


def with_change(scenario: Scenario, change: ReflectorChangeEntry) -> Scenario:
    """Scenario with one reflector moved (its name stays), added or removed."""
    targets = {name: target for name, target in scenario.targets.items() if name != change.reflector}
    if change.position_mm is not None:
        targets[change.reflector or change.new_place] = PlannedTarget(position_mm=change.position_mm)
    return scenario.model_copy(update={"targets": targets})


def squares(scenario: Scenario, weights: dict[str, float], number: int, width: int) -> Floats:
    """Weighted mean squared error (B,) [um^2] of the targets in `weights`, after a rigid fit to the true points."""
    truth = make_true_network(scenario, SEED, "campaign")
    block = truth.draw_batch(SEED, number, width)
    calibrated = make_calibrator(CalibrationMethod(), truth).calibrate(block, np.arange(width))
    weight = np.array([weights.get(name, 0.0) for name in truth.recording.targets])
    true = np.ascontiguousarray(np.broadcast_to(truth.state.target_points[:, :, None], calibrated.target_errors.shape))
    moved = np.empty_like(true)
    align_rigidly(true + calibrated.target_errors, true, weight > 0, moved)
    return np.einsum("t,tkb->b", weight / weight.sum(), ((moved - true) / MICROMETRE) ** 2)


def gain(scenarios: tuple[Scenario, Scenario], weights: dict[str, float], trials: int, jobs: int) -> Row:
    """Decrease of the rms error of the other targets by a change [um], with a 95 % interval over trials."""
    tasks = [(scenario, weights, *batch) for scenario in scenarios for batch in batches(trials, 1000)]
    parts = list(run_parallel(squares, tasks, jobs))
    half = len(parts) // 2
    before, after = np.concatenate(parts[:half]), np.concatenate(parts[half:])
    value = np.sqrt(before.mean()) - np.sqrt(after.mean())
    # Variance of the difference of two independent roots of means, to first order.
    error = np.sqrt(sum(x.var(ddof=1) / len(x) / (4 * x.mean()) for x in (before, after)))
    low, high = value - 1.96 * error, value + 1.96 * error
    return {
        "error_before_um": np.sqrt(before.mean()), "error_after_um": np.sqrt(after.mean()),
        "gain_um": value, "gain_low_um": low, "gain_high_um": high,
    }  # fmt: skip


def run(options: Options) -> RunRecord:
    """Plan a layout, then simulate the layout and each change of reflectors that the plan reports."""
    trials = options.trials or TRIALS
    file, hall = load_plan(options.folder / "hall.toml")
    plan = make_plan(file, hall, jobs=options.jobs)
    scenario, survey, result = scenario_of_plan(plan), plan.layout.survey, Plan.from_network(plan)
    weights_by_target = dict(zip(survey.target_names, survey.normalised_target_weights.tolist(), strict=True))
    rows: list[Row] = []
    for change in plan.reflector_changes.reported_changes:
        weights = {name: weight for name, weight in weights_by_target.items() if name != change.reflector}
        simulated_gain = gain((scenario, with_change(scenario, change)), weights, trials, options.jobs)
        is_inside_interval = (
            simulated_gain["gain_low_um"] <= change.target_rms_decrease_um <= simulated_gain["gain_high_um"]
        )
        row: Row = {"action": change.action_text, "predicted_um": change.target_rms_decrease_um, **simulated_gain}
        rows.append(
            {k: v if isinstance(v, str) else round(float(v), 4) for k, v in row.items()}
            | {"inside_interval": bool(is_inside_interval)}
        )
        print_line(str(rows[-1]))
    write_table(options.out / "changes.csv", rows)
    figure = reflector_changes_floor_plan(workshop_from_scenario(scenario), result.reflector_changes, file.floor)
    write_figure(options.out / "changes.svg", figure)
    return RunRecord(SEED, trials, {"summary": result.summary, "reasons": result.reasons})
