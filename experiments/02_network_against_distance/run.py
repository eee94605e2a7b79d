"""The paper's method and the network adjustment on the same trials, judged by what only a simulation knows."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import (
    HELD_OUT,
    Cell,
    Made,
    Options,
    Row,
    batches,
    beside_floor,
    calibrator_for,
    cells_of,
    compared,
    held_out,
    share_interval,
    spread_out,
    stacked,
    summary,
    tell,
    with_prior,
    write_figure,
    write_table,
)
from experiments.printed import Printed
from ltsim.arrays import Floats
from ltsim.calibration import calibrate_network
from ltsim.campaigns.cell import truth_of
from ltsim.campaigns.engine import Calibrated, Engine, recording_of
from ltsim.campaigns.spec import Campaign, Method
from ltsim.campaigns.truth import Truth
from ltsim.model.construction import misalignment
from ltsim.pages.figures import Mean, by_setting
from ltsim.simulation.scenario import load_scenario

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
LABEL = "rms error on held-out points [µm]"
Columns = dict[str, Floats]


def parameter_rows(campaign: Campaign, cell: Cell, drawn: dict[str, Columns]) -> list[Row]:
    """Root-mean-square error of each parameter by each method, beside the Cramer-Rao bound.

    Truth is drawn from the prior, so that the bound is the inverse of the information of readings and prior.
    """
    truth = truth_of(cell.scenario, campaign.seed, "campaign")
    bound = Engine(truth, misalignment()).network.sigma_values[0]
    rows = []
    for k, parameter in enumerate(truth.construction.parameters):
        row: Row = {"cell": cell.title, "parameter": parameter.name, "unit": parameter.unit}
        row["drawn_sigma"] = round(float(truth.population.sigma[0, k] / parameter.factor), 4)
        row["cramer_rao_bound"] = round(float(bound[k] / parameter.factor), 4)
        for name in ("eq. 9", "distance", "network"):
            miss = drawn[name][f"miss:{parameter.name}"]
            rms = float(np.sqrt(np.mean(miss**2)))
            row[f"rms_{name}"] = round(rms, 4)
            row[f"{name}_over_bound"] = round(rms / float(bound[k] / parameter.factor), 3)
        rows.append(row)
    return rows


def judged_row(columns: Columns) -> Row:
    """Errors on new points, and the share of the correctable error that was removed, with 95 % intervals."""
    out, raw = summary(columns["held_out_error_calibrated_um"]), summary(columns["held_out_error_raw_um"])
    row: Row = (
        {f"held_out_error_{k}_um": out[k] for k in ("mean", "low", "high")}
        | {"as_read_um": raw["mean"]}
        | beside_floor(columns)
    )
    row |= dict(zip(("share", "share_low", "share_high"), share_interval(columns, "held_out_"), strict=True))
    worse = columns["held_out_error_calibrated_um"] > columns["held_out_error_raw_um"]
    return row | {"worse_than_as_read_percent": round(100 * float(np.mean(worse)), 1), "trials": out["trials"]}


def in_new_places(campaign: Campaign, cell: Cell, truth: Truth, method: Method, number: int, width: int) -> Columns:
    """A batch of a truth that is given, calibrated by a method and judged on new points alone."""
    block, calibrator = truth.draw(campaign.seed, number, width), calibrator_for(method, truth)
    found = calibrator.calibrate(block, np.arange(width))
    return held_out(new_places(campaign, cell), block.values, campaign.seed + 1, number, found, calibrator.construction)


def new_places(campaign: Campaign, cell: Cell) -> Truth:
    """The held-out room with the cell's kind of instrument."""
    room = load_scenario(HELD_OUT).model_copy(update={"instrument": cell.scenario.instrument})
    return truth_of(room, campaign.seed, "held out")


def as_applied(campaign: Campaign, cell: Cell, factor: float, number: int, width: int) -> Columns:
    """A batch by the calibration that users have, with what it takes out of readings."""
    truth = with_prior(truth_of(cell.scenario, campaign.seed, "campaign"), factor)
    block = truth.draw(campaign.seed, number, width)
    values = np.empty_like(block.values)
    for trial in range(width):
        values[:, :, trial] = calibrate_network(recording_of(truth, block, trial), advise=False).applied
    none = np.zeros(width)
    found = Calibrated(values, values[..., 0], np.zeros(0), none, none.astype(np.int64))
    return held_out(new_places(campaign, cell), block.values, campaign.seed + 1, number, found, truth.construction)


def prior_rows(
    given: Options, campaign: Campaign, cells: dict[str, Cell], law: dict[str, Any]
) -> tuple[list[Row], list[Mean]]:
    """Priors that are stated too narrow, right, too wide, or not at all."""
    rows, means = [], []
    methods = [m for m in campaign.methods if m.title in law["methods"]]
    few = min(law["trials_as_applied"], campaign.trials)
    for cell in (cells[title] for title in law["cells"]):
        for factor in law["factors"]:
            setting = f"{factor:g} x"
            parts: dict[str, Columns] = {}
            for method in methods:
                truth = with_prior(truth_of(cell.scenario, campaign.seed, "campaign"), factor)
                tasks = [(campaign, cell, truth, method, *block) for block in batches(campaign.trials)]
                parts[method.title] = stacked(spread_out(in_new_places, tasks, given.jobs))
            tasks = [(campaign, cell, factor, *block) for block in batches(few, 50)]
            parts["network, as applied"] = stacked(spread_out(as_applied, tasks, given.jobs))
            for name, columns in parts.items():
                rows.append({"cell": cell.title, "prior": setting, "method": name} | judged_row(columns))
                out = summary(columns["held_out_error_calibrated_um"])
                spread = (out[k] for k in ("mean", "low", "high", "p5", "p95"))
                means.append(Mean(f"{setting}: {cell.title}", name, *spread))
            write_table(given.out / "priors.csv", rows)
            tell(f"prior {setting}, {cell.title}: done")
    return rows, means


def beyond_rows(given: Options, campaign: Campaign, cells: dict[str, Cell], law: dict[str, Any]) -> list[Row]:
    """Coefficients of the D-H chain beyond the 16 parameters, larger than the fit expects them."""
    cell, rows = cells[law["cell"]], []
    truth = truth_of(cell.scenario, campaign.seed, "campaign")
    sigma = truth.population.sigma
    units = np.array([p.unit for p in truth.construction.parameters])
    small = sigma[0] < 0.1 * np.array([sigma[0, units == unit].max() for unit in units])
    for factor in law["factors"]:
        larger = replace(truth, population=replace(truth.population, sigma=np.where(small, factor * sigma, sigma)))
        for method in (m for m in campaign.methods if m.title in law["methods"]):
            tasks = [(campaign, cell, larger, method, *block) for block in batches(campaign.trials)]
            columns = stacked(spread_out(in_new_places, tasks, given.jobs))
            rows.append({"beyond": f"{factor:g} x", "method": method.title} | judged_row(columns))
        tell(f"coefficients beyond, {factor:g} x: done")
    return rows


def minimum_rows(campaign: Campaign, cell: Cell, trials: int) -> list[Row]:
    """The value of eq. 9 that each method reaches, in both norms, and in how many trials it is the least of all."""
    truth = truth_of(cell.scenario, campaign.seed, "campaign")
    block = truth.draw(campaign.seed, 0, trials)
    everyone, rows = np.arange(trials), []
    found = {"as read": np.zeros_like(block.values), "true parameters": block.values}
    for name, kind in (("distance", "distance"), ("distance-l1", "distance-l1"), ("network", "network")):
        found[name] = calibrator_for(Method(name=name, method=kind), truth).calibrate(block, everyone).values
    printed = {norm: Printed(truth, misalignment(), norm) for norm in ("distance", "distance-l1")}
    found["eq. 9, squares"] = printed["distance"].minimum(block)
    found["eq. 9, absolute"] = printed["distance-l1"].minimum(block)
    for norm, unit in (("distance", 1e6), ("distance-l1", 1e3)):
        reached = {name: printed[norm].reached(block, values) * unit for name, values in found.items()}
        least = np.min(list(reached.values()), axis=0)
        for name, value in reached.items():
            row: Row = {"cell": cell.title, "norm": "squares, mm^2" if unit == 1e6 else "absolute, mm", "method": name}
            row |= {k: v for k, v in summary(value, 4).items() if k in ("mean", "low", "high")}
            row["over_the_least_mean"] = round(float(np.mean(value / least)), 4)
            row["is_the_least_in"] = int(np.sum(value <= least * (1 + 1e-9)))
            rows.append(row | {"trials": trials})
    return rows


def run(given: Options) -> Made:
    campaign, listed = cells_of(HERE / "config.toml", given.trials)
    laws = tomllib.loads((HERE / "priors.toml").read_text(encoding="utf-8"))
    cells = {cell.title: cell for cell in listed}
    table: list[Row] = []
    shares: list[Row] = []
    parameters: list[Row] = []
    means: list[Mean] = []
    minimum: list[Row] = []
    for title in laws["minimum"]["cells"]:
        minimum += minimum_rows(campaign, cells[title], min(laws["minimum"]["trials"], campaign.trials))
        write_table(given.out / "minimum.csv", minimum)
        tell(f"{title}, minimum: done")
    for cell in listed:
        drawn = {}
        for method in campaign.methods:
            tasks = [(campaign, cell.scenario, method, *block) for block in batches(campaign.trials)]
            columns = drawn[method.title] = stacked(spread_out(compared, tasks, given.jobs))
            here = {"cell": cell.title, "method": method.title}
            table += [here | {"quantity": name} | summary(columns[name]) for name in JUDGED]
            shares.append(here | judged_row(columns))
            spread = summary(columns["held_out_error_calibrated_um"])
            means.append(Mean(cell.title, method.title, *(spread[k] for k in ("mean", "low", "high", "p5", "p95"))))
            tell(f"{cell.title}, {method.title}: done")
        tracker = cell.scenario.instrument
        # The bound is that of the stated noise, and of a model that lacks nothing.
        if tracker.construction == "misalignment" and tracker.noise_factor == 1.0:
            parameters += parameter_rows(campaign, cell, drawn)
        for name, rows in (("methods", table), ("share_removed", shares), ("parameters", parameters)):
            write_table(given.out / f"{name}.csv", rows)
        write_figure(given.out / "held_out.svg", by_setting(means, label=LABEL))
    write_table(given.out / "beyond.csv", beyond_rows(given, campaign, cells, laws["beyond"]))
    _, wrong = prior_rows(given, campaign, cells, laws)
    write_figure(given.out / "priors.svg", by_setting(wrong, label=LABEL))
    return Made(campaign.seed, campaign.trials)
