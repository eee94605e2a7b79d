"""Bench test of a reflector on a roundness table: errors that the probe and the interferometer separate."""

from typing import Any

import numpy as np

from experiments.common import Options, RunRecord, print_line, write_figure, write_table
from experiments.virtual_bench import MIDDLE, BenchTest, measure_bench, vertex_table
from ltsim.adjustment.evaluation.bench import ReflectorBenchEstimates, evaluate_reflector_bench, fit_vertex_offset
from ltsim.core.arrays import Floats
from ltsim.core.randomness import random_stream
from ltsim.core.units import DEGREE, MICROMETRE
from ltsim.physics.effects.smr_incidence import INCIDENCE_TABLE_ANGLES
from ltsim.reports.figures.campaign import SweepPoint, sweep_panels_figure


def table_of(reflector: dict[str, Any]) -> Floats:
    """Range error (9,) [m] of a reflector in `config.toml`."""
    if "range_error_table_um" in reflector:
        return np.array(reflector["range_error_table_um"]) * MICROMETRE
    return vertex_table(reflector.get("axial_um", 0.0) * MICROMETRE, reflector.get("side_um", 0.0) * MICROMETRE)


def trial(table: Floats, eccentricity: float, probe: Floats, seed: int, number: int) -> ReflectorBenchEstimates:
    """Estimates from one test of a reflector with an eccentric sphere.

    The sphere has the distance `eccentricity` [m] from the axis of the table, in a random direction.
    """
    direction = 2 * np.pi * random_stream(seed, "direction", number).random()
    offset = eccentricity * np.array([np.cos(direction), np.sin(direction)])
    return evaluate_reflector_bench(
        measure_bench(BenchTest(table=table, eccentricity=offset, probe_angles=probe), seed, number)
    )


def row_of(results: list[ReflectorBenchEstimates], table: Floats) -> dict[str, float]:
    """Differences [um] between estimated and true range errors, and parameters of a vertex offset fitted to them."""
    true = table - table[MIDDLE]

    def rms(tables: list[Floats]) -> float:
        return float(np.sqrt(np.mean((np.array(tables) - true) ** 2))) / MICROMETRE

    def worst_error(tables: list[Floats]) -> float:
        return float(np.percentile(np.abs(np.array(tables) - true).max(axis=1), 95)) / MICROMETRE

    vertices = [
        fit_vertex_offset(INCIDENCE_TABLE_ANGLES, r.range_errors, float(r.range_error_sigmas.max())) for r in results
    ]
    return {
        "run_out_um": float(np.mean([r.run_out for r in results])) / MICROMETRE,
        "rms_uncorrected_um": rms([r.uncorrected_lengths for r in results]),
        "rms_corrected_um": rms([r.range_errors for r in results]),
        "worst_95_uncorrected_um": worst_error([r.uncorrected_lengths for r in results]),
        "worst_95_corrected_um": worst_error([r.range_errors for r in results]),
        "vertex_side_um": float(np.mean([v.side_offset for v in vertices])) / MICROMETRE,
        "vertex_axial_um": float(np.mean([v.axial_offset for v in vertices])) / MICROMETRE,
        "unexplained_by_vertex_um": float(np.mean([v.unexplained_rms for v in vertices])) / MICROMETRE,
    }


def panel(name: str, table: Floats, results: list[ReflectorBenchEstimates]) -> list[SweepPoint]:
    """Mean error and middle 90 % of the trials by angle of incidence, with and without correction by the probe."""
    lines = {
        "lengths as recorded": [r.uncorrected_lengths for r in results],
        "eccentricity removed": [r.range_errors for r in results],
    }
    rows = []
    for line, tables in lines.items():
        errors = np.array(tables) - (table - table[MIDDLE])
        mean, (five, ninety_five) = errors.mean(axis=0), np.percentile(errors, [5, 95], axis=0)
        half = 1.96 * errors.std(axis=0) / np.sqrt(len(errors))
        columns = np.array([mean, mean - half, mean + half, five, ninety_five]) / MICROMETRE
        rows += [
            SweepPoint(a, line, name, *c)
            for a, c in zip(INCIDENCE_TABLE_ANGLES / DEGREE, columns.T.tolist(), strict=True)
        ]
    return rows


def run(options: Options) -> RunRecord:
    config = options.config
    trials, seed = options.trials or config["trials"], config["seed"]
    rows: list[dict[str, Any]] = []
    points: list[SweepPoint] = []
    for name, reflector in config["reflectors"].items():
        table = table_of(reflector)
        for probed, (first, last, step) in config["probe_angles_deg"].items():
            probe = np.arange(first, last + 0.5 * step, step) * DEGREE
            for size in config["eccentricity_um"]:
                results = [trial(table, size * MICROMETRE, probe, seed, i) for i in range(trials)]
                rows.append({"reflector": name, "probe": probed, "eccentricity_um": size} | row_of(results, table))
                if size == 5.0 and probed == "full turn":
                    points += panel(name, table, results)
        print_line(f"{name}: done")
    write_table(options.out / "bench.csv", rows)
    label = "estimated minus true range error [µm]"
    figure = sweep_panels_figure(points, statistic_title=label, x_title="incidence [°]")
    write_figure(options.out / "tables.svg", figure)
    return RunRecord(seed, trials)
