"""Figures of the paper in their simulated distributions: Table 3 in the workshop, Table 4 in the laboratory."""

from itertools import product

import numpy as np
import pandas as pd

from experiments.common import Options, RunRecord, cells_of, summary, write_figure, write_table
from ltsim.adjustment.evaluation.clouds import align_to_first_station, align_to_points
from ltsim.adjustment.evaluation.criteria import (
    StationDisagreement,
    coordinate_disagreement,
    coordinate_errors,
    distance_disagreement,
    distance_errors,
)
from ltsim.campaigns.shard_rows import CellContext, TrialBatchRowBuilder
from ltsim.campaigns.spec import CampaignCell, CampaignFile
from ltsim.core.arrays import Floats
from ltsim.core.parallel import run_parallel
from ltsim.core.units import MICROMETRE
from ltsim.reports.figures.campaign import PUBLISHED_CRITERIA_BY_SCENARIO, TrialDistribution, distributions_figure
from ltsim.simulation.workshop import measure_points_by_cmm

DRAWN_CELLS = {
    "workshop": {"noise_factor": 2.8, "error_factor": 0.7, "prior_factor": 1.0},
    "laboratory": {"noise_factor": 2.8, "error_factor": 2.8, "prior_factor": 1.0},
}
"""Noise, error and prior factors of the cells with figures: those whose simulated errors agree with the published
tables.
"""
TABLES = {
    table: {name.removesuffix("_um"): value for name, value in PUBLISHED_CRITERIA_BY_SCENARIO[f"paper-{table}"].items()}
    for table in DRAWN_CELLS
}
"""Published values of Tables 3 and 4 of the paper [um, %], by table and name of the value."""


def criteria_by_name(
    distance: StationDisagreement, coordinate: StationDisagreement, length: float, place: float
) -> dict[str, float]:
    """Both criteria [um] by name: mean, maximum, and the largest single term before averaging."""
    ends = (("distance", distance, length), ("coordinate", coordinate, place))
    sizes = {f"{kind}_{{}}_{which}": size for kind, measure, single in ends
             for which, size in (("mean", measure.mean), ("max", measure.maximum), ("single", single))}  # fmt: skip
    return {name: float(size) / MICROMETRE for name, size in sizes.items()}


def pair_distances(cloud: Floats) -> Floats:
    """Distances (..., P) between all pairs k < l of points (..., T, 3)."""
    first, second = np.triu_indices(cloud.shape[-2], k=1)
    return np.linalg.norm(cloud[..., first, :] - cloud[..., second, :], axis=-1)


def workshop_figures(clouds: Floats, names: tuple[str, ...]) -> dict[str, float]:
    """Distance and coordinate criteria [um] of the point clouds (S, T, 3) [m] of S stations."""
    lengths, placed = pair_distances(clouds), align_to_first_station(clouds, names)
    gaps, point_distances = lengths - lengths.mean(axis=0), np.linalg.norm(placed[:, None] - placed[None], axis=3)
    return criteria_by_name(
        distance_disagreement(clouds), coordinate_disagreement(placed), np.abs(gaps).max(), point_distances.max()
    )


def laboratory_figures(clouds: Floats, nominal_points: Floats) -> dict[str, float]:
    """Equations 13 and 14 of the paper [um], of point clouds (S, T, 3) [m] against nominal points (T, 3) [m]."""
    gaps = pair_distances(clouds) - pair_distances(nominal_points)
    miss = [np.linalg.norm(align_to_points(cloud, nominal_points) - nominal_points, axis=1).max() for cloud in clouds]
    errors = distance_errors(clouds, nominal_points), coordinate_errors(clouds, nominal_points)
    return criteria_by_name(*errors, np.abs(gaps).max(), max(miss))


def figures_of(campaign: CampaignFile, cell: CampaignCell) -> dict[tuple[str, str], pd.DataFrame]:
    """Values of each trial of a cell, by table and method.

    Table 3 has the criteria in the workshop, Table 4 the errors against a coordinate measuring machine in the
    laboratory.
    """
    context = CellContext(campaign, cell.scenario, cell.validation_scenario)
    trials: dict[tuple[str, str], list[dict[str, float]]] = {}
    for workshop, calibrators, block in context.trial_batches(0, campaign.trials):
        chosen = np.flatnonzero(block.trial_numbers < campaign.trials)
        work = TrialBatchRowBuilder(campaign, workshop, block, context.validation_evaluator, chosen, chosen[:0])
        assert work.validation_batch is not None
        assert cell.validation_scenario is not None
        laboratory, validation_block, _ = work.validation_batch
        room, names = laboratory.true_network, workshop.true_network.recording.stations
        true = (
            room.state.target_points,
            room.recording.targets,
            cell.validation_scenario.cmm,
            campaign.seed,
            "nominal",
        )
        nominal = {i: measure_points_by_cmm(*true, int(block.trial_numbers[i])) for i in chosen}
        for method, calibrator in zip(campaign.methods, calibrators, strict=True):
            values = calibrator.calibrate(block, chosen).instrument_values
            places = (("workshop", workshop, block), ("laboratory", laboratory, validation_block))
            for table, evaluator, batch in places:
                raw = evaluator.mean_points_by_station(batch.reading_deviations)
                corrected = evaluator.mean_points_by_station(batch.reading_deviations, calibrator.construction, values)
                for i in chosen:
                    row = {}
                    for when, clouds in (("before", raw), ("after", corrected)):
                        cloud = clouds[..., i]
                        sizes = (
                            workshop_figures(cloud, names)
                            if evaluator is workshop
                            else laboratory_figures(cloud, nominal[i])
                        )
                        row |= {name.format(when): size for name, size in sizes.items()}
                    trials.setdefault((table, method.title), []).append(row)
    trial_tables = {place: pd.DataFrame(rows) for place, rows in trials.items()}
    for kind, columns in product(("coordinate", "distance"), trial_tables.values()):
        gain = 1 - columns[f"{kind}_after_mean"] / columns[f"{kind}_before_mean"]
        columns[f"{kind}_improvement_percent"] = 100 * gain
    return trial_tables


def rows_of(columns: pd.DataFrame, cell: str, method: str, table: str) -> list[dict[str, object]]:
    """Row for each value of a published table: simulated distribution, published value, percentage of trials below."""
    rows = []
    for name, paper in TABLES[table].items():
        row = {"cell": cell, "method": method, "figure": name, "paper": paper} | summary(columns[name])
        row["percent_below_paper"] = round(100 * float(np.mean(columns[name] < paper)), 1)
        if name.endswith("max"):
            single = columns[name.replace("max", "single")]
            row["largest_single_term_mean"] = round(float(single.mean()), 1)
            row["percent_below_paper_single"] = round(100 * float(np.mean(single < paper)), 1)
        rows.append(row)
    return rows


def figure_rows(columns: pd.DataFrame, table: str) -> list[TrialDistribution]:
    """Panels of the figure: the eight values and two improvements of a table; each maximum by both definitions."""
    panels = []
    for name, paper in TABLES[table].items():
        title, unit = name.replace("_percent", "").replace("_", " "), "%" if name.endswith("percent") else "um"
        if not name.endswith("max"):
            panels.append(TrialDistribution(title, columns[name].to_numpy(), unit, paper))
            continue
        panels.append(TrialDistribution(f"{title} (averages)", columns[name].to_numpy(), unit, paper))
        panels.append(
            TrialDistribution(f"{title} (single)", columns[name.replace("max", "single")].to_numpy(), unit, paper)
        )
    return panels


def run(options: Options) -> RunRecord:
    campaign, cells = cells_of(options)
    cell_tables = list(run_parallel(figures_of, [(campaign, cell) for cell in cells], options.jobs))
    for table, name in (("workshop", "table_3"), ("laboratory", "table_4")):
        rows = [
            row
            for cell, tables in zip(cells, cell_tables, strict=True)
            for method in campaign.methods
            for row in rows_of(tables[table, method.title], cell.levels["title"], method.title, table)
        ]
        write_table(options.out / f"{name}.csv", rows)
        for cell, tables in zip(cells, cell_tables, strict=True):
            if {key: cell.levels[key] for key in DRAWN_CELLS[table]} == DRAWN_CELLS[table]:
                figure = distributions_figure(figure_rows(tables[table, "eq. 9"], table))
                figure.legends[0].set_title(f"{table}, {cell.levels['title']}, calibrated by eq. 9")
                figure.legends[0].set_alignment("left")
                write_figure(options.out / f"{name}.svg", figure)
    return RunRecord(campaign.seed, campaign.trials)
