"""Scores of diagnoses of concealed recordings against their truth."""

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ltsim.adjustment.evaluation.clouds import align_to_points

PLACES = ("stations", "targets", "observables")
Row = dict[str, Any]


def answers_of(folder: Path) -> dict[str, dict[str, Any]]:
    """Diagnoses by recording, with target coordinates and their change [mm].

    The diagnoses are in one file `answers.json`, or in one folder for each recording.
    """
    if (folder / "answers.json").is_file():
        answers: dict[str, dict[str, Any]] = json.loads((folder / "answers.json").read_text(encoding="utf-8"))
        return answers
    answers = {}
    for file in sorted(folder.glob("*/diagnosis.json")):
        rows = pd.read_csv(file.parent / "targets.csv", dtype={"target": str}).set_index("target")
        answers[file.parent.name] = json.loads(file.read_text(encoding="utf-8")) | {
            key: dict(zip(rows.index, rows[[f"{prefix}{a}_mm" for a in "xyz"]].to_numpy().tolist(), strict=True))
            for key, prefix in (("targets_mm", ""), ("change_mm", "change_"))
        }
    return answers


def rigid_error(points: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square distance [um] of points (T, 3) [mm] from the truth after the best rigid fit."""
    return float(1e3 * np.sqrt(np.mean(np.sum((align_to_points(points, truth) - truth) ** 2, axis=1))))


def names_of(answer: dict[str, Any]) -> set[str]:
    """Names that count as correct: the true one, and those that the recording cannot distinguish from it."""
    return {answer["effect"], *answer["accept"]}


def fits(answer: dict[str, Any], finding: dict[str, Any]) -> bool:
    """True if a finding has the stations and targets of an answer, and one of its observables."""
    true, where = answer["where"], finding["where"]
    same = all(set(true[key]) == set(where[key]) for key in PLACES[:2] if key in true)
    kinds = set(true.get("observables", ())), set(where["observables"])
    return same and (not kinds[0] or not kinds[1] or bool(kinds[0] & kinds[1]))


def score_recording(name: str, truth: dict[str, Any], diagnosis: dict[str, Any]) -> Row:
    """Row of the scores of one recording."""
    answers, findings = truth["case"]["answer"], list(diagnosis["findings"])
    count = Counter({"of": sum(a["effect"] != "unknown" for a in answers)})
    count["unknown_of"] = len(answers) - count["of"]
    free = list(findings)
    for answer in answers:
        right = names_of(answer)
        strict = [f for f in free if f["effect"] in right]
        loose = [f for f in free if right & {e["effect"] for e in f["equivalents"][:3]}]
        if not strict + loose:
            continue
        hit = (strict + loose)[0]
        free.remove(hit)
        if answer["effect"] == "unknown":
            count["unknown"] += bool(strict) and fits(answer, hit)
            reported, true = hit["where"]["observables"], answer["where"].get("observables", ())
            count["exact"] += bool(strict) and set(reported) == set(true)
        else:
            count.update(named=1, first=bool(strict), place=fits(answer, hit))
    count["alarms"] = len(findings) if not answers else max(len(findings) - len(answers), 0)
    before, after = _errors(truth, diagnosis)
    return {
        "name": name,
        "truth": " + ".join(a["effect"] for a in answers) or "–",
        "reported": " + ".join(f["effect"] for f in findings) or "–",
        "clean": not answers,
        "detected": diagnosis["verdict"] == "mismatch",
        "count": count,
        "before_um": before,
        "after_um": after,
    }


def _errors(truth: dict[str, Any], diagnosis: dict[str, Any]) -> tuple[float, float]:
    """Error of the targets [um] in the plain adjustment and after the diagnosis."""
    names = [n for n in truth["targets_mm"] if n in diagnosis["targets_mm"]]
    points, change, true = (
        np.array([source[n] for n in names])
        for source in (diagnosis["targets_mm"], diagnosis["change_mm"], truth["targets_mm"])
    )
    return rigid_error(points - change, true), rigid_error(points, true)


def totals(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """Counts over all recordings, with their labels."""
    clean, other = ([r for r in rows if r["clean"] == kind] for kind in (True, False))
    n: Counter[str] = sum((r["count"] for r in rows), Counter())
    worse = sum(r["after_um"] > 1.05 * r["before_um"] for r in rows)
    ratio = float(np.median([r["after_um"] / r["before_um"] for r in other]))
    return [
        ("false alarms", f"{sum(r['detected'] for r in clean)} of {len(clean)}"),
        ("detected", f"{sum(r['detected'] for r in other)} of {len(other)}"),
        ("named first", f"{n['first']} of {n['of']}"),
        ("named first or as an equivalent", f"{n['named']} of {n['of']}"),
        ("right place, of the named effects", f"{n['place']} of {n['named']}"),
        ("unknown, with one of its observables", f"{n['unknown']} of {n['unknown_of']}"),
        ("unknown, exactly its observables", f"{n['exact']} of {n['unknown_of']}"),
        ("findings beyond the truth", str(n["alarms"])),
        ("target errors more than 5 % larger than those of the adjustment", f"{worse} of {len(rows)}"),
        ("target error over that of the adjustment, median of recordings with an effect", f"{ratio:.2f}"),
    ]


def markdown(sets: dict[str, list[Row]]) -> str:
    """Tables in Markdown: the counts, and a row for each recording."""
    counted = {name: dict(totals(rows)) for name, rows in sets.items()}
    lines = ["| | " + " | ".join(sets) + " |", "|---" * (1 + len(sets)) + "|"]
    keys = dict.fromkeys(key for column in counted.values() for key in column)
    lines += [f"| {key} | " + " | ".join(column.get(key, "–") for column in counted.values()) + " |" for key in keys]
    lines += [
        "",
        "| recording | truth | "
        + " | ".join(f"{n}: reported effects; target errors [um] before, after" for n in sets)
        + " |",
    ]
    lines.append("|---|---" + "|---" * len(sets) + "|")
    for recording_rows in zip(*sets.values(), strict=True):
        cells = " | ".join(f"{r['reported']}, {r['before_um']:.1f}, {r['after_um']:.1f}" for r in recording_rows)
        lines.append(f"| {recording_rows[0]['name']} | {recording_rows[0]['truth']} | {cells} |")
    return "\n".join(lines) + "\n"
