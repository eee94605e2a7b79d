"""Pass rates of acceptance tests in a population of trackers, by the errors of their points."""

from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from experiments.common import Options, Row, RunRecord, show_table, write_figure
from ltsim.acceptance.prediction import AcceptancePlan, point_errors_by_constant
from ltsim.acceptance.spec import builtin_tests, points_around_instrument
from ltsim.core.randomness import random_stream
from ltsim.geometry.polar import to_polar
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings.specification import data_sheet_specification
from ltsim.reports.figures.campaign import SweepPoint, sweep_panels_figure

BLOCK = 1000


def population(config: dict[str, Any], trials: int) -> pd.DataFrame:
    """Row for each instrument: largest point error over its limit (`share`), and True for each plan that it passes."""
    limits, built, points = (
        data_sheet_specification(config["sheet"]),
        misalignment_construction(),
        points_around_instrument(),
    )
    declared = limits.to_instrument()
    plans = {
        name: AcceptancePlan(
            tuple(builtin_tests(name, config["nearest_m"], config["lengths_m"])), built, limits, declared.noise
        )
        for name in config["standards"]
    }
    prior = np.array([p.prior_sigma_from(declared.prior) for p in built.parameters])
    harm, range_ = point_errors_by_constant(built, points, prior), to_polar(points)[:, 0]
    limit = np.hypot(np.sqrt(2) * limits.transverse_limit(range_), limits.range_limit(range_))
    parts = []
    for start in range(0, trials, BLOCK):
        rng = random_stream(config["seed"], "population", start)
        size = np.exp(rng.uniform(*np.log(config["spread"]), BLOCK))
        units = rng.standard_normal((BLOCK, built.n_parameters)) * size[:, None]
        gaps = np.linalg.norm((units @ harm.T).reshape(BLOCK, -1, 3), axis=2)
        columns = {"share": np.max(gaps / limit, axis=1)}
        for name, plan in plans.items():
            errors = np.einsum("kip,np->nki", plan.test_error_derivatives * prior, units)
            noise = rng.standard_normal(errors.shape) * plan.error_sigmas
            columns[name] = plan.is_within_limits(errors + noise).all(axis=1)
        parts.append(pd.DataFrame(columns))
    instruments = pd.concat(parts, ignore_index=True).head(trials)
    return instruments.assign(both=instruments[[*plans]].all(axis=1))


def row_of(error_range: str, instruments: pd.DataFrame) -> Row:
    """Percentages of instruments that pass each plan, with standard uncertainties."""
    count, row = len(instruments), {"error_over_limit": error_range, "instruments": len(instruments)}
    for name, rate in instruments.drop(columns="share").mean().items():
        error = np.sqrt(max(rate * (1 - rate), 1 / count) / count) if count else np.nan
        row |= {name: 100 * rate, f"{name}_uncertainty": 100 * error}
    return row


def run(options: Options) -> RunRecord:
    """Simulate the population, and write population.csv and population.svg."""
    config = options.config
    trials = options.trials or config["trials"]
    table = population(config, trials)
    rows = []
    for low, high in pairwise(config["steps"]):
        error_range = f"to {high:g}" if np.isfinite(high) else f"over {low:g}"
        rows.append(row_of(error_range, table[(table.share >= low) & (table.share < high)]))
    curves = []
    for row in rows:
        for name in table.columns.drop("share"):
            ends = np.clip(row[name] + np.array([0.0, -1.96, 1.96]) * row[f"{name}_uncertainty"], 0, 100)
            curves.append(SweepPoint(row["error_over_limit"], name, "", ends[0], ends[1], ends[2], ends[0], ends[0]))
    rows += [row_of("all within", table[table.share <= 1]), row_of("all beyond", table[table.share > 1])]
    show_table(options.out / "population.csv", rows)
    axis = "largest point error over its limit, in steps"
    write_figure(
        options.out / "population.svg", sweep_panels_figure(curves, statistic_title="pass every test [%]", x_title=axis)
    )
    return RunRecord(config["seed"], trials)
