"""Gauges of 0 to 8 reflectors; harmonics of order 1 to 4 fitted to truths of order 2 and 4, judged on held-out data."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import (
    HELD_OUT,
    Made,
    Options,
    batches,
    beside_floor,
    calibrated,
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
from ltsim.campaigns.calibrators import Calibrator, calibrator_of
from ltsim.campaigns.cell import truth_of
from ltsim.campaigns.distance import BatchDistance
from ltsim.campaigns.engine import Engine
from ltsim.campaigns.spec import Campaign, Method
from ltsim.campaigns.truth import Truth
from ltsim.effects import BASELINE
from ltsim.effects.azimuth_harmonic import AzimuthHarmonic
from ltsim.effects.azimuth_second_order import AzimuthSecondOrder
from ltsim.effects.effect import SlotEffect
from ltsim.effects.elevation_harmonic import ElevationHarmonic
from ltsim.effects.elevation_second_order import ElevationSecondOrder
from ltsim.model.construction import Construction, misalignment
from ltsim.pages.figures import Mean, by_setting
from ltsim.simulation.gauge import frame_of
from ltsim.simulation.scenario import Scenario, load_scenario
from ltsim.simulation.sections import Gauge, GaugeLength
from ltsim.units import MICRORADIAN, MILLIMETRE

HERE = Path(__file__).resolve().parent

Row = dict[str, Any]


def with_gauge(scenario: Scenario, count: int, size: float, extra: dict[str, list[float]]) -> Scenario:
    """The scenario with a gauge of the first `count` reflectors; 0: none."""
    if count == 0:
        return scenario.model_copy(update={"gauge": None})
    gauge = scenario.gauge
    assert isinstance(gauge, Gauge)
    frame = frame_of(gauge)
    points = dict(zip(frame.names, frame.points / MILLIMETRE, strict=True)) | {n: np.array(p) for n, p in extra.items()}
    # Two reflectors: the longest of the six lengths of Table 2.
    names = ["T26", "T27"] if count == 2 else list(points)[:count]
    lengths = tuple(
        GaugeLength(**{"from": a, "to": b, "length_mm": size * float(np.linalg.norm(points[a] - points[b]))})
        for a, b in combinations(names, 2)
    )
    place = tuple(x + 400.0 * (size - 1.0) for x in gauge.position_mm)
    changed = {"targets": tuple(names), "distance": lengths, "position_mm": place}
    return scenario.model_copy(update={"gauge": gauge.model_copy(update=changed)})


def judged(truth: Truth, room: Truth, calibrator: Calibrator, seed: int, number: int, width: int) -> dict[str, Floats]:
    """A batch, judged at home and held out."""
    block = truth.draw(seed, number, width)
    found, columns = calibrated(truth, calibrator, block)
    columns |= held_out(room, block.values, seed + 1, number, found, calibrator.construction)
    both, fitted = truth.construction.index("range-scale"), calibrator.construction.index("range-scale")
    columns["range_scale_miss_ppm"] = 1e6 * (found.values[0, fitted] - block.values[0, both])
    return columns


def gauge_batch(campaign: Campaign, scenario: Scenario, method: Method, number: int, width: int) -> dict[str, Floats]:
    """A batch with one gauge."""
    truth = truth_of(scenario, campaign.seed, "campaign")
    room = load_scenario(HELD_OUT).model_copy(update={"instrument": scenario.instrument})
    elsewhere = truth_of(room, campaign.seed, "held out")
    return judged(truth, elsewhere, calibrator_of(method, truth), campaign.seed, number, width)


def of_order(order: int) -> Construction:
    """The misalignment construction with harmonics of both circles up to an order."""
    effects: list[SlotEffect] = [
        e for e in BASELINE if order >= 2 or not isinstance(e, AzimuthSecondOrder | ElevationSecondOrder)
    ]
    for m in range(3, order + 1):
        effects += [AzimuthHarmonic(order=m), ElevationHarmonic(order=m)]
    return misalignment(effects)


def with_harmonics(truth: Truth, scenario: Scenario, beyond: float) -> Truth:
    """The truth with harmonics of order 3 and 4, each coefficient N(0, beyond^2) [rad]; 0: order 2."""
    built = of_order(4)
    sigma = [p.sigma_from(scenario.instrument.prior) for p in built.parameters]
    sigma = [beyond if "-harmonic-" in p.name else s for p, s in zip(built.parameters, sigma, strict=True)]
    none = np.zeros((1, built.size))
    state = replace(truth.state, instrument=none)
    population = replace(truth.population, construction=built, mean=none, sigma=np.array([sigma]))
    return replace(truth, population=population, state=state)


def harmonic_batch(
    campaign: Campaign, scenario: Scenario, method: Method, order: int, beyond: float, number: int, width: int
) -> dict[str, Floats]:
    """A batch with one order fitted to one truth."""
    truth = with_harmonics(truth_of(scenario, campaign.seed, "campaign"), scenario, beyond)
    room = load_scenario(HELD_OUT).model_copy(update={"instrument": scenario.instrument})
    elsewhere = with_harmonics(truth_of(room, campaign.seed, "held out"), scenario, beyond)
    built = of_order(order)
    calibrator = BatchDistance(truth, built) if method.method == "distance" else Engine(truth, built)
    return judged(truth, elsewhere, calibrator, campaign.seed, number, width)


def row_of(columns: dict[str, Floats]) -> Row:
    """What is told of a cell."""
    out = summary(columns["held_out_error_calibrated_um"])
    return {
        "held_out_error_um": out["mean"],
        "held_out_low_um": out["low"],
        "held_out_high_um": out["high"],
        "held_out_p5_um": out["p5"],
        "held_out_p95_um": out["p95"],
        "held_out_raw_um": summary(columns["held_out_error_raw_um"])["mean"],
        **beside_floor(columns),
        "held_out_share": round(share(columns, "held_out_"), 4),
        "in_sample_distance_um": summary(columns["distance_after_mean_um"])["mean"],
        "in_sample_coordinate_um": summary(columns["coordinate_after_mean_um"])["mean"],
        "range_scale_rms_ppm": round(float(np.sqrt(np.mean(columns["range_scale_miss_ppm"] ** 2))), 3),
        "trials": out["trials"],
    }


def mean_of(setting: str, method: str, row: Row) -> Mean:
    """A row as a dot of the figure."""
    keys = ("held_out_error_um", "held_out_low_um", "held_out_high_um", "held_out_p5_um", "held_out_p95_um")
    return Mean(setting, method, *(row[k] for k in keys))


def run(given: Options) -> Made:
    campaign, cells = cells_of(HERE / "config.toml", given.trials)
    sweep = tomllib.loads((HERE / "sweep.toml").read_text(encoding="utf-8"))
    blocks = list(batches(campaign.trials))
    gauges: list[Row] = []
    orders: list[Row] = []
    gauge_dots: list[Mean] = []
    order_dots: list[Mean] = []
    for method in campaign.methods:
        for cell in cells:
            for size in sweep["gauge"]["size"]:
                for count in sweep["gauge"]["reflectors"]:
                    scenario = with_gauge(cell.scenario, count, size, sweep["gauge"]["extra_mm"])
                    tasks = [(campaign, scenario, method, *block) for block in blocks]
                    row = row_of(stacked(spread_out(gauge_batch, tasks, given.jobs)))
                    here = {"cell": cell.title, "method": method.title, "size": size, "reflectors": count}
                    gauges.append(here | row)
                    if size == 1.0:
                        gauge_dots.append(mean_of(f"{count} reflectors, prior {cell.title[21:]}", method.title, row))
        for beyond in sweep["harmonics"]["truth_beyond_second_urad"]:
            for order in sweep["harmonics"]["fitted"]:
                tasks = [(campaign, cells[0].scenario, method, order, beyond * MICRORADIAN, *block) for block in blocks]
                row = row_of(stacked(spread_out(harmonic_batch, tasks, given.jobs)))
                orders.append({"truth_beyond_second_urad": beyond, "fitted_order": order, "method": method.title} | row)
                order_dots.append(mean_of(f"truth {beyond:g} µrad, fitted order {order}", method.title, row))
        tell(f"{method.title}: done")
    write_table(given.out / "gauge.csv", gauges)
    write_table(given.out / "harmonics.csv", orders)
    label = "rms error on held-out points [µm]"
    write_figure(given.out / "gauge.svg", by_setting(gauge_dots, label=label))
    write_figure(given.out / "harmonics.svg", by_setting(order_dots, label=label))
    return Made(campaign.seed, campaign.trials)
