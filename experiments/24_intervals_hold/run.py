"""Whether 95 % intervals hold, for every construction, order of harmonics and number of instruments."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.common import Made, Options, Row, batches, spread_out, stacked, tell, write_figure, write_table
from ltsim.arrays import Floats
from ltsim.calibration.calibration import SHARPER
from ltsim.campaigns.cell import truth_of
from ltsim.campaigns.engine import Engine
from ltsim.campaigns.recovery import from_prior
from ltsim.campaigns.rows import z_scores
from ltsim.pages.figures import Mean, by_setting
from ltsim.simulation.scenario import Scenario, changed, load_scenario

HERE = Path(__file__).resolve().parent
INSIDE = 1.959964
LEFT, APART = "left", "apart"


def scenario_of(base: Scenario, instrument: dict[str, Any], trackers: str) -> Scenario:
    """The hall measured by trackers of one construction, a letter a station; errors drawn from their priors."""
    changes = {f"stations.S{i}.instrument": name for i, name in enumerate(trackers, start=1)}
    changes |= {f"instruments.{name}.{key}": value for name in set(trackers) for key, value in instrument.items()}
    kept = {name: tracker for name, tracker in base.instruments.items() if name in trackers}
    return from_prior(changed(base.model_copy(update={"instruments": kept}), changes, HERE / "config.toml"))


def scores(scenario: Scenario, seed: int, number: int, width: int) -> dict[str, Floats]:
    """z-scores of a batch, what is left of each prior, and how far the first trial is from the full solver."""
    truth = truth_of(scenario, seed, "intervals")
    engine, block = Engine(truth, truth.construction), truth.draw(seed, number, width)
    found = engine.calibrate(block)
    z = z_scores(truth, block, found, truth.construction, truth.recording.instruments)
    left = (found.sigma / truth.population.sigma).reshape(1, -1)
    return z | {LEFT: left, APART: np.array([engine.difference(block, 0, found)])}


def row_of(found: dict[str, Floats]) -> Row:
    """Share inside 95 % intervals over all parameters and trials, and of the parameters that hold least and most."""
    apart, told = found.pop(APART), found.pop(LEFT)[0] < SHARPER
    z = np.stack(list(found.values()))
    inside = np.abs(z) < INSIDE
    by_trial, by_parameter = inside.mean(axis=0), inside.mean(axis=1)
    half = 1.96 * by_trial.std(ddof=1) / np.sqrt(by_trial.size)
    return {
        "parameters": len(z),
        "told": int(told.sum()),
        "trials": z.shape[1],
        "inside_percent": round(100 * float(by_trial.mean()), 2),
        "half_interval": round(100 * float(half), 2),
        "inside_of_told_percent": round(100 * float(inside[told].mean()), 2),
        "least_parameter_percent": round(100 * float(by_parameter.min()), 1),
        "most_parameter_percent": round(100 * float(by_parameter.max()), 1),
        "rms_z": round(float(np.sqrt(np.mean(z**2))), 3),
        "apart_from_full_solver_sigma": float(f"{np.max(apart):.1e}"),
    }


def figure_of(rows: list[Row]) -> Figure:
    """Share inside, with its confidence interval, and the parameters that hold least and most."""
    means = []
    for row in rows:
        mean, half = float(row["inside_percent"]), float(row["half_interval"])
        ends = float(row["least_parameter_percent"]), float(row["most_parameter_percent"])
        word = f"{row['trackers']} tracker" + ("s" if int(row["trackers"]) > 1 else "")
        means.append(Mean(row["instrument"], word, mean, mean - half, mean + half, *ends))
    return by_setting(means, label="inside 95 % intervals [%]; thin: all parameters")


def run(given: Options) -> Made:
    config = tomllib.loads((HERE / "config.toml").read_text(encoding="utf-8"))
    trials, seed = given.trials or config["trials"], config["seed"]
    base = load_scenario(config["scenario"])
    rows: list[Row] = []
    for title, instrument in config["instruments"].items():
        for trackers in config["trackers"]:
            scenario = scenario_of(base, instrument, trackers)
            tasks = [(scenario, seed, *batch) for batch in batches(trials)]
            found = stacked(spread_out(scores, tasks, given.jobs))
            rows.append({"instrument": title, "trackers": len(set(trackers))} | row_of(found))
            write_table(given.out / "intervals.csv", rows)
            tell(str(rows[-1]))
    write_figure(given.out / "intervals.svg", figure_of(rows))
    return Made(seed, trials)
