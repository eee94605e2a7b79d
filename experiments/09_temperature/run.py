"""Parameters found at 27 C, applied at 20 C: how much the instrument may change before they stop to help."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import (
    HELD_OUT,
    Made,
    Options,
    Row,
    batches,
    calibrated,
    calibrator_for,
    cells_of,
    held_out,
    share,
    spread_out,
    stacked,
    summary,
    tell,
    write_figure,
    write_table,
)
from ltsim.arrays import Floats
from ltsim.campaigns.cell import truth_of
from ltsim.campaigns.spec import Campaign, Method
from ltsim.model.construction import Construction
from ltsim.pages.figures import Mean, by_setting
from ltsim.randomness import stream
from ltsim.simulation.scenario import Scenario, load_scenario
from ltsim.units import PPM

HERE = Path(__file__).resolve().parent

DRAWN_UM = 200.0
"""The figure leaves out what is worse: the table has it."""
ROOMS = {"laboratory": "paper-laboratory", "large room": HELD_OUT}


def changed(built: Construction, values: Floats, law: dict[str, Any], rate: float, air: float, draw: Floats) -> Floats:
    """Values (I, p, B) after the change of temperature; `draw` (I, p, B) standard normal."""
    drift = np.array([0.0 if p.unit == "ppm" else rate * law["change_k"] * p.factor for p in built.parameters])
    moved = values + drift[None, :, None] * draw
    moved[:, built.index("range-scale")] += air * law["change_k"] * PPM
    return moved


def one_batch(
    campaign: Campaign, scenario: Scenario, method: Method, law: dict[str, Any], number: int, width: int
) -> dict[tuple[str, float, float], dict[str, Floats]]:
    """A batch calibrated once and used in every room after every change."""
    truth = truth_of(scenario, campaign.seed, "campaign")
    calibrator = calibrator_for(method, truth)
    block = truth.draw(campaign.seed, number, width)
    found, columns = calibrated(truth, calibrator, block)
    draw = stream(campaign.seed, "drift", number).standard_normal(block.values.shape)
    results = {("workshop at 27 C", 0.0, 0.0): {name: c for name, c in columns.items() if name.startswith("error_")}}
    for name, source in ROOMS.items():
        room = load_scenario(source)
        workshop = room.workshop.model_copy(update={"temperature_c": 27.0 + law["change_k"]})
        room = room.model_copy(update={"instrument": scenario.instrument, "workshop": workshop})
        elsewhere = truth_of(room, campaign.seed, name)
        for rate in law["rate_per_k"]:
            for air in law["air_ppm_per_k"]:
                values = changed(truth.construction, block.values, law, rate, air, draw)
                judged = held_out(elsewhere, values, campaign.seed + 1, number, found, calibrator.construction)
                results[name, rate, air] = {key.removeprefix("held_out_"): c for key, c in judged.items()}
    return results


def run(given: Options) -> Made:
    campaign, cells = cells_of(HERE / "config.toml", given.trials)
    law = tomllib.loads((HERE / "drift.toml").read_text(encoding="utf-8"))
    table: list[Row] = []
    means: list[Mean] = []
    for cell in cells:
        for method in campaign.methods:
            tasks = [(campaign, cell.scenario, method, law, *block) for block in batches(campaign.trials)]
            parts = spread_out(one_batch, tasks, given.jobs)
            for room, rate, air in parts[0]:
                columns = stacked([part[room, rate, air] for part in parts])
                out = summary(columns["error_calibrated_um"])
                raw = summary(columns["error_raw_um"])["mean"]
                row: Row = {"cell": cell.title, "method": method.title, "used_in": room}
                row |= {"drift_per_k": rate, "air_ppm_per_k": air, "raw_um": raw, "calibrated_um": out["mean"]}
                row |= {"true_parameters_um": summary(columns["error_true_parameters_um"])["mean"]}
                better = 100 * float(np.mean(columns["error_calibrated_um"] < columns["error_raw_um"]))
                row |= {"share_removed": round(share(columns), 4), "percent_of_trials_better": round(better, 1)}
                table.append(row | {"trials": out["trials"]})
                if room == "large room" and air == 0.0 and out["mean"] < DRAWN_UM:
                    numbers = (out[k] for k in ("mean", "low", "high", "p5", "p95"))
                    means.append(Mean(f"{cell.title}, {rate:g}/K", method.title, *numbers))
            tell(f"{cell.title}, {method.title}: done")
    write_table(given.out / "rooms.csv", table)
    write_figure(given.out / "large_room.svg", by_setting(means, label="rms error at 20 °C in a large room [µm]"))
    return Made(campaign.seed, campaign.trials)
