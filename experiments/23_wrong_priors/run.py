"""What calibration makes of new points when the stated prior is wrong by 0.1 to 1000, or when there is none."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.common import (
    HELD_OUT,
    Cell,
    Made,
    Options,
    Row,
    batches,
    cells_of,
    held_out,
    spread_out,
    stacked,
    tell,
    write_figure,
    write_table,
)
from ltsim.arrays import Floats
from ltsim.calibration import calibrate_network
from ltsim.calibration.choice import Choice
from ltsim.campaigns.cell import truth_of
from ltsim.campaigns.engine import Calibrated, recording_of
from ltsim.pages.figures import Mean, by_setting
from ltsim.recording import Recording
from ltsim.simulation.scenario import load_scenario

HERE = Path(__file__).resolve().parent
FACTORS = (0.1, 0.3, 1.0, 3.0, 10.0, 100.0, 1000.0)
NONE = 0.0
"""Stands for no prior at all."""


def with_prior(recording: Recording, factor: float) -> Recording:
    """The recording with every prior stated so many times as wide."""
    own = recording.setup.instrument
    wider = {name: factor * value for name, value in own.prior.model_dump(exclude={"parameters"}).items()}
    prior = own.prior.model_copy(update=wider)
    return recording.replace(
        setup=recording.setup.model_copy(update={"instrument": own.model_copy(update={"prior": prior})})
    )


def trials(cell: Cell, factor: float, seed: int, number: int, width: int) -> dict[str, Floats]:
    """Errors [um] on new points of a batch: as read, with what is applied, with the estimates; and what was said."""
    truth, room = truth_of(cell.scenario, seed, "priors"), load_scenario(HELD_OUT)
    room = room.model_copy(update={"instrument": cell.scenario.instrument})
    elsewhere, block = truth_of(room, seed, "held out"), truth.draw(seed, number, width)
    applied, estimated = np.empty_like(block.values), np.empty_like(block.values)
    said = {"contradicts": np.zeros(width), "less": np.zeros(width), "expected": np.zeros(width)}
    for trial in range(width):
        recording = recording_of(truth, block, trial)
        stated = recording if factor == NONE else with_prior(recording, factor)
        found = calibrate_network(stated, advise=False, choice=Choice(free=factor == NONE))
        correction = found.correction
        assert correction is not None
        applied[:, :, trial], estimated[:, :, trial] = found.applied, found.values
        sentences = " ".join(correction.sentences)
        said["contradicts"][trial] = "contradict the stated priors" in sentences
        said["less"][trial] = any(word in sentences for word in ("not applied", "correction is applied", "too little"))
        said["expected"][trial] = correction.corrected_um < correction.uncorrected_um
    empty = Calibrated(applied, np.zeros(applied.shape[:2]), np.zeros(0), np.zeros(width), np.zeros(width, dtype=int))
    columns = held_out(elsewhere, block.values, seed + 1, number, empty, truth.construction)
    whole = Calibrated(estimated, empty.sigma, empty.points, empty.chi2, empty.status)
    plain = held_out(elsewhere, block.values, seed + 1, number, whole, truth.construction)
    return {
        "raw": columns["held_out_error_raw_um"],
        "applied": columns["held_out_error_calibrated_um"],
        "estimated": plain["held_out_error_calibrated_um"],
    } | said


def row_of(found: dict[str, Floats]) -> Row:
    """Means over the trials, and the mean ratio of the errors on new points with its 95 % interval."""
    ratio = found["applied"] / found["raw"]
    half = 1.96 * ratio.std(ddof=1) / np.sqrt(len(ratio))
    return {
        "trials": len(ratio),
        "as_read_um": round(float(found["raw"].mean()), 2),
        "applied_um": round(float(found["applied"].mean()), 2),
        "estimates_um": round(float(found["estimated"].mean()), 2),
        "ratio": round(float(ratio.mean()), 4),
        "low": round(float(ratio.mean() - half), 4),
        "high": round(float(ratio.mean() + half), 4),
        "p5": round(float(np.percentile(ratio, 5)), 4),
        "p95": round(float(np.percentile(ratio, 95)), 4),
        "says_prior_contradicted_percent": round(100 * float(found["contradicts"].mean())),
        "says_less_is_applied_percent": round(100 * float(found["less"].mean())),
        "expects_a_gain_percent": round(100 * float(found["expected"].mean())),
    }


def run(given: Options) -> Made:
    campaign, cells = cells_of(HERE / "config.toml", given.trials)
    rows: list[Row] = []
    means: list[Mean] = []
    for cell in cells:
        for factor in (*FACTORS, NONE):
            tasks = [(cell, factor, campaign.seed, *block) for block in batches(campaign.trials, 50)]
            title = "none" if factor == NONE else f"{factor:g} x"
            rows.append({"cell": cell.title, "prior": title} | row_of(stacked(spread_out(trials, tasks, given.jobs))))
            means.append(Mean(title, cell.title, *(rows[-1][k] for k in ("ratio", "low", "high", "p5", "p95"))))
            write_table(given.out / "priors.csv", rows)
            tell(str(rows[-1]))
    write_figure(given.out / "priors.svg", by_setting(means, label="error of new points over that as read"))
    return Made(campaign.seed, campaign.trials)
