"""Where a unit of each error moves a point the most, and which heights of the reflectors make the best calibration."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

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
from ltsim.arrays import Floats
from ltsim.model.construction import misalignment
from ltsim.pages.figures import Mean, by_setting
from ltsim.pages.style import CYCLE, new_figure, quiet_axis, styled
from ltsim.simulation.scenario import Scenario
from ltsim.units import DEGREE, MICROMETRE

HERE = Path(__file__).resolve().parent

AZIMUTHS = np.arange(0.0, 360.0, 15.0) * DEGREE


def displacements(scenario: Scenario, elevation: Floats, distance: float) -> Floats:
    """(e, p) [m]: rms over azimuth of the shift of a point by one prior sigma of each error."""
    built = misalignment()
    grid = np.array([[distance, a, e] for e in elevation for a in AZIMUTHS])
    change = built.reading_design(grid, np.zeros(built.size))[1]
    reach = np.stack([np.ones(len(grid)), distance * np.cos(grid[:, 2]), np.full(len(grid), distance)], axis=1)
    sigma = np.array([p.sigma_from(scenario.instrument.prior) for p in built.parameters])
    moved = np.linalg.norm(change * reach[:, :, None], axis=1) * sigma
    rms: Floats = np.sqrt(np.mean(moved.reshape(len(elevation), len(AZIMUTHS), -1) ** 2, axis=1))
    return rms


def sensitivity_rows(scenario: Scenario, grid: dict[str, Any]) -> list[Row]:
    """A row an error, distance and elevation."""
    rows = []
    for distance in grid["range_m"]:
        moved = displacements(scenario, np.array(grid["elevation_deg"]) * DEGREE, distance)
        for k, parameter in enumerate(misalignment().parameters):
            for i, elevation in enumerate(grid["elevation_deg"]):
                rows.append(
                    {
                        "error": parameter.name,
                        "range_m": distance,
                        "elevation_deg": elevation,
                        "shift_um": round(float(moved[i, k]) / MICROMETRE, 3),
                    }
                )
    return rows


def with_heights(scenario: Scenario, heights: list[float]) -> Scenario:
    """The scenario with heights dealt to its reflectors in turn."""
    targets = {}
    for i, (name, target) in enumerate(scenario.targets.items()):
        x, y, _ = target.position_mm
        targets[name] = target.model_copy(update={"position_mm": (x, y, float(heights[i % len(heights)]))})
    return scenario.model_copy(update={"targets": targets})


@styled
def by_elevation(rows: list[Row], distance: float) -> Figure:
    """Shift of a point against elevation, a line an error; errors with the same line share it."""
    figure = new_figure(4.4)
    ax = figure.subplots()
    lines: dict[tuple[float, ...], list[str]] = {}
    for name in dict.fromkeys(row["error"] for row in rows):
        shifts = [row["shift_um"] for row in rows if row["error"] == name and row["range_m"] == distance]
        lines.setdefault(tuple(shifts), []).append(name)
    elevation = sorted({row["elevation_deg"] for row in rows})
    for k, (shifts, names) in enumerate(lines.items()):
        style = "-" if k < len(CYCLE) else "--"
        ax.plot(elevation, shifts, color=CYCLE[k % len(CYCLE)], linestyle=style, label=", ".join(names))
    ax.set_xlabel("elevation [°]")
    ax.set_ylabel(f"shift by one sigma at {distance:g} m [µm]")
    quiet_axis(ax, grid="both")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", fontsize=7, ncols=1)
    return figure


def run(given: Options) -> Made:
    campaign, cells = cells_of(HERE / "config.toml", given.trials)
    scenario = cells[0].scenario
    designs = tomllib.loads((HERE / "designs.toml").read_text(encoding="utf-8"))
    rows = sensitivity_rows(scenario, designs["grid"])
    table: list[Row] = []
    means: list[Mean] = []
    first: dict[str, Floats] = {}
    for name, heights in designs["heights_mm"].items():
        for method in campaign.methods:
            tasks = [(campaign, with_heights(scenario, heights), method, *block) for block in batches(campaign.trials)]
            columns = stacked(spread_out(compared, tasks, given.jobs))
            out = summary(columns["held_out_error_calibrated_um"])
            row: Row = {"heights": name, "method": method.title}
            row |= {f"held_out_error_{key}_um": value for key, value in out.items() if key != "trials"} | beside_floor(
                columns
            )
            # The same instruments, mesh by mesh: the difference from the first design is better known than either mean.
            error = columns["held_out_error_calibrated_um"]
            more = summary(error - first.setdefault(method.title, error))
            row |= {f"over_the_first_{key}_um": more[key] for key in ("mean", "low", "high")}
            row["held_out_share"] = round(share(columns, "held_out_"), 4)
            row["distance_improvement_percent"] = summary(columns["distance_improvement_percent"])["mean"]
            table.append(row | {"trials": out["trials"]})
            means.append(Mean(name, method.title, *(out[k] for k in ("mean", "low", "high", "p5", "p95"))))
        tell(f"{name}: done")
    write_table(given.out / "sensitivity.csv", rows)
    write_table(given.out / "designs.csv", table)
    write_figure(given.out / "sensitivity.svg", by_elevation(rows, 4.0))
    write_figure(given.out / "designs.svg", by_setting(means, label="rms error on held-out points [µm]"))
    return Made(campaign.seed, campaign.trials)
