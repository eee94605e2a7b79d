"""Least squares and least absolute deviations of the paper's objective, with and without outliers."""

from dataclasses import replace

import numpy as np
import pandas as pd

from experiments.common import ERROR, NEW_POINTS, Options, RunRecord, cells_of, summary, write_figure, write_table
from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.evaluation.clouds import align_to_points
from ltsim.campaigns.shard_rows import CellContext, TrialBatchRowBuilder
from ltsim.campaigns.spec import CampaignCell, CampaignFile
from ltsim.campaigns.trial_calibrators import CalibratedBatch, recording_of_trial
from ltsim.campaigns.true_network import TrialBatch, TrueNetwork
from ltsim.core.arrays import Ints
from ltsim.core.parallel import run_parallel
from ltsim.core.randomness import random_stream
from ltsim.core.units import MICROMETRE
from ltsim.physics.effects.effect import Effect
from ltsim.physics.model.construction import GeometricErrorModel, misalignment_construction
from ltsim.recordings.recording import Recording
from ltsim.reports.figures.campaign import SweepPoint, sweep_panels_figure

PERCENT = (0.0, 1.0, 2.0)
SIZE = (100 * MICROMETRE, 500 * MICROMETRE)
"""Smallest and largest outlier [m], as a displacement of the reflector; ltsim rejects larger ones before calibration.
"""
MAX_REMOVED_READINGS = 60


class WithoutOutliers:
    """Network adjustment with iterative data snooping.

    The reading with the largest w-test is rejected until none is too large.
    """

    def __init__(self, truth: TrueNetwork) -> None:
        self.truth = truth
        self.construction: GeometricErrorModel = misalignment_construction()
        self.effects: tuple[Effect, ...] = ()

    def calibrate(self, block: TrialBatch, trial_indices: Ints) -> CalibratedBatch:
        """Calibration of each trial of a batch, one after the other."""
        count, true = block.reading_deviations.shape[2], self.truth.state.target_points
        values, points = np.zeros((1, self.construction.n_parameters, count)), np.zeros((*true.shape, count))
        chi2 = np.zeros(count)
        for i in trial_indices:
            adjustment = self.adjust_without_outliers(recording_of_trial(self.truth, block, int(i)))
            values[0, :, i] = adjustment.state.instrument_parameters[0]
            points[:, :, i] = align_to_points(adjustment.state.target_points, true) - true
            chi2[i] = adjustment.chi2
        return CalibratedBatch(values, np.full(values.shape[:2], np.nan), points, chi2, np.zeros(count, dtype=np.int64))

    def adjust_without_outliers(self, recording: Recording) -> Adjustment:
        """Adjustment of a recording after the rejection of all flagged readings."""
        use = np.ones(recording.readings.shape, dtype=bool)
        adjustment = adjust(recording, self.construction, reading_mask=use)
        for _ in range(MAX_REMOVED_READINGS):
            flagged = adjustment.flagged_readings()
            if not flagged:
                break
            use[flagged[0].pointing_index, flagged[0].observable_column] = False
            adjustment = adjust(recording, self.construction, reading_mask=use, start_state=adjustment.state)
        return adjustment

    def difference(self, block: TrialBatch, trial: int, calibrated: CalibratedBatch) -> float:
        """Difference from the single-trial solver; NaN, because this method is the single-trial solver."""
        return float("nan")


def with_outliers(truth: TrueNetwork, block: TrialBatch, percent: float, seed: int) -> TrialBatch:
    """Batch in which a percentage of the readings is shifted.

    A larger percentage shifts the same readings and further ones.
    """
    draw = random_stream(seed, "outliers", int(block.trial_numbers[0]))
    shape = block.reading_deviations.shape
    chance, sign = draw.random(shape), draw.choice([-1.0, 1.0], shape)
    size = draw.uniform(*SIZE, shape)
    sightings = truth.sightings
    across = sightings.range_ * np.cos(sightings.elevation)
    reach = np.stack([np.ones_like(across), across, sightings.range_], axis=1)
    shift = np.where(chance < percent / 100.0, sign * size / reach[:, :, None], 0.0)
    return replace(block, reading_deviations=block.reading_deviations + shift)


def errors_of(campaign: CampaignFile, cell: CampaignCell, percent: float) -> dict[str, pd.DataFrame]:
    """Errors of each trial by method, with a percentage of outliers."""
    context = CellContext(campaign, cell.scenario, cell.validation_scenario)
    parts: dict[str, list[pd.DataFrame]] = {}
    for evaluator, calibrators, clean in context.trial_batches(0, campaign.trials):
        truth = evaluator.true_network
        block = with_outliers(truth, clean, percent, campaign.seed)
        chosen = np.flatnonzero(block.trial_numbers < campaign.trials)
        work = TrialBatchRowBuilder(campaign, evaluator, block, context.validation_evaluator, chosen, chosen[:0])
        by_title = {method.title: calibrator for method, calibrator in zip(campaign.methods, calibrators, strict=True)}
        for title, calibrator in (by_title | {"network, outliers removed": WithoutOutliers(truth)}).items():
            columns = {name: values[chosen] for name, values in work.method_columns(calibrator).items()}
            parts.setdefault(title, []).append(pd.DataFrame(columns))
    return {title: pd.concat(tables) for title, tables in parts.items()}


def run(options: Options) -> RunRecord:
    campaign, (cell,) = cells_of(options)
    columns_by_percent = list(run_parallel(errors_of, [(campaign, cell, percent) for percent in PERCENT], options.jobs))
    table, rows = [], []
    for percent, methods in zip(PERCENT, columns_by_percent, strict=True):
        for title, columns in methods.items():
            new, floor = summary(columns[ERROR]), summary(columns["new_point_error_true_parameters_um"])
            about = {"outliers_percent": percent, "method": title, "noise_floor_um": floor["mean"]}
            targets = {"target_error_um": summary(columns["target_error_um"])["mean"]}
            table.append(about | {f"new_point_{name}": value for name, value in new.items()} | targets)
            rows.append(SweepPoint(percent, title, "", *(new[k] for k in ("mean", "low", "high", "p5", "p95"))))
    write_table(options.out / "methods.csv", table)
    write_figure(
        options.out / "new_points.svg",
        sweep_panels_figure(rows, statistic_title=NEW_POINTS, x_title="outliers [% of the readings]"),
    )
    return RunRecord(campaign.seed, campaign.trials)
