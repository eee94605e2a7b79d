"""Data for the report's tests: an adjusted network, and folders as the commands write them."""

from __future__ import annotations

import json
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet as pq

from ltsim.adjustment import Adjustment, adjust
from ltsim.calibration.arrays import residuals_table
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.calibration_series import CalibrationSeries
from ltsim.calibration.files import write_calibration
from ltsim.calibration.history import History
from ltsim.calibration.network import calibrate_network
from ltsim.core.randomness import random_stream
from ltsim.physics.model.construction import misalignment_construction
from ltsim.planning.proposals import NextMeasurement
from ltsim.recordings import write
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Station
from ltsim.simulation.builtin import builtin_text
from ltsim.simulation.scenario import load_scenario
from ltsim.simulation.verbs import scenario
from tests.networks import STATIONS, YAWS, drawn, network, ranked_measurements


@cache
def recording() -> Recording:
    """The test network in two faces with noise, instrument errors and a floor plan."""
    made, _ = network(faces=2, seed=4, values=drawn(misalignment_construction(), 7))
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
    return adjust(recording(), misalignment_construction())


@cache
def _calibrated() -> Calibration:
    return calibrate_network(recording())


def calibration_folder(folder: Path) -> Path:
    """A folder as `ltsim calibrate` leaves it, the recording in `recording/` beside it."""
    write_calibration(_calibrated(), folder / "calibration")
    write(recording(), folder / "recording")
    return folder / "calibration"


def diagnosis_folder(folder: Path) -> Path:
    """A folder with a diagnosis of the form of the interface, own-made, its residuals and the recording beside it."""
    target = folder / "diagnosis"
    target.mkdir(parents=True)
    (target / "diagnosis.json").write_text(json.dumps(DIAGNOSIS))
    (target / "residuals.csv").write_text(residuals_table(after()).csv_text())
    (target / "residuals_before.csv").write_text(residuals_table(before()).csv_text())
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


def campaign_folder(folder: Path, trials: int = 60) -> Path:
    """A campaign of two settings and two methods, own-made rows in the form of the campaign's files."""
    manifest = {
        "format": "ltsim-campaign-rows/1", "title": "Own-made", "seed": 11, "trials": trials,
        "methods": ["network", "distance"],
        "factors": [{"name": "noise_factor", "keys": ["instrument.noise_factor"], "unit": "", "kind": "integer"}],
        "cells": [{"cell": c, "label": "", "levels": {"noise_factor": c + 1}} for c in range(2)],
        "versions": {"numpy": "2.0"}, "commit": None, "settings": {"scenario": "paper-workshop"},
        "scenarios": [
            scenario("paper-workshop", {"instrument.noise_factor": c + 1}).model_dump(mode="json") for c in range(2)
        ],
    }  # fmt: skip
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    for cell in range(2):
        parts = [
            _rows(cell, method, trials).append_column("noise_factor", pa.array([cell + 1] * trials))
            for method in ("network", "distance")
        ]
        place = folder / "rows" / f"cell-{cell:04d}"
        place.mkdir(parents=True)
        pq.write_table(pa.concat_tables(parts), place / "shard-000000.parquet")
    return folder


def sweep_folder(folder: Path, trials: int = 20) -> Path:
    """A campaign of three by three by three settings, own-made rows in the form of the campaign's files."""
    noise = "instrument.noise.azimuth_arcsec"
    factors = [
        {"name": "targets", "keys": ["work.targets"], "unit": "", "kind": "integer"},
        {"name": "angle_noise_arcsec", "keys": [noise], "unit": "arcsec", "kind": "number"},
        {"name": "repeats", "keys": ["work.repeats"], "unit": "", "kind": "integer"},
    ]
    names = [factor["name"] for factor in factors]
    levels = [
        dict(zip(names, levels_of_cell, strict=True))
        for levels_of_cell in product((8, 14, 24), (0.2, 0.4, 0.8), (1, 2, 4))
    ]
    manifest = {
        "format": "ltsim-campaign-rows/1", "title": "Swept", "seed": 11, "trials": trials, "methods": ["network"],
        "factors": factors,
        "cells": [{"cell": c, "label": "", "levels": of_cell} for c, of_cell in enumerate(levels)],
        "settings": {"scenario": "paper-workshop"},
    }  # fmt: skip
    for cell, levels_of_cell in enumerate(levels):
        rows = _rows(cell, "network", trials)
        size = (
            levels_of_cell["angle_noise_arcsec"] * 100 / np.sqrt(levels_of_cell["targets"] * levels_of_cell["repeats"])
        )
        error = size * (1 + 0.1 * random_stream(3, "sweep", cell).standard_normal(trials))
        rows = rows.append_column("target_error_um", pa.array(error, pa.float32()))
        for name, value in levels_of_cell.items():
            rows = rows.append_column(name, pa.array([value] * trials))
        place = folder / "rows" / f"cell-{cell:04d}"
        place.mkdir(parents=True)
        pq.write_table(rows, place / "shard-000000.parquet")
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


def _rows(cell: int, method: str, trials: int) -> pa.Table:
    """Rows of one cell and method."""
    draw = random_stream(3, "rows", cell, method)
    columns: dict[str, Any] = {
        "cell": pa.array([cell] * trials, pa.int32()), "method": pa.array([method] * trials),
        "trial": pa.array(range(trials), pa.int64()), "status": pa.array(["converged"] * trials),
    }  # fmt: skip
    after = {"network": 14.5, "distance": 17.0}[method]
    for name, mean in (("before_mean", 29.0), ("before_max", 60.0), ("after_mean", after), ("after_max", 39.0)):
        columns[f"distance_{name}_um"] = pa.array(mean * (1 + 0.1 * draw.standard_normal(trials)), pa.float32())
    for name in ("beam-tilt", "range-offset"):
        columns[f"z:{name}"] = pa.array(draw.standard_normal(trials), pa.float32())
    columns["full_difference_sigma"] = pa.array([1e-5] + [None] * (trials - 1), pa.float32())
    return pa.table(columns)


REFLECTOR_CHANGES = [
    {"kind": "move", "reflector": "T01", "new_place": "walls-17", "position_mm": [40, 3100, 2600],
     "target_rms_decrease_um": 0.412, "objective_ratio": 0.953,
     "most_affected_parameter": "elevation-eccentricity-cos", "most_affected_ratio": 0.81},
    {"kind": "add", "new_place": "milling machine-8", "position_mm": [2800, 900, 1100],
     "target_rms_decrease_um": 0.31, "objective_ratio": 0.97,
     "most_affected_parameter": "T09", "most_affected_ratio": 0.9},
    {"kind": "remove", "reflector": "T05", "target_rms_decrease_um": -0.004, "objective_ratio": 1.001,
     "most_affected_parameter": "beam-tilt", "most_affected_ratio": 1.02},
]  # fmt: skip


def plan_folder(folder: Path) -> Path:
    """A plan in the form of the planner's files, own-made, with the paper's workshop as its scenario."""
    scenario = load_scenario("paper-workshop")
    broken = {
        "broken_rules": [], "hours": 2.25, "pointings": 140, "qualities": {"instrument": 0.2},
        "stations": [
            {"name": name, "position_mm": s.position_mm, "yaw_deg": s.yaw_deg, "sigma_position_um": [1, 2, 3]}
            for name, s in scenario.stations.items()
        ],
        "parameters": [{"name": "beam-tilt", "unit": "urad", "sigma": 3.2, "prior_sigma": 9.7}],
    }  # fmt: skip
    ways = [(3, 1, 1.35, 0.14, True), (4, 1, 1.8, 0.12, True), (5, 1, 2.25, 0.1, True), (3, 2, 2.0, 0.13, False)]
    content = broken | {
        "format": "ltsim-plan-result/1", "title": "Own-made plan",
        "summary": "5 stations determine the instrument twice as well as the scenario's own.",
        "reasons": ["S1 at (1.78, 1.02) m: without it the quality is 14 % worse."], "qualities": {"instrument": 0.1},
        "parameters": [{"name": "beam-tilt", "unit": "urad", "sigma": 1.1, "prior_sigma": 9.7}],
        "reference_layout": broken,
        "tradeoff_points": [
            {"station_count": n, "faces": f, "repeats": 1, "pointings": 28 * n * f, "hours": h, "objective_value": q,
             "qualities": {"instrument": q}, "is_efficient": best}
            for n, f, h, q, best in ways
        ],
        "undetectable_effects": ["dead-path"], "settings": {}, "seed": 5, "reflector_changes": REFLECTOR_CHANGES,
    }  # fmt: skip
    folder.mkdir(parents=True)
    (folder / "plan.json").write_text(json.dumps(content))
    (folder / "scenario.toml").write_text(builtin_text("paper-workshop"))
    return folder


@cache
def _history() -> CalibrationSeries:
    named = []
    for number, label in enumerate(("tracker_jan", "tracker_may", "tracker_sep")):
        values = drawn(misalignment_construction(), 7 if number < 2 else 8)
        made, _ = network(faces=2, seed=1 + number, values=values)
        named.append((label, calibrate_network(made, recommend_measurements=False)))
    return CalibrationSeries.from_labelled(named)


def history_folder(folder: Path) -> Path:
    """A folder as `ltsim history` leaves it: three calibrations, the instrument changed before the last."""
    folder.mkdir(parents=True)
    (folder / "history.json").write_text(History.from_series(_history()).text())
    return folder


def next_folder(folder: Path, *, between: tuple[str, ...] = ()) -> Path:
    """A folder as `ltsim plan --after` leaves it."""
    made = ranked_measurements(recording(), explanations=between)
    folder.mkdir(parents=True)
    content = NextMeasurement.from_ranking(made).model_copy(
        update={"diagnosis": "The recording agrees with the model."}
    )
    (folder / "next.json").write_text(content.text())
    return folder
