"""Where the paper's figures lie: Table 3 in the simulated workshop, Table 4 in the simulated laboratory."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.common import (
    Cell,
    Made,
    Options,
    batches,
    calibrator_for,
    cells_of,
    same_instrument,
    spread_out,
    stacked,
    summary,
    tell,
    with_prior,
    write_figure,
    write_table,
)
from ltsim.arrays import Floats
from ltsim.campaigns.cell import truth_of
from ltsim.campaigns.engine import Bench
from ltsim.campaigns.spec import Campaign, Method
from ltsim.evaluation.clouds import in_first_frame, on_points
from ltsim.evaluation.criteria import coordinate_differences, distance_differences, pair_distances
from ltsim.evaluation.verification import coordinate_errors, distance_errors
from ltsim.pages.figures import Distribution, distributions
from ltsim.simulation.gauge import nominal_points
from ltsim.units import MICROMETRE

HERE = Path(__file__).resolve().parent

MATCHED = 1
"""Cell of config.toml with the size of errors that gives the figures of Table 3 before calibration."""
GROWN = 2
"""Cell whose errors the figures of Table 4 need."""
TAKEN_ALONG = 3
"""So many first cells of config.toml have their instruments taken to the laboratory."""
TO_THE_LABORATORY = ("eq. 9", "distance")
"""Methods that are judged there."""
PAPER: dict[str, dict[str, float]] = {
    "workshop": {
        "coordinate_before_max": 149,
        "coordinate_before_mean": 46,
        "distance_before_max": 60,
        "distance_before_mean": 29,
        "coordinate_after_max": 118,
        "coordinate_after_mean": 39,
        "distance_after_max": 39,
        "distance_after_mean": 17,
        "coordinate_improvement_percent": 14.47,
        "distance_improvement_percent": 40.1,
    },
    "laboratory": {
        "coordinate_before_max": 54,
        "coordinate_before_mean": 21,
        "distance_before_max": 84,
        "distance_before_mean": 24,
        "coordinate_after_max": 41,
        "coordinate_after_mean": 17,
        "distance_after_max": 53,
        "distance_after_mean": 18,
        "coordinate_improvement_percent": 17.98,
        "distance_improvement_percent": 25.53,
    },
}
"""Tables 3 and 4 [um, %]."""
Columns = dict[str, Floats]


def workshop_figures(clouds: Floats, names: tuple[str, ...]) -> dict[str, float]:
    """Both criteria of clouds (S, T, 3) [m]; `single`: the largest of all terms, before any average."""
    lengths = pair_distances(clouds)
    placed = in_first_frame(clouds, names)
    distance, coordinate = distance_differences(clouds), coordinate_differences(placed)
    return {
        "distance_mean": distance.mean,
        "distance_max": distance.maximum,
        "distance_single": float(np.abs(lengths - lengths.mean(axis=0)).max()),
        "coordinate_mean": coordinate.mean,
        "coordinate_max": coordinate.maximum,
        "coordinate_single": float(np.linalg.norm(placed[:, None] - placed[None], axis=3).max()),
    }


def laboratory_figures(clouds: Floats, nominal: Floats) -> dict[str, float]:
    """Equations 13 and 14 as meant, of clouds (S, T, 3) [m] against nominal points (T, 3) [m]."""
    distance, coordinate = distance_errors(clouds, nominal), coordinate_errors(clouds, nominal)
    miss = [np.linalg.norm(on_points(cloud, nominal) - nominal, axis=1).max() for cloud in clouds]
    return {
        "distance_mean": distance.mean,
        "distance_max": distance.maximum,
        "distance_single": float(np.abs(pair_distances(clouds) - pair_distances(nominal)).max()),
        "coordinate_mean": coordinate.mean,
        "coordinate_max": coordinate.maximum,
        "coordinate_single": float(max(miss)),
    }


def joined(before: Sequence[dict[str, float]], after: Sequence[dict[str, float]]) -> Columns:
    """Columns [um, %] of trials before and after calibration."""
    columns = {}
    for key in before[0]:
        kind, which = key.split("_")
        for when, rows in (("before", before), ("after", after)):
            columns[f"{kind}_{when}_{which}"] = np.array([row[key] for row in rows]) / MICROMETRE
    for kind in ("coordinate", "distance"):
        gain = 1 - columns[f"{kind}_after_mean"] / columns[f"{kind}_before_mean"]
        columns[f"{kind}_improvement_percent"] = 100 * gain
    return columns


def one_batch(
    campaign: Campaign,
    cell: Cell,
    method: Method,
    number: int,
    width: int,
    others: list[Cell],
    seed: int,
    factor: float = 1.0,
) -> tuple[Columns, list[Columns]]:
    """A batch of trials: the workshop's figures, then those of every laboratory with the same instruments.

    Priors are stated `factor` times as wide as the errors are drawn.
    """
    truth = with_prior(truth_of(cell.scenario, campaign.seed, "campaign"), factor)
    judge, calibrator = Bench(truth).judge, calibrator_for(method, truth)
    block = truth.draw(campaign.seed, number, width)
    found = calibrator.calibrate(block, np.arange(width))
    names = truth.recording.stations
    raw = judge.clouds(block.deviation).points
    corrected = judge.clouds(block.deviation, calibrator.construction, found.values).points
    here = joined(
        [workshop_figures(raw[..., i], names) for i in range(width)],
        [workshop_figures(corrected[..., i], names) for i in range(width)],
    )
    there = []
    for other in others:
        room = truth_of(other.scenario, seed, "laboratory")
        grown = block.values * other.scenario.instrument.error_factor
        elsewhere, bench = same_instrument(room, grown, seed, number), Bench(room).judge
        names_there = room.recording.targets
        nominal = [
            nominal_points(room.state.points, names_there, other.scenario.cmm, seed, "nominal", number, i)
            for i in range(width)
        ]
        raw = bench.clouds(elsewhere.deviation).points
        corrected = bench.clouds(elsewhere.deviation, calibrator.construction, found.values).points
        there.append(
            joined(
                [laboratory_figures(raw[..., i], nominal[i]) for i in range(width)],
                [laboratory_figures(corrected[..., i], nominal[i]) for i in range(width)],
            )
        )
    return here, there


def rows_of(columns: Columns, cell: str, method: str, table: str) -> list[dict[str, object]]:
    """A row a figure: its distribution, the paper's value and the share of trials below it."""
    rows = []
    for name, paper in PAPER[table].items():
        row = {"cell": cell, "method": method, "figure": name, "paper": paper} | summary(columns[name])
        row["percent_below_paper"] = round(100 * float(np.mean(columns[name] < paper)), 1)
        if name.endswith("max"):
            single = columns[name.replace("max", "single")]
            row["largest_single_term_mean"] = round(float(single.mean()), 1)
            row["percent_below_paper_single"] = round(100 * float(np.mean(single < paper)), 1)
        rows.append(row)
    return rows


def figure_rows(columns: Columns, table: str) -> list[Distribution]:
    """Panels: the table's eight figures and two improvements, each maximum by both definitions."""
    panels = []
    for name, paper in PAPER[table].items():
        title, unit = name.replace("_percent", "").replace("_", " "), "%" if name.endswith("percent") else "um"
        if not name.endswith("max"):
            panels.append(Distribution(title, columns[name], unit, paper))
            continue
        panels.append(Distribution(f"{title} (averages)", columns[name], unit, paper))
        panels.append(Distribution(f"{title} (single)", columns[name.replace("max", "single")], unit, paper))
    return panels


def prior_rows(given: Options, campaign: Campaign, cell: Cell, factors: list[float]) -> list[dict[str, object]]:
    """Table 3 of the cell that matches it, when the priors are stated too narrow, too wide or not at all (1e6)."""
    rows: list[dict[str, object]] = []
    for factor in factors:
        for method in campaign.methods:
            tasks = [(campaign, cell, method, *block, [], 0, factor) for block in batches(campaign.trials)]
            columns = stacked([here for here, _ in spread_out(one_batch, tasks, given.jobs)])
            title = "none" if factor == 1e6 else f"{factor:g} x"
            rows += [{"prior": title} | row for row in rows_of(columns, cell.title, method.title, "workshop")]
        tell(f"prior {title}: done")
    return rows


def run(given: Options) -> Made:
    campaign, cells = cells_of(HERE / "config.toml", given.trials)
    laboratory, rooms = cells_of(HERE / "laboratory.toml")
    workshop_table, laboratory_table, drawn = [], [], {}
    for k, cell in enumerate(cells):
        for method in campaign.methods:
            others = rooms if k < TAKEN_ALONG and method.title in TO_THE_LABORATORY else []
            tasks = [
                (campaign, cell, method, number, width, others, laboratory.seed)
                for number, width in batches(campaign.trials)
            ]
            parts = spread_out(one_batch, tasks, given.jobs)
            columns = stacked([here for here, _ in parts])
            workshop_table += rows_of(columns, cell.title, method.title, "workshop")
            drawn[k, method.title] = columns
            for i, room in enumerate(others):
                there = stacked([part[i] for _, part in parts])
                drawn[k, f"{method.title}, {room.title}"] = there
                laboratory_table += [
                    {"workshop": cell.title} | row for row in rows_of(there, room.title, method.title, "laboratory")
                ]
            tell(f"{cell.title}, {method.title}: done")
    write_table(given.out / "table_3.csv", workshop_table)
    write_table(given.out / "table_4.csv", laboratory_table)
    write_figure(given.out / "table_3.svg", distributions(figure_rows(drawn[MATCHED, "eq. 9"], "workshop")))
    write_figure(
        given.out / "table_4.svg", distributions(figure_rows(drawn[GROWN, f"eq. 9, {rooms[1].title}"], "laboratory"))
    )
    factors = tomllib.loads((HERE / "priors.toml").read_text(encoding="utf-8"))["factors"]
    write_table(given.out / "priors.csv", prior_rows(given, campaign, cells[MATCHED], factors))
    return Made(campaign.seed, campaign.trials, {"laboratory_seed": laboratory.seed})
