"""check.json and two_face.csv: what a check found, for programs."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

from ltsim.check.check import Check
from ltsim.recording.files import write_texts
from ltsim.units import ARCSECOND, MICROMETRE

FORMAT = "ltsim-check/1"
JSON, TWO_FACE = "check.json", "two_face.csv"
HEADER = (
    "station,target,row_1,row_2,half_range_um,half_across_arcsec,half_elevation_arcsec,"
    "limit_range_um,limit_across_arcsec,limit_elevation_arcsec,passed"
)


def check_json(check: Check) -> dict[str, Any]:
    """The content of `check.json`."""
    return {
        "format": FORMAT,
        "passed": check.passed,
        "sentence": check.sentence,
        "level": check.level,
        "items": [
            {
                "station": item.station,
                "kind": item.kind,
                "passed": item.passed,
                "sentence": item.sentence,
                "p_value": item.p_value,
                "targets": list(item.targets),
                "rows": list(item.rows),
                "between_s": list(item.between) if item.between is not None else None,
            }
            for item in check.items
        ],
    }


def two_face_csv(check: Check) -> str:
    """Half two-face differences with their limits, one row a pair."""
    stream = io.StringIO()
    table = csv.writer(stream, lineterminator="\n")
    table.writerow(HEADER.split(","))
    units = (MICROMETRE, ARCSECOND, ARCSECOND)
    for setup in check.setups:
        if setup.faces is None:
            continue
        faces = setup.faces
        for k, pair in enumerate(faces.pairs.rows):
            rows = setup.rows[pair]
            target = check.recording.targets[check.recording.target[rows[0] - 1]]
            numbers = [f"{value / unit:.4f}" for value, unit in zip(faces.pairs.half[k], units, strict=True)]
            numbers += [f"{value / unit:.4f}" for value, unit in zip(faces.limit[k], units, strict=True)]
            passed = "no" if faces.over[k].any() else "yes"
            table.writerow([setup.station, target, *rows.tolist(), *numbers, passed])
    return stream.getvalue()


def write_check(check: Check, folder: Path, further: dict[str, str] | None = None) -> None:
    """Write `check.json`, `two_face.csv` and `further` texts (a picture) into a folder, whole or not at all.

    Raises
    ------
    RecordError
        When the folder cannot be written.
    """
    text = json.dumps(check_json(check), indent=1, allow_nan=False) + "\n"
    write_texts(folder, {JSON: text, TWO_FACE: two_face_csv(check), **(further or {})})
