"""Sensitivity of a point to each instrument error by elevation, and heights of reflectors for a calibration."""

from itertools import cycle
from textwrap import fill

import numpy as np
from matplotlib.figure import Figure

from experiments.common import (
    ERROR,
    NEW_POINTS,
    Options,
    Row,
    RunRecord,
    campaign,
    write_figure,
    write_paired_differences,
    write_table,
)
from ltsim.core.arrays import Floats
from ltsim.core.units import DEGREE, MICROMETRE
from ltsim.physics.model.construction import misalignment_construction
from ltsim.reports.figures.campaign import cell_rows_figure, sweep_points
from ltsim.reports.style import COLOUR_CYCLE, new_figure, set_grid, with_figure_style
from ltsim.simulation.scenario import Scenario, load_scenario

DESIGNS = (
    (5900, 2000, 150), (2000,), (5900,), (5900, 150), (5900, 2000), (150, 2000), (4300, 3200, 1000),
    (150, 970, 1790, 2610, 3440, 4260, 5080, 5900),
)  # fmt: skip
"""Heights of reflectors [mm] of each design, assigned cyclically to T01, T02, ...; the first design is that of the
paper.
"""
ELEVATIONS, RANGE_M = tuple(range(-50, 75, 5)), 4.0
AZIMUTHS = np.arange(0.0, 360.0, 15.0) * DEGREE


def displacements(scenario: Scenario, elevation: Floats, distance: float) -> Floats:
    """(e, p) [m] Displacement of a point by one prior sigma of each error at each elevation, rms over azimuth."""
    built = misalignment_construction()
    grid = np.array([[distance, a, e] for e in elevation for a in AZIMUTHS])
    change = built.reading_design(grid, np.zeros(built.n_parameters))[1]
    reach = np.stack([np.ones(len(grid)), distance * np.cos(grid[:, 2]), np.full(len(grid), distance)], axis=1)
    sigma = np.array([p.prior_sigma_from(scenario.instrument.prior) for p in built.parameters])
    moved = np.linalg.norm(change * reach[:, :, None], axis=1) * sigma
    rms: Floats = np.sqrt(np.mean(moved.reshape(len(elevation), len(AZIMUTHS), -1) ** 2, axis=1))
    return rms


def sensitivity_rows(scenario: Scenario) -> list[Row]:
    """Row for each instrument error and elevation, with the displacement of a point [um]."""
    moved = displacements(scenario, np.array(ELEVATIONS) * DEGREE, RANGE_M) / MICROMETRE
    return [
        {"error": parameter.name, "elevation_deg": elevation, "shift_um": round(float(moved[i, k]), 3)}
        for k, parameter in enumerate(misalignment_construction().parameters)
        for i, elevation in enumerate(ELEVATIONS)
    ]


@with_figure_style
def by_elevation(rows: list[Row], distance: float) -> Figure:
    """Figure of the displacement of a point over elevation; errors with equal displacements share a line."""
    figure = new_figure(4.4)
    ax = figure.subplots()
    lines: dict[tuple[float, ...], list[str]] = {}
    for name in dict.fromkeys(row["error"] for row in rows):
        shifts = [row["shift_um"] for row in rows if row["error"] == name]
        lines.setdefault(tuple(shifts), []).append(name)
    elevation = sorted({row["elevation_deg"] for row in rows})
    for k, (shifts, names) in enumerate(lines.items()):
        style = "-" if k < len(COLOUR_CYCLE) else "--"
        ax.plot(
            elevation,
            shifts,
            color=COLOUR_CYCLE[k % len(COLOUR_CYCLE)],
            linestyle=style,
            label=fill(", ".join(names), 75, break_on_hyphens=False),
        )
    ax.set_xlabel("elevation [°]")
    ax.set_ylabel(f"shift by one sigma at {distance:g} m [µm]")
    set_grid(ax, grid_axis="both")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", fontsize=7, ncols=1)
    return figure


def run(options: Options) -> RunRecord:
    scenario = load_scenario("paper-workshop")
    rows = sensitivity_rows(scenario)
    write_table(options.out / "sensitivity.csv", rows)
    write_figure(options.out / "sensitivity.svg", by_elevation(rows, RANGE_M))
    cells = []
    for heights in DESIGNS:
        title = ", ".join(f"{height / 1000:g}" for height in heights) + " m"
        dealt = zip(scenario.targets.items(), cycle(heights), strict=False)
        moved = {f"targets.{name}.position_mm": [*target.position_mm[:2], height] for (name, target), height in dealt}
        cells.append({"title": title if len(heights) <= 3 else f"{len(heights)} heights"} | moved)
    results = campaign("config.toml", options, cells=cells)
    figure = cell_rows_figure(sweep_points(results, ERROR, "title"), x_label=NEW_POINTS)
    figure.axes[0].set_ylabel("heights of the reflectors")
    write_figure(options.out / "designs.svg", figure)
    # All designs use the same instruments, so the difference from the paper's design is more certain than each mean.
    first, *others = [cell["title"] for cell in cells]
    pairs = [results.paired_differences(ERROR, title=(other, first)) for other in others]
    write_paired_differences(options.out / "more_than_the_paper.csv", *pairs)
    return RunRecord(results.manifest.seed, results.manifest.trials)
