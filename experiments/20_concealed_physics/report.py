"""Rows of answers as scores.json and one table, an entrant beside the other; intervals know laws."""

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from experiments.intervals import quantile, share

from .score import Row

ROWS = "recordings.jsonl"
EDGES = (0.0, 0.5, 0.7, 0.9, 0.99, 1.0)
LEVEL, ENOUGH = 0.05, 40
"""False alarms at which the power of entrants is compared, and clean recordings from which their limit is drawn."""
WORSE = 1.05
QUESTIONS = {
    "found": "found",
    "found_at_equal_alarms": "found, at 5 % false alarms of its own",
    "named_first": "named first",
    "named": "named first, or stated as one of three",
    "unknown": "called unknown",
    "observable": "... and its observable",
    "all_covariates": "... and all covariates",
    "outside": "... or observable, and said that the cause is outside",
    "covariates_or_outside": "all covariates, or said outside",
    "place": "place right, of what was named or called unknown",
    "wrong_name": "a wrong name above 0.9",
    "one_finding": "told as one finding",
    "told_rightly": "told rightly: 75 % of the signal, place, observable",
    "law_right": "the right law of the list",
    "worse": "targets worse than plain",
    "worse_than_calibrate": "targets worse than those of `plain` (calibrate) on the same file",
    "told_worse": "targets of somebody told the truth worse than plain",
}
Answer = dict[str, Any]
"""`right` of `of`, or a `value`; with the ends `low` and `high` of its interval."""


def summarise(rows: Sequence[Row]) -> dict[str, Answer]:
    """All that the examination asks of one entrant, by question."""
    answered = [r for r in rows if r["answered"]]
    alarms = [r["p_value"] for r in answered if r["kind"] == "clean"]
    own = float(np.quantile(alarms, LEVEL)) if len(alarms) >= ENOUGH else None
    for r in answered:
        error = r.get("error_um")
        r["found_at_equal_alarms"] = None if own is None else r["p_value"] <= own
        r["worse"] = None if error is None else error > WORSE * r["plain_um"]
        r["told_worse"] = None if error is None else r["told_um"] > WORSE * r["plain_um"]
    found: dict[str, Answer] = {"answered": share([r["answered"] for r in rows], [_cluster(r) for r in rows])}
    places = sorted({(r["kind"], r["hall"], r["strength"]) for r in answered}, key=lambda p: (p[0] != "clean", p))
    for kind, hall, strength in places:
        of = [r for r in answered if (r["kind"], r["hall"], r["strength"]) == (kind, hall, strength)]
        if kind == "clean":
            found[f"false alarms, {hall}"] = _share(of, "found")
            continue
        for key, question in QUESTIONS.items():
            asked = [r for r in of if key != "place" or r.get("named", r.get("unknown"))]
            if any(key in r for r in of):
                found[f"{kind} {hall} {strength}: {question}"] = _share(asked, key)
        for level, word in ((0.25, "lower quartile"), (0.5, "median"), (0.75, "upper quartile")):
            found[f"{kind} {hall} {strength}: share of the signal taken, {word}"] = _quantile(of, "share_taken", level)
        found[f"{kind} {hall} {strength}: coefficients over those of the law, median"] = _quantile(
            of, "coefficients", 0.5
        )
        for who, error in (("targets", "error_um"), ("targets of plain", "plain_um")):
            known = [r for r in of if r.get("error_um") is not None]
            ratios = [r[error] / r["told_um"] for r in known]
            for level, word in ((0.5, "median"), (0.95, "95 %")):
                over = f"{kind} {hall} {strength}: error of {who} over told, {word}"
                found[over] = quantile(ratios, [_cluster(r) for r in known], level)
    judged = [(ok, _cluster(r)) for r in answered for ok in r.get("parameters", [])]
    found["catalogued: parameters inside their 95 % intervals"] = share(*_columns(judged, 2))
    stated = [(p, ok, _cluster(r)) for r in answered for p, ok in r["stated"]]
    for low, high in pairwise(EDGES):
        bin_ = _columns([s for s in stated if low <= s[0] and (s[0] < high or high == EDGES[-1])], 3)
        found[f"findings stated {low:g} to {high:g}: right; mean stated"] = answer = share(*bin_[1:])
        if answer["of"]:
            answer["stated"] = float(np.mean(bin_[0]))
            answer["holds"] = answer["low"] <= answer["stated"] <= answer["high"]
    for hall in sorted({r["hall"] for r in answered}):
        seconds = [r["seconds"] for r in answered if r["hall"] == hall]
        found[f"seconds a recording, {hall}, median"] = {"value": float(np.median(seconds))}
    return found


def _cluster(r: Row) -> str:
    return str(r["law"] or r["name"])


def _columns(rows: Sequence[tuple[Any, ...]], width: int) -> list[tuple[Any, ...]]:
    return list(zip(*rows, strict=True)) or [()] * width


def _share(rows: Sequence[Row], key: str) -> Answer:
    own = [r for r in rows if r.get(key) is not None]
    return share([bool(r[key]) for r in own], [_cluster(r) for r in own])


def _quantile(rows: Sequence[Row], key: str, level: float) -> Answer:
    own = [r for r in rows if r.get(key) is not None]
    return quantile([r[key] for r in own], [_cluster(r) for r in own], level)


def compare_with_calibrate(rows: dict[str, list[Row]]) -> None:
    """Mark the answers whose targets are more than 5 % worse than those of the entrant `plain` on the same file."""
    plain = {r["name"]: r["error_um"] for r in rows.get("plain", ()) if r.get("error_um") is not None}
    for r in (r for own in rows.values() for r in own):
        if r.get("error_um") is not None and r["name"] in plain:
            r["worse_than_calibrate"] = r["error_um"] > WORSE * plain[r["name"]]


def write_report(entrants: dict[str, list[Row]], out: Path, head: dict[str, Any]) -> None:
    """recordings.jsonl, scores.json, table.md; entrants that are not among these keep what they have of this truth."""
    out.mkdir(parents=True, exist_ok=True)
    scores = out / "scores.json"
    before = json.loads(scores.read_text(encoding="utf-8")) if scores.is_file() else {}
    same = before.get("sha256") == head["sha256"]
    rows = (read_rows(out / ROWS) if same else {}) | entrants
    compare_with_calibrate(rows)
    columns = ["entrant", *dict.fromkeys(key for own in rows.values() for r in own for key in r)]
    lines = [[name, *(r.get(key) for key in columns[1:])] for name, own in rows.items() for r in own]
    texts = (json.dumps(_short(_without_nulls_behind(line)), separators=(",", ":")) for line in [columns, *lines])
    (out / ROWS).write_text("".join(text + "\n" for text in texts), encoding="utf-8")
    summaries = (before["entrants"] if same else {}) | {name: summarise(own) for name, own in entrants.items()}
    scores.write_text(json.dumps(_short(head | {"entrants": summaries}), indent=1) + "\n", encoding="utf-8")
    (out / "table.md").write_text(table(summaries, head), encoding="utf-8")


def _without_nulls_behind(line: list[Any]) -> list[Any]:
    """The row up to its last value."""
    return line[: max((i + 1 for i, value in enumerate(line) if value is not None), default=0)]


def _short(content: Any) -> Any:
    """Numbers with six digits."""
    return json.loads(json.dumps(content), parse_float=lambda text: float(f"{float(text):.6g}"))


def read_rows(file: Path) -> dict[str, list[Row]]:
    """Rows by entrant of a file that names its columns first; what a row lacks is null there, or left out behind."""
    found: dict[str, list[Row]] = {}
    columns, *lines = map(json.loads, file.read_text(encoding="utf-8").splitlines()) if file.is_file() else [[]]
    for line in lines:
        row = {key: value for key, value in zip(columns, line, strict=False) if value is not None}
        found.setdefault(row.pop("entrant"), []).append(row)
    return found


def table(summaries: dict[str, dict[str, Answer]], head: dict[str, Any]) -> str:
    """A question a row, an entrant a column."""
    lines = [f"# {head['plan']}: {head['recordings']} recordings, {head['draws_excluded']} draws excluded", ""]
    lines += [f"Truth: sha256 {head['sha256']}", "", "| question | " + " | ".join(summaries) + " |"]
    lines += ["|---" * (len(summaries) + 1) + "|"]
    for question in dict.fromkeys(q for s in summaries.values() for q in s):
        lines.append(f"| {question} | " + " | ".join(_said(s.get(question, {})) for s in summaries.values()) + " |")
    return "\n".join(lines) + "\n"


def _said(a: Answer) -> str:
    if "right" in a and a["of"]:
        bin_ = f"; {a['stated']:.3f}{'' if a['holds'] else ' **no**'}" if "stated" in a else ""
        return f"{a['right']} of {a['of']} ({100 * a['low']:.0f} to {100 * a['high']:.0f} %){bin_}"
    if "value" in a:
        return f"{a['value']:.2f}" + (f" ({a['low']:.2f} to {a['high']:.2f})" if "low" in a else "")
    return "–"
