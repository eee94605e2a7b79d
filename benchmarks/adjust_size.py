"""Cost and memory of an adjustment as a function of the size of its network.

    python -m benchmarks.adjust_size results/04_network_size

The networks are rings and arcs of set-ups that measure the nearest targets. Each network is adjusted without start
values; the cost includes the standard deviations of all points and set-ups and the redundancies of all observations.
Each network runs in a separate process, so that its peak of memory can be measured. The main figure is the processor
time of one thread; the wall-clock time is also listed.
"""

from __future__ import annotations

import csv
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from ltsim.adjustment import adjust
from ltsim.core.randomness import random_stream
from ltsim.geometry.rigid import rotation_about_z
from ltsim.physics.model.construction import make_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Setup

Case = tuple[str, int, int, int, str]
CASES: tuple[Case, ...] = (
    *(("ring", n, n * 370 // 210, 16 * n, "ideal") for n in (26, 52, 105)),
    ("ring", 210, 370, 3340, "ideal"),
    ("ring", 210, 370, 3340, "misalignment"),
    *(("ring", n, n * 370 // 210, 16 * n, "ideal") for n in (420, 840)),
    ("arc", 54, 1003, 3365, "ideal"),
    ("arc", 54, 1003, 3365, "misalignment"),
)
SPACING = 6.3
"""[m] Distance between neighbouring set-ups."""


def network(kind: str, stations: int, targets: int, pointings: int) -> Recording:
    """Recording of set-ups on a circle or an arc, each of which measures its nearest targets with the default noise."""
    rng = random_stream(4, "network", kind, stations)
    fraction = 1.0 if kind == "ring" else 0.25
    radius = stations * SPACING / (2 * np.pi * fraction)
    along = 2 * np.pi * fraction * np.arange(stations) / stations
    at = 2 * np.pi * fraction * (np.arange(targets) + 0.5) / targets
    side = radius + rng.choice([-2.0, 2.0], targets) + rng.normal(0, 0.3, targets)
    position = np.stack([radius * np.cos(along), radius * np.sin(along), rng.normal(1.6, 0.1, stations)], axis=1)
    points = np.stack([side * np.cos(at), side * np.sin(at), rng.uniform(0.2, 3.0, targets)], axis=1)
    gap = np.linalg.norm(position[:, None] - points[None], axis=2)
    pointings_of_station = [pointings // stations + (s < pointings % stations) for s in range(stations)]
    pairs = [(s, t) for s in range(stations) for t in np.argsort(gap[s])[: pointings_of_station[s]]]
    station, target = np.array(pairs, dtype=np.int64).T
    names, target = np.unique(target, return_inverse=True)
    ones = np.ones(len(station), dtype=np.int64)
    recording = Recording(
        setup=Setup(),
        stations=tuple(f"S{i:03d}" for i in range(stations)),
        targets=tuple(f"T{i:04d}" for i in names),
        station=station,
        target=target.astype(np.int64),
        face=ones,
        repeat=ones,
        time=np.arange(len(station), dtype=np.float64),
        readings=np.zeros((len(station), 3)),
    )
    rotation = np.stack([rotation_about_z(float(a)) for a in rng.uniform(-3, 3, stations)])
    state = NetworkState(position, rotation, points[names], np.zeros((1, 0)))
    exact = MeasurementModel(recording, make_construction("ideal")).predict(state)
    recording = recording.with_readings(exact)
    return recording.with_readings(exact + recording.reading_sigmas() * rng.standard_normal(exact.shape))


def measure_case(case: Case) -> dict[str, float | str]:
    """Row of one network: size, times and peak of memory."""
    kind, stations, targets, pointings, built = case
    recording = network(kind, stations, targets, pointings)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    adjust(network("ring", 8, 14, 128))  # imports and loading of libraries must not be measured
    best = (np.inf, np.inf, np.inf)
    for _ in range(3):
        wall, start = time.perf_counter(), time.process_time()
        adjustment = adjust(recording, make_construction(built))
        solved = time.process_time()
        sigma = np.sqrt(np.einsum("tii->ti", adjustment.target_covariances))
        poses, redundancy = adjustment.pose_covariance, adjustment.redundancy
        end = time.process_time()
        best = min(best, (end - start, solved - start, time.perf_counter() - wall))
    adjustment.solution.require_success()
    if not (np.isfinite(sigma).all() and np.isfinite(poses).all() and abs(np.nansum(redundancy) - adjustment.dof) < 60):
        raise RuntimeError("a standard deviation is not finite, or the redundancies do not sum up to dof")
    return {
        "network": kind, "construction": built, "set_ups": stations, "targets": len(recording.targets),
        "pointings": len(recording), "unknowns": adjustment.problem.unknowns.n_columns, "adjust_s": round(best[1], 3),
        "all_s": round(best[0], 3), "wall_s": round(best[2], 3),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3),
        "before_mb": round(before), "sigma0": round(adjustment.sigma0, 4),
        "largest_sigma_mm": round(1e3 * float(sigma.max()), 3),
    }  # fmt: skip


def main(folder: Path) -> None:
    """Measure all cases, each in a separate process, and write the table."""
    rows = []
    for i in range(len(CASES)):
        command = [sys.executable, "-m", "benchmarks.adjust_size", "--case", str(i)]
        rows.append(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
        print(rows[-1])
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "sizes.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--case"]:
        print(json.dumps(measure_case(CASES[int(sys.argv[2])])))
    else:
        main(Path(sys.argv[1] if len(sys.argv) > 1 else "results/04_network_size"))
