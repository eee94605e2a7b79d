"""The paper's method and the network adjustment on the same trials, judged by what only a simulation knows."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.common import (
    Cell,
    Made,
    Options,
    batches,
    cells_of,
    compared,
    share,
    spread_out,
    stacked,
    summary,
    tell,
    write_figure,
    write_table,
)
from ltsim.arrays import Floats
from ltsim.campaign.cell import truth_of
from ltsim.campaign.engine import Engine
from ltsim.campaign.spec import Campaign
from ltsim.model.construction import misalignment
from ltsim.report.figures import Mean, by_setting

HERE = Path(__file__).resolve().parent

JUDGED = (
    "distance_improvement_percent",
    "coordinate_improvement_percent",
    "error_raw_um",
    "error_calibrated_um",
    "error_true_parameters_um",
    "target_error_um",
    "held_out_error_raw_um",
    "held_out_error_calibrated_um",
    "held_out_error_true_parameters_um",
)
Columns = dict[str, Floats]


def parameter_rows(campaign: Campaign, cell: Cell, drawn: dict[str, Columns]) -> list[dict[str, object]]:
    """Root-mean-square error of each parameter by each method, beside the Cramer-Rao bound.

    Truth is drawn from the prior, so that the bound is the inverse of the information of readings and prior.
    """
    truth = truth_of(cell.scenario, campaign.seed, "campaign")
    bound = Engine(truth, misalignment()).network.sigma_values[0]
    rows = []
    for k, parameter in enumerate(truth.construction.parameters):
        row: dict[str, object] = {"cell": cell.title, "parameter": parameter.name, "unit": parameter.unit}
        row["drawn_sigma"] = round(float(truth.sigma[0, k] / parameter.factor), 4)
        row["cramer_rao_bound"] = round(float(bound[k] / parameter.factor), 4)
        for name in ("distance", "network"):
            miss = drawn[name][f"miss:{parameter.name}"]
            rms = float(np.sqrt(np.mean(miss**2)))
            row[f"rms_{name}"] = round(rms, 4)
            row[f"{name}_over_bound"] = round(rms / float(bound[k] / parameter.factor), 3)
        rows.append(row)
    return rows


def run(given: Options) -> Made:
    campaign, cells = cells_of(HERE / "config.toml", given.trials)
    table: list[dict[str, object]] = []
    shares: list[dict[str, object]] = []
    parameters: list[dict[str, object]] = []
    means: list[Mean] = []
    for cell in cells:
        drawn = {}
        for method in campaign.methods:
            tasks = [(campaign, cell.scenario, method, *block) for block in batches(campaign.trials)]
            columns = drawn[method.title] = stacked(spread_out(compared, tasks, given.jobs))
            here = {"cell": cell.title, "method": method.title}
            table += [here | {"quantity": name} | summary(columns[name]) for name in JUDGED]
            shares.append(
                here
                | {"share_removed": round(share(columns), 4), "held_out_share": round(share(columns, "held_out_"), 4)}
            )
            spread = summary(columns["held_out_error_calibrated_um"])
            means.append(Mean(cell.title, method.title, *(spread[k] for k in ("mean", "low", "high", "p5", "p95"))))
            tell(f"{cell.title}, {method.title}: done")
        tracker = cell.scenario.instrument
        # The bound is that of the stated noise.
        if tracker.construction == "misalignment" and tracker.noise_factor == 1.0:
            parameters += parameter_rows(campaign, cell, drawn)
    write_table(given.out / "methods.csv", table)
    write_table(given.out / "share_removed.csv", shares)
    write_table(given.out / "parameters.csv", parameters)
    write_figure(given.out / "held_out.svg", by_setting(means, label="rms error on held-out points [µm]"))
    return Made(campaign.seed, campaign.trials)
