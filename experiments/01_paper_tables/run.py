"""Where the paper's figures lie: Table 3 in the simulated workshop, Table 4 in the simulated laboratory."""

import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.common import Made, Options, cells_of, spread_out, stacked, summary, write_figure, write_table
from ltsim.arrays import Floats
from ltsim.campaigns.rows import Prepared, Work
from ltsim.campaigns.spec import Campaign, Cell
from ltsim.evaluation.clouds import in_first_frame, on_points
from ltsim.evaluation.criteria import coordinate_differences, distance_differences, pair_distances
from ltsim.evaluation.verification import coordinate_errors, distance_errors
from ltsim.pages.figures.campaign import Distribution, distributions
from ltsim.simulation.gauge import nominal_points
from ltsim.units import MICROMETRE

DRAWN = {
    "workshop": {"noise_factor": 2.8, "error_factor": 0.7, "prior_factor": 1.0},
    "laboratory": {"noise_factor": 2.8, "error_factor": 2.8, "prior_factor": 1.0},
}
"""The cells whose distributions are drawn: those whose errors give the table's figures."""
PAPER: dict[str, dict[str, float]] = tomllib.loads(Path(__file__).with_name("paper.toml").read_text(encoding="utf-8"))
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


def figures_of(campaign: Campaign, cell: Cell) -> dict[tuple[str, str], Columns]:
    """Columns of a cell by table and method: the workshop's criteria, the laboratory's by its measuring machine."""
    ready = Prepared(campaign, cell.scenario, cell.judge)
    parts: dict[tuple[str, str], list[Columns]] = {}
    for here, calibrators, block in ready.blocks(0, campaign.trials):
        numbers = block.trials
        wanted = np.flatnonzero(numbers < campaign.trials)
        work = Work(campaign, here, block, ready.elsewhere, wanted, wanted[:0])
        assert work.new_points is not None
        assert cell.judge is not None
        there, elsewhere, _ = work.new_points
        room = there.truth
        true = (room.state.points, room.recording.targets, cell.judge.cmm, campaign.seed, "nominal")
        nominal = {i: nominal_points(*true, int(numbers[i])) for i in wanted}
        names = here.truth.recording.stations
        for method, calibrator in zip(campaign.methods, calibrators, strict=True):
            found = calibrator.calibrate(block, wanted)
            for table, judge, own in (("workshop", here, block), ("laboratory", there, elsewhere)):
                raw = judge.clouds(own.deviation)
                corrected = judge.clouds(own.deviation, calibrator.construction, found.values)
                before, after = (
                    [
                        workshop_figures(clouds[..., i], names)
                        if table == "workshop"
                        else laboratory_figures(clouds[..., i], nominal[i])
                        for i in wanted
                    ]
                    for clouds in (raw, corrected)
                )
                parts.setdefault((table, method.title), []).append(joined(before, after))
    return {place: stacked(own) for place, own in parts.items()}


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


def run(given: Options) -> Made:
    campaign, cells = cells_of(given)
    found = spread_out(figures_of, [(campaign, cell) for cell in cells], given.jobs)
    for table, name in (("workshop", "table_3"), ("laboratory", "table_4")):
        rows = [
            row
            for cell, own in zip(cells, found, strict=True)
            for method in campaign.methods
            for row in rows_of(own[table, method.title], cell.levels["title"], method.title, table)
        ]
        write_table(given.out / f"{name}.csv", rows)
        for cell, own in zip(cells, found, strict=True):
            if {key: cell.levels[key] for key in DRAWN[table]} == DRAWN[table]:
                figure = distributions(figure_rows(own[table, "eq. 9"], table))
                figure.legends[0].set_title(f"{table}, {cell.levels['title']}, calibrated by eq. 9")
                figure.legends[0].set_alignment("left")
                write_figure(given.out / f"{name}.svg", figure)
    return Made(campaign.seed, campaign.trials)
