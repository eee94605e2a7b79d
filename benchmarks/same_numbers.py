"""Comparison of the numbers that thirty commands write in this checkout and in another one.

    python -m benchmarks.same_numbers ../other-checkout [--keep build/same]

The commands of each checkout run in a separate folder. All numbers of all JSON and CSV files that both checkouts write
are compared. For each file with differences above one part per million, the largest difference is listed.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parents[1]
START = "from ltsim.cli.main import main; main()"
COMMANDS = """
simulate paper-workshop --seed 7 --out rec --truth truth.json
simulate paper-workshop-two-face --seed 8 --out two --truth two.json
simulate paper-laboratory --seed 9 --out lab --truth lab.json --nominal cmm.csv
simulate two-trackers --seed 10 --out trackers --truth trackers.json
simulate paper-workshop-re-aimed --seed 11 --out aimed --truth aimed.json
adjust rec --out adjusted
adjust rec --robust --noise-from-data --out adjusted-robust
adjust rec --datum T01,T02,T05,T12 --out adjusted-datum
adjust trackers --out adjusted-trackers
calibrate rec --out calibrated
calibrate two --out calibrated-two
calibrate rec --method distance --out calibrated-distance
calibrate rec --method distance-l1 --out calibrated-l1
calibrate rec --construction dh --out calibrated-dh
calibrate two --without range-scale --hold vertical-index=5 --out calibrated-held
calibrate trackers --robust --out calibrated-trackers
calibrate two --with index-drift --out calibrated-with
calibrate rec --prior calibrated-two --out calibrated-prior
correct two --calibration calibrated-two --out corrected
evaluate rec --calibration calibrated --out evaluated
verify lab --nominal cmm.csv --calibration calibrated --out verified
check two --out checked
diagnose rec --seed 1 --out diagnosed
diagnose trackers --seed 1 --out diagnosed-trackers
compare rec aimed --out compared
history calibrated calibrated-two --dates 2026-01-01,2026-02-01 --out history
recover paper-workshop-re-aimed --trials 100 --jobs 1 --out recovered
convert rec rec.gkf --to gama-local
convert rec.gkf back
plan paper-workshop --starts 1 --jobs 1 --out planned
"""


def run(checkout: Path, folder: Path) -> dict[str, int]:
    """Exit status of each command in a folder."""
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    statuses = {}
    folder.mkdir(parents=True, exist_ok=True)
    for command in COMMANDS.strip().splitlines():
        words = [sys.executable, "-c", START, *command.split(), "--quiet"]
        done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        statuses[command] = done.returncode
    return statuses


def numbers(value: object, key: str = "") -> Iterator[tuple[str, float]]:
    """Path of keys and value of every number in a JSON value."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from numbers(inner, f"{key}.{name}" if key else name)
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from numbers(inner, f"{key}[{index}]")
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield key, float(value)


def numbers_of(path: Path) -> dict[str, float]:
    """Numbers of a JSON or CSV file, by their location."""
    if path.suffix == ".json":
        return dict(numbers(json.loads(path.read_text(encoding="utf-8"))))
    values = {}
    with path.open(encoding="utf-8", newline="") as lines:
        for index, row in enumerate(csv.DictReader(lines)):
            for name, text in row.items():
                try:
                    values[f"{name}[{index}]"] = float(text)
                except (TypeError, ValueError):
                    continue
    return values


def differences(ours: Path, theirs: Path) -> Iterator[str]:
    """Line for each file whose numbers differ, with the location of the largest relative difference."""
    for path in sorted(theirs.rglob("*")):
        if path.suffix not in (".json", ".csv") or path.name == "manifest.json":
            continue
        name = path.relative_to(theirs)
        if not (ours / name).exists():
            yield f"{name}: not written"
            continue
        old, new = numbers_of(path), numbers_of(ours / name)
        shared = [key for key in old if key in new]
        worst, where = 0.0, ""
        for key in shared:
            scale = max(abs(old[key]), abs(new[key]), 1e-12)
            if abs(old[key] - new[key]) / scale > max(worst, 1e-6):
                worst, where = abs(old[key] - new[key]) / scale, key
        gone = len(old) - len(shared)
        if where or gone:
            change = f"{where}: {old[where]:.9g} before, {new[where]:.9g} now" if where else "common numbers are equal"
            yield f"{name}: {change}" + (f"; {gone} of {len(old)} keys are missing" if gone else "")


def main() -> int:
    """Run both checkouts, and print the differences; the exit status is 1 if there are any."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("other", type=Path)
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        theirs, ours = run(options.other.resolve(), folder / "other"), run(HERE, folder / "this")
        lines = [f"{c}: exit status {theirs[c]} before, {ours[c]} now" for c in theirs if theirs[c] or ours[c]]
        lines += differences(folder / "this", folder / "other")
    print("\n".join(lines) or f"all numbers of {len(theirs)} commands are equal")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
