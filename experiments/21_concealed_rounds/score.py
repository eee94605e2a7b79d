"""Diagnoses of concealed recordings against the truth, once that is open."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.geometry.alignment import align

PLACES = ("stations", "targets", "observables")
BINS = ((0.0, 0.5), (0.5, 0.7), (0.7, 0.9), (0.9, 0.99), (0.99, 1.01))


@dataclass(frozen=True)
class Row:
    """One recording by one diagnosis."""

    name: str
    truth: str
    told: str
    clean: bool
    found: bool
    named: int
    first: int
    of: int
    place: int
    unknown: int
    exact: int
    unknown_of: int
    alarms: int
    stated: tuple[tuple[float, bool], ...]
    before_um: float
    after_um: float


def answers_of(folder: Path) -> dict[str, dict[str, Any]]:
    """Diagnoses by recording: condensed in one file, or a folder each; with coordinates and their change [mm]."""
    if (folder / "answers.json").is_file():
        found: dict[str, dict[str, Any]] = json.loads((folder / "answers.json").read_text(encoding="utf-8"))
        return found
    found = {}
    for file in sorted(folder.glob("*/diagnosis.json")):
        with (file.parent / "targets.csv").open(encoding="utf-8") as lines:
            rows = list(csv.DictReader(lines))
        found[file.parent.name] = json.loads(file.read_text(encoding="utf-8")) | {
            key: {r["target"]: [float(r[f"{prefix}{a}_mm"]) for a in "xyz"] for r in rows}
            for key, prefix in (("targets_mm", ""), ("change_mm", "change_"))
        }
    return found


def rigid_error(points: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square distance [um] of points (T, 3) [mm] from the truth after the best rigid fit."""
    rotation, translation = align(points, truth)
    gap = points @ rotation.T + translation - truth
    return float(1e3 * np.sqrt(np.mean(np.sum(gap**2, axis=1))))


def names_of(answer: dict[str, Any]) -> set[str]:
    """Names that count as right: the true one and those that this recording cannot tell from it."""
    return {answer["effect"], *answer["accept"]}


def fits(answer: dict[str, Any], finding: dict[str, Any]) -> bool:
    """Whether the places of a finding are those of an answer; an observable is right where the finding names it."""
    true, where = answer["where"], finding["where"]
    same = all(set(true[key]) == set(where[key]) for key in PLACES[:2] if key in true)
    kinds = set(true.get("observables", ())), set(where["observables"])
    return same and (not kinds[0] or not kinds[1] or bool(kinds[0] & kinds[1]))


def scored(name: str, truth: dict[str, Any], found: dict[str, Any]) -> Row:
    """Everything that is counted of one recording."""
    answers, findings = truth["case"]["answer"], list(found["findings"])
    known = [a for a in answers if a["effect"] != "unknown"]
    free, named, first, place, unknown, exact = list(findings), 0, 0, 0, 0, 0
    stated: list[tuple[float, bool]] = []
    for answer in answers:
        right = names_of(answer)
        strict = [f for f in free if f["effect"] in right]
        loose = [f for f in free if right & {e["effect"] for e in f["equivalents"][:3]}]
        if not strict + loose:
            continue
        hit = (strict + loose)[0]
        free.remove(hit)
        if answer["effect"] == "unknown":
            unknown += bool(strict) and fits(answer, hit)
            exact += bool(strict) and set(hit["where"]["observables"]) == set(answer["where"].get("observables", ()))
        else:
            named, first = named + 1, first + bool(strict)
            place += fits(answer, hit)
    everything = {n for a in answers for n in names_of(a)}
    stated = [(f["evidence"]["probability"], f["effect"] in everything) for f in findings]
    before, after = _errors(truth, found)
    return Row(
        name,
        " + ".join(a["effect"] for a in answers) or "–",
        " + ".join(f["effect"] for f in findings) or "–",
        not answers,
        found["verdict"] == "mismatch",
        named,
        first,
        len(known),
        place,
        unknown,
        exact,
        len(answers) - len(known),
        len(findings) if not answers else max(len(findings) - len(answers), 0),
        tuple(stated),
        before,
        after,
    )


def _errors(truth: dict[str, Any], found: dict[str, Any]) -> tuple[float, float]:
    """Error of the targets [um] in the plain adjustment and after the diagnosis."""
    names = [n for n in truth["targets_mm"] if n in found["targets_mm"]]
    points, change, true = (
        np.array([source[n] for n in names])
        for source in (found["targets_mm"], found["change_mm"], truth["targets_mm"])
    )
    return rigid_error(points - change, true), rigid_error(points, true)


def totals(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """What is counted over all recordings."""
    clean, other = [r for r in rows if r.clean], [r for r in rows if not r.clean]
    stated = [s for r in rows for s in r.stated]
    worse = sum(r.after_um > 1.05 * r.before_um for r in rows)
    lines = [
        ("false alarms", f"{sum(r.found for r in clean)} of {len(clean)}"),
        ("found", f"{sum(r.found for r in other)} of {len(other)}"),
        ("named first", f"{sum(r.first for r in rows)} of {sum(r.of for r in rows)}"),
        ("named or stated", f"{sum(r.named for r in rows)} of {sum(r.of for r in rows)}"),
        ("place of what was named", f"{sum(r.place for r in rows)} of {sum(r.named for r in rows)}"),
        (
            "unknown, with one of its observables",
            f"{sum(r.unknown for r in rows)} of {sum(r.unknown_of for r in rows)}",
        ),
        ("unknown, exactly its observables", f"{sum(r.exact for r in rows)} of {sum(r.unknown_of for r in rows)}"),
        ("findings beyond the truth", str(sum(r.alarms for r in rows))),
        ("targets worse than plain by over 5 %", f"{worse} of {len(rows)}"),
        ("target error over plain, median of what holds something", f"{_median(other):.2f}"),
    ]
    for low, high in BINS:
        inside = [right for p, right in stated if low <= p < high]
        if inside:
            lines.append((f"stated {low:g} to {min(high, 1):g}: right", f"{sum(inside)} of {len(inside)}"))
    logs = [-np.log(max(p if right else 1 - p, 1e-3)) for p, right in stated]
    lines.append(("log score of the names (nat, less is better)", f"{np.mean(logs):.2f}"))
    return lines


def _median(rows: Sequence[Row]) -> float:
    return float(np.median([r.after_um / r.before_um for r in rows]))


def markdown(sets: dict[str, list[Row]]) -> str:
    """Both tables: what is counted, and each recording."""
    counted = {name: totals(rows) for name, rows in sets.items()}
    keys = list(dict.fromkeys(key for lines in counted.values() for key, _ in lines))
    head = "| | " + " | ".join(sets) + " |\n|---" * 1 + "|---" * len(sets) + "|\n"
    table = "".join(
        f"| {key} | " + " | ".join(dict(lines).get(key, "–") for lines in counted.values()) + " |\n" for key in keys
    )
    rows = "| recording | truth | " + " | ".join(f"{n}: told, targets [um] before, after" for n in sets) + " |\n"
    rows += "|---|---" + "|---" * len(sets) + "|\n"
    for one in zip(*sets.values(), strict=True):
        cells = " | ".join(f"{r.told}, {r.before_um:.1f}, {r.after_um:.1f}" for r in one)
        rows += f"| {one[0].name} | {one[0].truth} | {cells} |\n"
    return f"{head}{table}\n{rows}"
