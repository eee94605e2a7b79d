"""Calibrations of the same trials by several solvers: ltsim's batch and single solvers, numpy, scipy, pyceres.

    python -m benchmarks.calibrations [--trials 16] [--short] [--out FILE]

All solvers start from the nominal network, except the single solver of ltsim, which uses only the recording. All
solvers end at the same optimum, as the last column shows. Each solver has one thread. Times are processor times, the
smallest of several runs, so that other programs on the computer have little influence.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed, parallel_config
from threadpoolctl import threadpool_limits

from benchmarks.networks import room, workshop
from benchmarks.peers import (
    DenseProblem,
    Solver,
    numpy_gauss_newton,
    pyceres_solver,
    scipy_analytic,
    scipy_differences,
)
from ltsim.adjustment import adjust
from ltsim.adjustment.evaluation.clouds import align_to_points
from ltsim.campaigns.batch_distance_calibrator import BatchDistanceCalibrator
from ltsim.campaigns.shard_rows import ShardTask, make_shard_rows, run_shard_task
from ltsim.campaigns.spec import CampaignFile
from ltsim.campaigns.store import CampaignFolder
from ltsim.campaigns.trial_calibrators import BatchCalibrator, recording_of_trial
from ltsim.campaigns.trial_evaluation import TrialEvaluator
from ltsim.campaigns.true_network import TRIALS_PER_STREAM, TrialBatch
from ltsim.core.arrays import Floats
from ltsim.core.notation import align_columns
from ltsim.physics.model.construction import misalignment_construction
from ltsim.simulation.scenario import load_scenario

SEED = 11


def seconds(function: Callable[[], object], repeats: int) -> float:
    """Smallest processor time [s] of several runs."""
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        function()
        best = min(best, time.process_time() - start)
    return best


def difference(engine: BatchCalibrator, block: TrialBatch, trial: int, values: Floats, points: Floats) -> float:
    """Largest difference [sigma] of parameters and targets from the single solver's, after a rigid fit."""
    full, single, _ = engine.serial_calibrator.adjust_recording(recording_of_trial(engine.true_network, block, trial))
    if full is None:
        return float("nan")
    z = np.abs(values - single[0]) / engine.batch_network.parameter_sigmas[0]
    gap = np.abs(align_to_points(points, full.state.target_points) - full.state.target_points) / engine.target_sigmas
    return float(max(z.max(), gap.max()))


def peers(trials: int) -> None:
    """Print the table of solvers."""
    truth = workshop()
    engine, judge = BatchCalibrator(truth, misalignment_construction()), TrialEvaluator(truth)
    block = truth.draw_batch(SEED, 0)
    calibrated = engine.calibrate(block)
    judge.method_independent_columns(block)
    judge.method_columns(block, calibrated, engine.construction)

    def everything() -> None:
        drawn = truth.draw_batch(SEED, 1)
        fitted = engine.calibrate(drawn)
        judge.method_independent_columns(drawn)
        judge.method_columns(drawn, fitted, engine.construction)

    n, (*_, unknowns) = len(truth.recording), engine.batch_network.block_end_indices
    print(f"The paper's workshop: {3 * n} readings, {unknowns} unknowns with the datum; processor time, one core\n")
    batch = seconds(lambda: engine.calibrate(block), 20) / TRIALS_PER_STREAM
    agreement = max(
        difference(
            engine,
            block,
            k,
            calibrated.instrument_values[0, :, k],
            truth.state.target_points + calibrated.target_errors[:, :, k],
        )
        for k in range(trials)
    )
    whole = seconds(everything, 20) / TRIALS_PER_STREAM
    drawn = seconds(lambda: (truth.draw_batch(SEED, 1), engine.calibrate(block)), 20) / TRIALS_PER_STREAM
    rows = [
        _row("ltsim batch: calibration", batch, batch, agreement),
        _row("ltsim batch: simulation and calibration", drawn, batch, agreement),
        _row("ltsim batch: with criteria and errors", whole, batch, agreement),
    ]
    recordings = [recording_of_trial(truth, block, k) for k in range(trials)]
    single = min(seconds(lambda r=r: adjust(r, engine.construction), 2) for r in recordings)  # type: ignore[misc]
    rows.append(_row("ltsim single solver, from the readings alone", single, batch, 0.0))
    starts = [
        lambda r=r: adjust(r, engine.construction, start_state=engine.batch_network.state_with_zero_parameters)
        for r in recordings
    ]
    rows.append(
        _row("ltsim single solver, from the peers' start", min(seconds(solve, 2) for solve in starts), batch, 0.0)
    )
    solvers: dict[str, Solver | None] = {
        "numpy Gauss-Newton, analytic": numpy_gauss_newton,
        "pyceres, one block, analytic": pyceres_solver(),
        "scipy least_squares, analytic": scipy_analytic,
        "scipy least_squares, differences": scipy_differences,
    }
    for name, solver in solvers.items():
        if solver is None:
            print(f"{name}: skipped, because pyceres is not installed (pip install pyceres)")
            continue
        rows.append(_peer(name, solver, engine, block, trials, batch))
    print(align_columns(["solver", "per trial", "trials a second", "ratio", "agreement [sigma]"], rows))


def _peer(
    name: str, solver: Solver, engine: BatchCalibrator, block: TrialBatch, trials: int, batch: float
) -> list[str]:
    count = max(2, trials // 4) if "differences" in name else trials
    worst, least = 0.0, np.inf
    for k in range(count):
        recording = recording_of_trial(engine.true_network, block, k)
        for _ in range(2):
            start = time.process_time()
            problem = DenseProblem(recording, engine.construction, engine.true_network.state)
            x = solver(problem)
            least = min(least, time.process_time() - start)
        _, _, points, values = problem.state(x)
        worst = max(worst, difference(engine, block, k, values, points))
    return _row(name, least, batch, worst)


def _row(name: str, trial_seconds: float, batch: float, agreement: float) -> list[str]:
    shown = f"{1e6 * trial_seconds:.1f} us" if trial_seconds < 1e-3 else f"{1e3 * trial_seconds:.2f} ms"
    return [name, shown, f"{1 / trial_seconds:.0f}", f"{trial_seconds / batch:.1f}", f"{agreement:.0e}"]


def parts() -> None:
    """Print the time of each step of a trial."""
    truth = workshop()
    engine, judge = BatchCalibrator(truth, misalignment_construction()), TrialEvaluator(truth)
    network, block = engine.batch_network, truth.draw_batch(SEED, 0)
    calibrated = engine.calibrate(block)
    x, predicted = network._first_newton_step(block.reading_deviations, block.length_errors)
    gradient, cost = np.empty_like(x), np.empty(TRIALS_PER_STREAM)
    rng = np.random.default_rng(0)
    raw = judge.mean_points_by_station(block.reading_deviations)
    steps: dict[str, Callable[[], object]] = {
        "draw: normal numbers": lambda: rng.standard_normal(block.reading_deviations.shape),
        "draw: exact readings, two Newton steps": lambda: truth._exact_reading_deviations(block.instrument_values),
        "draw: everything": lambda: truth.draw_batch(SEED, 0),
        "calibrate: linear start": lambda: network._first_newton_step(block.reading_deviations, block.length_errors),
        "calibrate: residuals and gradient": lambda: network._write_gradient_and_cost(
            x, block.reading_deviations, block.length_errors, predicted, gradient, cost
        ),
        "calibrate: everything": lambda: engine.calibrate(block),
        "evaluate: points of one set of parameters (three times)": lambda: judge.mean_points_by_station(
            block.reading_deviations, engine.construction, calibrated.instrument_values
        ),
        "evaluate: both criteria (twice)": lambda: judge.criteria_columns(raw, "before"),
        "evaluate: error against the truth (three times)": lambda: judge.measured_point_error(raw),
    }
    print("\nTime of each step [us per trial]:\n")
    rows = [[name, f"{1e6 * seconds(step, 20) / TRIALS_PER_STREAM:.1f}"] for name, step in steps.items()]
    print(align_columns(["step", "us"], rows))


def other_paths() -> None:
    """Print the cost of the distance objective in batches, and of campaigns with a new geometry in each trial."""
    truth, every = workshop(), np.arange(TRIALS_PER_STREAM)
    batch, block = BatchDistanceCalibrator(truth, misalignment_construction()), truth.draw_batch(SEED, 0)
    calibrated = batch.calibrate(block, every)
    worst = max(batch.largest_solver_difference(block, k, calibrated) for k in range(3))
    each = seconds(lambda: batch.calibrate(block, every), 5) / TRIALS_PER_STREAM
    single = seconds(lambda: batch.serial_calibrator.calibrate(block, np.array([0])), 3)
    absolute, trials = BatchDistanceCalibrator(truth, misalignment_construction(), method="distance-l1"), np.arange(16)
    settled = absolute.calibrate(block, trials)
    largest_difference = max(absolute.largest_solver_difference(block, k, settled) for k in range(8))
    programmed = seconds(lambda: absolute.calibrate(block, trials), 3) / len(trials)
    alone = seconds(lambda: absolute.serial_calibrator.calibrate(block, np.array([0])), 3)
    campaign = CampaignFile(format="ltsim-campaign/1", trials=256, geometry="per-trial", verified_trials_per_shard=0)
    task = ShardTask(campaign, load_scenario("paper-workshop"), "", 0, 0)
    varying = seconds(lambda: make_shard_rows(task), 3) / campaign.trials
    shared = ShardTask(CampaignFile(format="ltsim-campaign/1", trials=4096), load_scenario("paper-workshop"), "", 0, 0)
    written = seconds(lambda: run_shard_task(shared), 4) / 4096
    print("\nOther paths, one core\n")
    rows = [
        ["common geometry, evaluated, verified, encoded", f"{1e6 * written:.1f} us", f"{1 / written:.0f}", ""],
        ["distance objective, batch", f"{1e6 * each:.0f} us", f"{1 / each:.0f}", f"{worst:.0e}"],
        ["distance objective, single", f"{1e3 * single:.0f} ms", f"{1 / single:.0f}", ""],
        [
            "distance objective, absolute, batch",
            f"{1e3 * programmed:.1f} ms",
            f"{1 / programmed:.0f}",
            f"{largest_difference:.0e}",
        ],
        ["distance objective, absolute, single", f"{1e3 * alone:.0f} ms", f"{1 / alone:.0f}", ""],
        ["new geometry in each trial, all steps", f"{1e3 * varying:.1f} ms", f"{1 / varying:.0f}", ""],
    ]
    print(align_columns(["path", "per trial", "trials a second", "agreement [sigma]"], rows))


def scaling(short: bool) -> None:
    """Print cost by numbers of stations and targets."""
    sizes = [(5, 14), (5, 28), (5, 56), (10, 28), (20, 28)] + ([] if short else [(5, 112), (40, 28), (20, 112)])
    rows = []
    for stations, targets in sizes:
        truth = room(stations, targets)
        engine = BatchCalibrator(truth, misalignment_construction())
        start = time.process_time()
        block = truth.draw_batch(SEED, 0)
        engine.calibrate(block)
        prepared = time.process_time() - start
        each = seconds(lambda t=truth, e=engine: e.calibrate(t.draw_batch(SEED, 1)), 3) / TRIALS_PER_STREAM  # type: ignore[misc]
        recording = recording_of_trial(truth, block, 0)
        single = seconds(lambda r=recording, e=engine: adjust(r, e.construction), 2)  # type: ignore[misc]
        rows.append(
            [str(stations), str(targets), str(engine.batch_network.block_end_indices[-1]),
             f"{1e6 * each:.0f}", f"{1e3 * single:.1f}",
             f"{single / each:.0f}", f"{prepared:.2f}"]
        )  # fmt: skip
    print("\nCost by size of the network: simulation and calibration, one core\n")
    heads = ["stations", "targets", "unknowns", "batch [us]", "single [ms]", "ratio", "preparation [s]"]
    print(align_columns(heads, rows, n_text_columns=0))


def trials_against_time(short: bool) -> None:
    """Print cost by number of trials, in two processes, with all steps of a campaign.

    Trials are simulated, calibrated, evaluated, verified and written.
    """
    scenario, rows = load_scenario("paper-workshop"), []
    with tempfile.TemporaryDirectory() as place, parallel_config(backend="loky", inner_max_num_threads=1):
        for shards in (2, 4, 16) if short else (2, 4, 16, 64):  # the first run starts processes and compiles
            campaign = CampaignFile(format="ltsim-campaign/1", trials=4096 * shards)
            tasks = [ShardTask(campaign, scenario, "", 0, shard) for shard in range(shards)]
            store, start = CampaignFolder(Path(place) / str(shards)), time.perf_counter()
            done = Parallel(n_jobs=2, return_as="generator")(delayed(run_shard_task)(task) for task in tasks)
            for task, content in done:
                store.write_shard(0, task.shard, content)
            wall = time.perf_counter() - start
            rows.append([str(campaign.trials), f"{wall:.2f}", f"{campaign.trials / wall:.0f}"])
    print(
        "\nCost by number of trials: simulated, calibrated, evaluated, two of each 4,096 verified by the single solver,"
    )
    print("written; two processes, wall clock\n")
    print(align_columns(["trials", "s", "trials a second"], rows[1:], n_text_columns=0))
    largest = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    print(f"\nlargest process: {largest / 1024:.0f} MiB; it does not grow with the number of trials")


def main() -> None:
    """Run all benchmarks of this module."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibrations", description=__doc__)
    parser.add_argument("--trials", type=int, default=16, help="number of trials of the solvers without batches")
    parser.add_argument("--short", action="store_true", help="smaller networks and fewer trials")
    parser.add_argument("--out", type=Path, help="file for the printed text")
    options = parser.parse_args()
    output = StringIO()
    with threadpool_limits(limits=1), redirect_stdout(output if options.out else sys.stdout):
        peers(options.trials)
        parts()
        other_paths()
        scaling(options.short)
        trials_against_time(options.short)
    if options.out:
        options.out.write_text(output.getvalue(), encoding="utf-8")
        print(output.getvalue(), end="")


if __name__ == "__main__":
    main()
