"""The reflector on the roundness table: what the probe and the interferometer tell apart, and what 13 um can mean."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.common import Made, Options, tell, write_figure, write_table
from experiments.virtual_bench import MIDDLE, BenchTest, measure_bench, vertex_table
from ltsim.arrays import Floats
from ltsim.effects.smr_incidence import TABLE_ANGLES
from ltsim.evaluation.bench import BenchResult, as_vertex, evaluate_bench
from ltsim.pages.style import CYCLE, new_figure, quiet_axis, styled
from ltsim.randomness import stream
from ltsim.units import DEGREE, MICROMETRE

HERE = Path(__file__).resolve().parent


def table_of(reflector: dict[str, Any]) -> Floats:
    """Range error (9,) [m] of a reflector of the file."""
    if "table_um" in reflector:
        return np.array(reflector["table_um"]) * MICROMETRE
    return vertex_table(reflector.get("axial_um", 0.0) * MICROMETRE, reflector.get("side_um", 0.0) * MICROMETRE)


def trial(table: Floats, eccentricity: float, probe: Floats, seed: int, number: int) -> BenchResult:
    """One test of a reflector whose sphere is off the table's axis by `eccentricity` [m] in a drawn direction."""
    way = 2 * np.pi * stream(seed, "direction", number).random()
    off = eccentricity * np.array([np.cos(way), np.sin(way)])
    return evaluate_bench(measure_bench(BenchTest(table=table, eccentricity=off, probe_angles=probe), seed, number))


def row_of(results: list[BenchResult], table: Floats) -> dict[str, float]:
    """How far the found tables are from the one put in [um], and the explanation by a vertex."""
    true = table - table[MIDDLE]

    def rms(found: list[Floats]) -> float:
        return round(float(np.sqrt(np.mean((np.array(found) - true) ** 2))) / MICROMETRE, 3)

    def at_edge(found: list[Floats]) -> float:
        return round(float(np.percentile(np.abs(np.array(found) - true).max(axis=1), 95)) / MICROMETRE, 3)

    vertices = [as_vertex(TABLE_ANGLES, r.table, float(r.sigma.max())) for r in results]
    return {
        "run_out_um": round(float(np.mean([r.run_out for r in results])) / MICROMETRE, 2),
        "rms_uncorrected_um": rms([r.uncorrected for r in results]),
        "rms_corrected_um": rms([r.table for r in results]),
        "worst_95_uncorrected_um": at_edge([r.uncorrected for r in results]),
        "worst_95_corrected_um": at_edge([r.table for r in results]),
        "largest_of_table_um": round(float(np.mean([np.abs(r.table).max() for r in results])) / MICROMETRE, 2),
        "vertex_side_um": round(float(np.mean([v.side for v in vertices])) / MICROMETRE, 2),
        "vertex_axial_um": round(float(np.mean([v.axial for v in vertices])) / MICROMETRE, 1),
        "left_by_vertex_um": round(float(np.mean([v.remainder for v in vertices])) / MICROMETRE, 2),
    }


@styled
def tables_found(shown: dict[str, tuple[Floats, list[BenchResult]]]) -> Figure:
    """A panel a reflector: the table put in, the found ones with and without the probe's correction."""
    figure = new_figure(4.2)
    axes = figure.subplots(2, 2, sharex=True)
    degrees = TABLE_ANGLES / DEGREE
    for ax, (name, (table, results)) in zip(axes.flat, shown.items(), strict=False):
        for result in results[:12]:
            ax.plot(degrees, result.uncorrected / MICROMETRE, color=CYCLE[3], linewidth=0.6, alpha=0.55)
        for result in results[:12]:
            ax.plot(degrees, result.table / MICROMETRE, color=CYCLE[0], linewidth=0.8)
        ax.scatter(degrees, (table - table[MIDDLE]) / MICROMETRE, color="black", s=16, zorder=4)
        ax.set_title(name)
        quiet_axis(ax, grid="both")
    for ax in axes[1]:
        ax.set_xlabel("incidence [°]")
    figure.supylabel("range error less that at 0° [µm]", fontsize=8.5)
    handles = [
        axes[0, 0].plot([], [], color=CYCLE[3], label="lengths as recorded")[0],
        axes[0, 0].plot([], [], color=CYCLE[0], label="eccentricity taken off")[0],
        axes[0, 0].plot([], [], "o", color="black", markersize=4, label="put in")[0],
    ]
    figure.legend(handles=handles, loc="outside upper right", ncols=3)
    return figure


def run(given: Options) -> Made:
    config = tomllib.loads((HERE / "config.toml").read_text(encoding="utf-8"))
    trials, seed = given.trials or config["trials"], config["seed"]
    rows: list[dict[str, Any]] = []
    shown: dict[str, tuple[Floats, list[BenchResult]]] = {}
    for name, reflector in config["reflectors"].items():
        table = table_of(reflector)
        for probed, (first, last, step) in config["probe_angles_deg"].items():
            probe = np.arange(first, last + 0.5 * step, step) * DEGREE
            for size in config["eccentricity_um"]:
                results = [trial(table, size * MICROMETRE, probe, seed, i) for i in range(trials)]
                rows.append({"reflector": name, "probe": probed, "eccentricity_um": size} | row_of(results, table))
                if size == 5.0 and probed == "full turn":
                    shown[name] = table, results
        tell(f"{name}: done")
    write_table(given.out / "bench.csv", rows)
    write_figure(given.out / "tables.svg", tables_found(shown))
    return Made(seed, trials)
