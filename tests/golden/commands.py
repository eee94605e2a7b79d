"""Thirty commands of all verbs on small inputs, and the numbers in what they write and print.

``python -m tests.golden.commands`` writes the numbers to `NUMBERS` anew. Of each key of a JSON file, and of each column
of a table, three numbers are compared: how many there are, their root mean square, and their sum with weights, which
changes where two of them are exchanged.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import os
import shlex
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.cli.main import run

NO_LENGTH_UM = 1e-8
"""Length [um] that is rounding of coordinates in metres."""
NUMBERS = Path(__file__).with_name("numbers.json")
"""The numbers of all commands."""
SCENARIO = (
    """format = "ltsim-scenario/1"
title = "A hall of three stations"

[workshop]
size_mm = [9000, 8000, 4000]

[instrument]
preset = "paper"

[instrument.errors]
draw = true

[work]
faces = 2

[stations]
A = { position_mm = [1200, 1500, 1650], yaw_deg = 40 }
B = { position_mm = [6900, 2300, 1500], yaw_deg = 155 }
C = { position_mm = [4200, 7300, 1400], yaw_deg = 318 }

[targets]
"""
    + "\n".join(
        f"P{i} = {{ position_mm = [{2500 + 500 * i}, {2500 + 700 * (i % 4)}, {500 + 300 * (i % 5)}] }}"
        for i in range(10)
    )
    + """

[[effects]]
name = "index-drift"
stations = ["B"]
"""
)
CAMPAIGN = """format = "ltsim-campaign/1"
title = "Two cells"
scenario = "paper-workshop"
seed = 5
trials = 24
trials_per_shard = 12
verified_trials_per_shard = 1
statistics = ["criteria", "errors", "z-scores"]

[grid]
"instrument.noise_factor" = [1.0, 2.0]

[[methods]]
name = "network"
method = "network"

[[methods]]
name = "paper"
method = "distance"
"""
PLAN = """format = "ltsim-plan/1"
title = "A cell"

[workshop]
size_mm = [6000, 4000, 3000]

[[points]]
name = "P1"
x_mm = 1000
y_mm = 1000
z_mm = 800

[[points]]
name = "P2"
x_mm = 4000
y_mm = 1200
z_mm = 1500

[[points]]
name = "P3"
x_mm = 2200
y_mm = 3300
z_mm = 600

[floor]
margin_mm = 500

[stations]
count = 2
spacing_mm = 800
min_stations_per_target = 1

[reflectors]
candidate_bodies = ["walls"]
place_spacing_mm = 4000

[budget]
max_hours = 2
faces = [1]
repeats = [1]

[goal]
targets_weight = 1.0
instrument_weight = 0.5

[search]
starts = 1
grid_step_mm = 2500
yaw_count = 1
height_count = 1
"""
TASKS = """format = "ltsim-tasks/1"
title = "A length and a plane"
source = "faces"

[[task]]
name = "length"
kind = "distance"
targets = ["T01", "T24"]

[[task]]
name = "floor"
kind = "plane"
targets = ["T17", "T18", "T19", "T20", "T21"]

[monte_carlo]
max_trials = 20000
"""
ACCEPTANCE = """format = "ltsim-acceptance/1"
standard = "asme-b89.4.19-2006"
instrument = "leica-at500"
trials = 1000
"""
ANGLES = range(-180, 180, 15)
BENCH = "angle_deg,length_um,probe_um\n" + "\n".join(
    f"{a},{0.1 * a + 0.002 * a * a if abs(a) <= 30 else ''},{np.cos(np.radians(a)):.3f}" for a in ANGLES
)
INPUTS = {
    "hall.toml": SCENARIO, "cells.toml": CAMPAIGN, "cell.toml": PLAN, "tasks.toml": TASKS, "asme.toml": ACCEPTANCE,
    "reflector.csv": BENCH,
}  # fmt: skip
"""Files that the commands read."""
COMMANDS = {
    "simulate": "simulate paper-workshop --seed 7 --out one --truth one-truth.json",
    "simulate-faces": "simulate paper-workshop-two-face --seed 3 --out faces --truth faces-truth.json",
    "simulate-laboratory": "simulate paper-laboratory --seed 7 --out laboratory --truth lab.json --nominal cmm.csv",
    "simulate-file": "simulate hall.toml --seed 2 --trial 4 --out hall --truth hall.json",
    "inject": "inject faces range-step:S3 --noncentrality 400 --seed 1 --out fault --truth fault.json",
    "inject-outlier": "inject faces outlier:S2 --noncentrality 900 --seed 5 --out gross --truth gross.json",
    "check": "check faces --out check-faces",
    "check-fault": "check gross --mpe 20,6 --out check-gross",
    "adjust": "adjust hall --out adjusted",
    "adjust-robust": "adjust gross --robust --noise-from-data --out adjusted-robust",
    "calibrate": "calibrate one --out calibration",
    "calibrate-faces": "calibrate faces --with smr-centring --out calibration-faces",
    "calibrate-dh": "calibrate faces --construction dh --out calibration-dh",
    "calibrate-distance": "calibrate one --method distance --out calibration-distance",
    "correct": "correct one --calibration calibration --out corrected",
    "evaluate": "evaluate one --out criteria",
    "evaluate-calibrated": "evaluate one --calibration calibration --out criteria-after",
    "verify": "verify laboratory --nominal cmm.csv --calibration calibration --out verified",
    "history": "history calibration calibration-faces faces --dates 2026-01-01,2026-02-01,2026-03-01 --out history",
    "history-set-ups": "history hall --each-set-up --out history-set-ups",
    "compare": "compare one faces --stable T01,T02,T03,T04 --out compared",
    "uncertainty": "uncertainty tasks.toml --out worth",
    "accept": "accept asme.toml --out acceptance",
    "bench": "bench reflector.csv --out reflector",
    "recover": "recover paper-workshop --trials 12 --jobs 1 --out recovered",
    "campaign": "campaign cells.toml --jobs 1 --out rows",
    "plan": "plan cell.toml --jobs 1 --out layout",
    "plan-after": "plan --after one --out next",
    "diagnose": "diagnose one --out diagnosis",
    "diagnose-fault": "diagnose fault --out diagnosis-fault",
}
"""Command lines in their order; later ones read what earlier ones wrote."""
STATUS = {"check-fault": 1, "compare": 1}
"""Exit status of commands that a check failed."""


def written() -> Iterator[tuple[str, dict[str, list[float]]]]:
    """Each command, run in the present folder, with its numbers by key."""
    for name, text in INPUTS.items():
        Path(name).write_text(text)
    for name, line in COMMANDS.items():
        before = {path: path.stat().st_mtime_ns for path in _files()}
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            status = run([*shlex.split(line), "--json"])
        if status != STATUS.get(name, 0):
            raise AssertionError(f"ltsim {line} has exit status {status}")
        files = [path for path in _files() if before.get(path) != path.stat().st_mtime_ns]
        yield name, _numbers(files, printed.getvalue())


def _files() -> list[Path]:
    return sorted(path for path in Path().rglob("*") if path.suffix in (".json", ".csv"))


def _numbers(files: list[Path], printed: str) -> dict[str, list[float]]:
    columns: dict[str, list[float]] = defaultdict(list)
    _collect(columns, "stdout", json.loads(printed))
    for path in files:
        if path.suffix == ".json":
            _collect(columns, path.as_posix(), json.loads(path.read_text("utf-8")))
        else:
            for row in csv.DictReader(path.read_text("utf-8").splitlines()):
                for head, cell in row.items():
                    with contextlib.suppress(TypeError, ValueError):
                        columns[f"{path.as_posix()}:{head}"].append(_comparable(head, float(cell)))
    return {key: _summary(np.array(values)) for key, values in columns.items()}


def _collect(columns: dict[str, list[float]], key: str, value: Any) -> None:
    if isinstance(value, dict):
        for name, part in value.items():
            _collect(columns, f"{key}.{name}", part)
    elif isinstance(value, list):
        for part in value:
            _collect(columns, f"{key}[]", part)
    elif isinstance(value, bool | int | float):
        columns[key].append(_comparable(key, float(value)))


def _comparable(key: str, value: float) -> float:
    """A number that depends on the rounding of a processor as little as the readings do.

    The logarithm of a p-value, whose relative error is half the error of chi-square; zero for less than `NO_LENGTH_UM`.
    """
    if key.endswith("p_value"):
        return math.log(value) if value > 0.0 else -math.inf
    return 0.0 if key.endswith("_um") and abs(value) < NO_LENGTH_UM else value


def _summary(values: np.ndarray) -> list[float]:
    finite = values[np.isfinite(values)]
    weights = np.cos(np.arange(len(finite)))
    rms = np.sqrt(np.mean(finite**2)) if len(finite) else 0.0
    return [float(f"{value:.12g}") for value in (len(finite), rms, weights @ finite)]


def main() -> None:
    """Write the numbers of all commands."""
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        content = dict(written())
        os.chdir(NUMBERS.parent)
    rows = {
        name: ",\n".join(f"  {json.dumps(key)}: {json.dumps(values)}" for key, values in columns.items())
        for name, columns in content.items()
    }
    lines = [f" {json.dumps(name)}: {{\n{text}\n }}" for name, text in rows.items()]
    NUMBERS.write_text("{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    main()
