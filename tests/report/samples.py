"""Data for the report's tests: an adjusted network, and folders as the commands write them."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.adjust.adjustment import Adjustment, adjust
from ltsim.calibrate import calibrate_network, write_calibration
from ltsim.calibrate.files import residuals_csv
from ltsim.model.construction import misalignment
from ltsim.recording import write
from ltsim.recording.recording import Recording
from ltsim.recording.setup import Station
from tests.networks import STATIONS, YAWS, drawn, network


@cache
def recording() -> Recording:
    """The test network in two faces with noise, instrument errors and a floor plan."""
    made, _ = network(faces=2, seed=4, values=drawn(misalignment(), 7))
    plan = {
        name: Station(position_mm=place, yaw_deg=float(np.degrees(yaw)))
        for name, place, yaw in zip(made.stations, (1e3 * STATIONS).tolist(), YAWS, strict=True)
    }
    return made.replace(setup=made.setup.model_copy(update={"stations": plan}))


@cache
def before() -> Adjustment:
    """The network adjusted without instrument parameters."""
    return adjust(recording())


@cache
def after() -> Adjustment:
    """The network adjusted with them."""
    return adjust(recording(), misalignment())


def calibration_folder(folder: Path) -> Path:
    """A folder as `ltsim calibrate` leaves it, the recording in `recording/` beside it."""
    write_calibration(calibrate_network(recording()), folder / "calibration")
    write(recording(), folder / "recording")
    return folder / "calibration"


def diagnosis_folder(folder: Path) -> Path:
    """A folder with a diagnosis of the form of the interface, own-made, its residuals and the recording beside it."""
    target = folder / "diagnosis"
    target.mkdir(parents=True)
    (target / "diagnosis.json").write_text(json.dumps(DIAGNOSIS))
    (target / "residuals.csv").write_text(residuals_csv(after()))
    (target / "residuals_before.csv").write_text(residuals_csv(before()))
    write(recording(), folder / "recording")
    return target


DIAGNOSIS: dict[str, Any] = {
    "format": "ltsim-diagnosis/1",
    "verdict": "mismatch",
    "summary": "Station S3 leans by 12 +- 2 urad with a time constant of 9 +- 2 min after set-up.",
    "global_test": {"statistic": 1391.0, "dof": 1136, "p_value": 2.1e-7},
    "findings": [
        {
            "effect": "station-settling",
            "known": True,
            "where": {
                "observables": ["azimuth", "elevation"], "stations": ["S3"], "targets": [], "covariates": ["time"],
            },
            "parameters": [{"name": "tilt-x", "value": 12.1, "sigma": 1.8, "unit": "urad"}],
            "evidence": {"chi2_drop": 251.0, "parameters": 3, "p_value": 1e-9, "probability": 0.97},
            "equivalents": [{"effect": "index-drift", "probability": 0.02}],
            "separate_by": "measure the first three targets again before leaving the station",
        }
    ],
    "fit": {
        "before": {"chi2": 1391.0, "dof": 1136, "held_out_rms": 1.11},
        "after": {"chi2": 1130.0, "dof": 1133, "held_out_rms": 1.00},
    },
    "undetectable": [{"effect": "air-gradient", "reason": "absorbed by poses and targets", "cure": "other heights"}],
}  # fmt: skip
