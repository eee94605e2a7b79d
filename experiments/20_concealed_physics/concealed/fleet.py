"""Several trackers on one network of 100 set-ups, one of them off by a constant that nobody knows."""

from __future__ import annotations

import csv
import time
from pathlib import Path
from typing import Any

import ltsim as lt
from experiments.several_trackers import scenario_of

from .score import LIMIT

SEED = 23
SETUPS, TRACKERS = 100, 3
CASES: dict[str, tuple[str, float, int]] = {
    "beam-tilt": ("C", 15.0, 1),
    "vertical-index": ("A", -20.0, 2),
    "range-offset": ("B", 30.0, 1),
}
"""The constant that is off: its tracker, size [urad or um] and the faces that are measured."""


def fleet(name: str) -> dict[str, Any]:
    """Simulate and diagnose one case with default settings.

    Returns
    -------
    dict
        A row: what is off, what is told first and of which tracker, value with its standard deviation and the truth,
        further findings, processor time.
    """
    off, size, faces = CASES[name]
    scenario = scenario_of(setups=SETUPS, trackers=TRACKERS, off=off, errors={name: size}, faces=faces)
    recording, truth = lt.simulate(scenario, seed=SEED)
    start = time.process_time()
    told = lt.diagnose(recording).to_json()
    seconds = time.process_time() - start
    findings = told["findings"]
    first = findings[0] if findings else {"effect": "", "where": {}, "parameters": [], "evidence": {"probability": ""}}
    value = next((p for p in first["parameters"] if name in p["name"]), None)
    true = truth.instrument[f"{name}@{off}"] * 1e6
    return {
        "off": f"{name} of {off}", "set_ups": len(recording.stations), "pointings": len(recording),
        "true": round(true, 3), "told": first["effect"], "of": " ".join(first["where"].get("instruments", [])),
        "probability": first["evidence"]["probability"],
        "value": value["value"] if value else "", "sigma": value["sigma"] if value else "",
        "right_tracker": first["where"].get("instruments") == [off],
        "right_constant": first["effect"] == name,
        "inside": bool(value) and abs(value["value"] - true) < LIMIT * value["sigma"],
        "further": "; ".join(f"{f['effect']} of {f['where'].get('instruments', '')}" for f in findings[1:]),
        "seconds": round(seconds, 1), "summary": told["summary"],
    }  # fmt: skip


def examine_fleet(names: list[str], out: Path) -> None:
    """Write a row a case as it comes, and print it; rows of other cases stay."""
    file = out / "fleet.csv"
    rows = []
    if file.exists():
        with file.open(encoding="utf-8", newline="") as lines:
            rows = list(csv.DictReader(lines))
    out.mkdir(parents=True, exist_ok=True)
    for name in names:
        row = fleet(name)
        print(row, flush=True)
        rows = [r for r in rows if r["off"] != row["off"]] + [row]
        with file.open("w", encoding="utf-8", newline="") as table:
            writer = csv.DictWriter(table, list(row), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
