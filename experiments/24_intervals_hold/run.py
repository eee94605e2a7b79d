"""Coverage of 95 % intervals for each construction, order of harmonics and number of instruments."""

from typing import Any

import numpy as np
from scipy import stats

from experiments.common import Options, Row, RunRecord, campaign, write_figure, write_table
from ltsim.campaigns.statistics import NORMAL_QUANTILE_95
from ltsim.campaigns.summary import SolverComparison
from ltsim.core.arrays import Floats
from ltsim.reports.figures.campaign import SweepPoint, sweep_panels_figure

CONSTRUCTIONS = {
    "source in head": {"construction": "misalignment"},
    "steering mirror": {"construction": "steering-mirror"},
    "D-H of order 2": {"construction": "dh", "harmonics": 2},
    "D-H of order 3": {"construction": "dh", "harmonics": 3},
    "D-H of order 4": {"construction": "dh", "harmonics": 4},
}
AXIS = "construction, true and fitted"
TRACKERS = {1: "AAAA", 2: "ABAB", 3: "ABCA"}
"""Tracker (A, B or C) at each of the four stations, by the number of trackers."""
LINES = {1: "one tracker", 2: "two trackers", 3: "three trackers"}
TRACKER = {"preset": "modern", "errors": {"draw": True}}


def run(options: Options) -> RunRecord:
    rows: list[Row] = []
    for title, built in CONSTRUCTIONS.items():
        for trackers, stations in TRACKERS.items():
            places = {f"stations__S{k}__instrument": name for k, name in enumerate(stations, start=1)}
            tables: dict[str, Any] = {f"instruments__{n}": TRACKER | built for n in sorted(set(stations))}
            absent = {} if "B" in stations else {"instruments__B": "none"}
            folder = f"{title.replace(' ', '-')}-{trackers}"
            results = campaign("config.toml", options, folder, methods=[built], **tables, **absent, **places)
            z = results.to_dataframe("rows").filter(like="z:").to_numpy()
            rows.append({"instrument": title, "trackers": trackers} | row_of(z, results.solver_comparisons()[0]))
    write_table(options.out / "intervals.csv", rows)
    ends = [(row["instrument"], LINES[row["trackers"]], AXIS, row["inside"], row["low"], row["high"]) for row in rows]
    figure = sweep_panels_figure(
        [SweepPoint(*values, 0, 0) for values in ends],
        statistic_title="inside 95 % intervals [%]",
        x_title="",
        joins_points=False,
    )
    write_figure(options.out / "intervals.svg", figure)
    return RunRecord(results.manifest.seed, results.manifest.trials)


def row_of(z: Floats, end: SolverComparison) -> Row:
    """Coverage [%] of 95 % intervals by z-scores (trials, parameters), and deviations from it.

    The deviations are the number of parameters whose coverage is outside its own 99 % interval, the rms z-score, and
    the difference of the solvers.
    """
    inside = np.abs(z) < NORMAL_QUANTILE_95
    by_trial, mean = inside.mean(axis=1), 100 * float(inside.mean())
    half = 196 * float(by_trial.std(ddof=1)) / np.sqrt(len(z))
    low, high = stats.binom.ppf([0.005, 0.995], len(z), 0.95)
    counts = inside.sum(axis=0)
    return {
        "parameters": z.shape[1],
        "trials": len(z),
        **{name: round(value, 2) for name, value in (("inside", mean), ("low", mean - half), ("high", mean + half))},
        "parameters_beyond_99_percent_of_chance": int(np.sum((counts < low) | (counts > high))),
        "rms_z": round(float(np.sqrt(np.mean(z**2))), 3),
        "difference_from_full_solver_sigma": f"{end.largest_difference_sigma or 0:.1e}",
    }
