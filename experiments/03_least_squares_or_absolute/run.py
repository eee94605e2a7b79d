"""Least squares and least absolute deviations of the paper's objective, clean and with outliers."""

from __future__ import annotations

import tomllib
from dataclasses import replace
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
    calibrator_for,
    cells_of,
    held_out,
    share_interval,
    spread_out,
    stacked,
    summary,
    tell,
    write_figure,
    write_table,
)
from ltsim.adjustment import Adjustment, adjust
from ltsim.arrays import Floats, Ints
from ltsim.campaigns.cell import truth_of
from ltsim.campaigns.engine import Calibrated, recording_of
from ltsim.campaigns.spec import Campaign, Method
from ltsim.campaigns.truth import Block, Truth
from ltsim.evaluation.clouds import on_points
from ltsim.model.construction import Construction, misalignment
from ltsim.pages.figures import Mean, by_setting
from ltsim.randomness import stream
from ltsim.recording.recording import Recording
from ltsim.simulation.scenario import load_scenario
from ltsim.units import MICROMETRE

HERE = Path(__file__).resolve().parent

MOST_REMOVED = 60


class WithoutOutliers:
    """The network adjustment; the reading with the largest w-test goes, one after the other, while any is too large."""

    def __init__(self, truth: Truth) -> None:
        self.truth = truth
        self.construction: Construction = misalignment()

    def calibrate(self, block: Block, wanted: Ints) -> Calibrated:
        """Calibrate a block trial by trial."""
        count, true = block.deviation.shape[2], self.truth.state.points
        values, points = np.zeros((1, self.construction.size, count)), np.zeros((*true.shape, count))
        chi2 = np.zeros(count)
        for i in wanted:
            adjustment = self.cleaned(recording_of(self.truth, block, int(i)))
            values[0, :, i] = adjustment.state.instrument[0]
            points[:, :, i] = on_points(adjustment.state.points, true) - true
            chi2[i] = adjustment.chi2
        return Calibrated(values, np.full(values.shape[:2], np.nan), points, chi2, np.zeros(count, dtype=np.int64))

    def cleaned(self, recording: Recording) -> Adjustment:
        """The adjustment that no reading contradicts any more."""
        use = np.ones(recording.readings.shape, dtype=bool)
        adjustment = adjust(recording, self.construction, use=use)
        for _ in range(MOST_REMOVED):
            found = adjustment.outliers()
            if not found:
                break
            use[found[0].row, found[0].observable] = False
            adjustment = adjust(recording, self.construction, use=use, start=adjustment.state)
        return adjustment

    def difference(self, block: Block, trial: int, found: Calibrated) -> float:
        """It is the full solver."""
        return float("nan")


def with_outliers(truth: Truth, block: Block, law: dict[str, Any], percent: float, seed: int) -> Block:
    """The block with some readings shifted; the same readings are hit first whatever the share."""
    draw = stream(seed, "outliers", block.number)
    shape = block.deviation.shape
    chance, sign = draw.random(shape), draw.choice([-1.0, 1.0], shape)
    size = draw.uniform(law["least_um"], law["largest_um"], shape) * MICROMETRE
    sightings = truth.sightings
    across = sightings.range_ * np.cos(sightings.elevation)
    reach = np.stack([np.ones_like(across), across, sightings.range_], axis=1)
    shift = np.where(chance < percent / 100.0, sign * size / reach[:, :, None], 0.0)
    return replace(block, deviation=block.deviation + shift)


def one_batch(
    campaign: Campaign, method: Method | None, law: dict[str, Any], percent: float, number: int, width: int
) -> dict[str, Floats]:
    """A batch of trials by one method."""
    truth = truth_of(cells_of(HERE / "config.toml")[1][0].scenario, campaign.seed, "campaign")
    block = with_outliers(truth, truth.draw(campaign.seed, number, width), law, percent, campaign.seed)
    calibrator = WithoutOutliers(truth) if method is None else calibrator_for(method, truth)
    found, columns = calibrated(truth, calibrator, block)
    room = truth_of(load_scenario(HELD_OUT), campaign.seed, "held out")
    return columns | held_out(room, block.values, campaign.seed + 1, number, found, calibrator.construction)


def run(given: Options) -> Made:
    campaign, _ = cells_of(HERE / "config.toml", given.trials)
    law = tomllib.loads((HERE / "outliers.toml").read_text(encoding="utf-8"))
    table, means = [], []
    methods: list[Method | None] = [*campaign.methods, None]
    for percent in law["share_percent"]:
        for method in methods:
            title = "network, outliers removed" if method is None else method.title
            tasks = [(campaign, method, law, percent, number, width) for number, width in batches(campaign.trials)]
            columns = stacked(spread_out(one_batch, tasks, given.jobs))
            spread = summary(columns["held_out_error_calibrated_um"])
            setting = f"{percent:g} % outliers"
            row: dict[str, Any] = {"outliers_percent": percent, "method": title}
            row |= {f"held_out_error_{name}_um": value for name, value in spread.items() if name != "trials"}
            row |= beside_floor(columns)
            kept = share_interval(columns, "held_out_")
            row |= dict(zip(("held_out_share", "share_low", "share_high"), kept, strict=True))
            targets = summary(columns["target_error_um"])
            row |= {f"target_error_{name}_um": targets[name] for name in ("mean", "low", "high")}
            table.append(row | {"trials": spread["trials"]})
            means.append(Mean(setting, title, *(spread[k] for k in ("mean", "low", "high", "p5", "p95"))))
            tell(f"{setting}, {title}: done")
    write_table(given.out / "methods.csv", table)
    write_figure(given.out / "held_out.svg", by_setting(means, label="rms error on held-out points [µm]"))
    return Made(campaign.seed, campaign.trials)
