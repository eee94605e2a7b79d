"""Noise, faces and reflectors: what each does to a calibration, judged on held-out points."""

from __future__ import annotations

from pathlib import Path

from experiments.common import (
    Made,
    Options,
    Row,
    batches,
    beside_floor,
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
from ltsim.pages.figures import Mean, by_setting

HERE = Path(__file__).resolve().parent


def run(given: Options) -> Made:
    campaign, cells = cells_of(HERE / "config.toml", given.trials)
    cells += cells_of(HERE / "fixed_nests.toml")[1]
    table: list[Row] = []
    means: list[Mean] = []
    for cell in cells:
        for method in campaign.methods:
            if method.effects and not cell.scenario.smr.incidence_error:
                continue
            tasks = [(campaign, cell.scenario, method, *block) for block in batches(campaign.trials)]
            columns = stacked(spread_out(compared, tasks, given.jobs))
            out = summary(columns["held_out_error_calibrated_um"])
            row: Row = {"cell": cell.title, "method": method.title}
            row |= {f"held_out_error_{name}_um": value for name, value in out.items() if name != "trials"}
            row |= beside_floor(columns)
            row["held_out_share"] = round(share(columns, "held_out_"), 4)
            for name in ("target_error_um", "distance_improvement_percent", "coordinate_improvement_percent"):
                row[name] = summary(columns[name])["mean"]
            row["distance_after_mean_um"] = summary(columns["distance_after_mean_um"])["mean"]
            table.append(row | {"trials": out["trials"]})
            means.append(Mean(cell.title, method.title, *(out[k] for k in ("mean", "low", "high", "p5", "p95"))))
        tell(f"{cell.title}: done")
    write_table(given.out / "cells.csv", table)
    write_figure(given.out / "held_out.svg", by_setting(means, label="rms error on held-out points [µm]"))
    return Made(campaign.seed, campaign.trials)
