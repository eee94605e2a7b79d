"""Cost and memory of a diagnosis as a function of the size of its recording.

    python -m benchmarks.diagnosis_size results/20_concealed_physics/size

The recordings are one station that measures 24 targets for hours, with six further columns and 1,000 to 20,000
pointings, and a ring of 210 set-ups. In both, the vertical index drifts, so that the diagnosis has a finding. Each
recording runs in a separate process, so that its peak of memory can be measured; times are processor times.
"""

from __future__ import annotations

import csv
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import ltsim as lt
from benchmarks.adjust_size import network
from ltsim.core.randomness import random_stream
from ltsim.core.units import MICRORADIAN
from ltsim.geometry.rigid import rotation_about_z
from ltsim.physics.model.construction import make_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Setup, Station

CASES: tuple[tuple[str, int], ...] = (*(("station", n) for n in (1_000, 3_000, 10_000, 20_000)), ("ring", 3_340))
TARGETS, COLUMNS = 24, 6
PACE = 5.0
"""[s] Time from one pointing to the next."""


def station_recording(pointings: int) -> Recording:
    """Recording of one station that measures its targets again and again, with columns of oscillating joint angles."""
    rng = random_stream(20, "watched", pointings)
    bearing, elevation, range_ = (
        rng.uniform(-3, 3, TARGETS),
        rng.uniform(-0.5, 0.8, TARGETS),
        rng.uniform(2, 15, TARGETS),
    )
    level = range_ * np.cos(elevation)
    points = np.stack([level * np.cos(bearing), level * np.sin(bearing), range_ * np.sin(elevation) + 1.6], axis=1)
    target = np.concatenate([rng.permutation(TARGETS) for _ in range(-(-pointings // TARGETS))])[:pointings]
    clock = PACE * np.arange(pointings)
    periods, phases = rng.uniform(200.0, 3000.0, COLUMNS), rng.uniform(0, 6, COLUMNS)
    sway = np.sin(2 * np.pi * clock[:, None] / periods + phases) + 0.1 * rng.standard_normal((pointings, COLUMNS))
    ones = np.ones(pointings, dtype=np.int64)
    recording = Recording(
        setup=Setup(stations={"S1": Station(position_mm=(0.0, 0.0, 1600.0), yaw_deg=0.0)}),
        stations=("S1",),
        targets=tuple(f"T{t:02d}" for t in range(TARGETS)),
        station=0 * ones,
        target=target,
        face=ones,
        repeat=1 + np.arange(pointings) // TARGETS,
        time=clock,
        readings=np.zeros((pointings, 3)),
        covariates={f"joint_{k + 1}_deg": 60.0 * sway[:, k] for k in range(COLUMNS)},
    )
    state = NetworkState(np.array([[0.0, 0.0, 1.6]]), rotation_about_z(0.0)[None], points, np.zeros((1, 0)))
    exact = MeasurementModel(recording, make_construction("ideal")).predict(state)
    recording = recording.with_readings(exact)
    return recording.with_readings(exact + recording.reading_sigmas() * rng.standard_normal(exact.shape))


def measure_case(kind: str, pointings: int) -> dict[str, Any]:
    """Row of one recording: size, times, peak of memory, and findings."""
    clean = station_recording(pointings) if kind == "station" else network("ring", 210, 370, pointings)
    drift = np.zeros((pointings, 3))
    drift[:, 2] = 4 * MICRORADIAN * np.exp(-clean.time / (0.2 * clean.time[-1]))
    recording = clean.with_readings(clean.readings + drift)
    lt.diagnose(station_recording(240), held_out=False)  # imports and compilation must not be measured
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    wall, start = time.perf_counter(), time.process_time()
    result_content = lt.diagnose(recording, held_out=False).content()
    return {
        "recording": kind, "set_ups": len(recording.stations), "targets": len(recording.targets),
        "pointings": len(recording), "columns": len(recording.covariates),
        "processor_s": round(time.process_time() - start, 1), "wall_s": round(time.perf_counter() - wall, 1),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3), "before_mb": round(before),
        "told": " + ".join(f["effect"] for f in result_content["findings"]) or result_content["verdict"],
    }  # fmt: skip


def main(folder: Path, pointing_numbers: list[str]) -> None:
    """Measure all cases, or those with the given numbers of pointings, in separate processes; write the table."""
    rows = []
    for kind, pointings in CASES:
        if pointing_numbers and str(pointings) not in pointing_numbers:
            continue
        command = [sys.executable, "-m", "benchmarks.diagnosis_size", "--case", kind, str(pointings)]
        rows.append(json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout))
        print("  ".join(f"{key} {value}" for key, value in rows[-1].items()), flush=True)
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "sizes.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, fieldnames=list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--case"]:
        print(json.dumps(measure_case(sys.argv[2], int(sys.argv[3]))))
    else:
        main(Path(sys.argv[1] if len(sys.argv) > 1 else "build/diagnosis_size"), sys.argv[2:])
