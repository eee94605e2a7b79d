"""Scores of answers: recordings.jsonl, scores.json and one table with a column for each entrant."""

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from experiments.intervals import proportion, quantile

from .score import Row

ROWS = "recordings.jsonl"
EDGES = (0.0, 0.5, 0.7, 0.9, 0.99, 1.0)
LEVEL, ENOUGH = 0.05, 40
"""False alarm rate (`LEVEL`) at which detections are compared, and the smallest number of clean recordings from which
the corresponding limit is estimated (`ENOUGH`).
"""
WORSE_RATIO = 1.05
QUESTIONS = {
    "detected": "detected",
    "detected_at_equal_alarms": "detected, with the limit that gives this program 5 % false alarms",
    "named_first": "named first",
    "named": "named first, or among the first three names",
    "unknown": "reported as unknown",
    "observable": "reported as unknown, with the right observable",
    "all_covariates": "reported as unknown, with the right observable and covariates",
    "outside": "right observable, and the covariate reported as not recorded",
    "covariates_or_outside": "all covariates right, or reported as not recorded",
    "place": "right place, of the effects that are named or reported as unknown",
    "wrong_name": "wrong name with a probability above 0.9",
    "single_finding": "reported as a single finding",
    "correctly_reported": "correctly reported: 75 % of the signal, place, observable",
    "law_right": "right law of the list",
    "worse": "targets worse than those of the linear adjustment",
    "worse_than_calibrate": "targets worse than those of `plain` (calibrate) for the same recording",
    "given_law_worse": "targets of the adjustment given the law worse than those of the linear adjustment",
}
Answer = dict[str, Any]
"""`count` of `total`, or a `value`; with the ends `low` and `high` of its interval."""


def summarise(rows: Sequence[Row]) -> dict[str, Answer]:
    """Answers to the questions of the examination for one entrant, by question."""
    answered = [r for r in rows if r["answered"]]
    alarms = [r["p_value"] for r in answered if r["kind"] == "clean"]
    limit = float(np.quantile(alarms, LEVEL)) if len(alarms) >= ENOUGH else None
    for r in answered:
        error = r.get("error_um")
        r["detected_at_equal_alarms"] = None if limit is None else r["p_value"] <= limit
        r["worse"] = None if error is None else error > WORSE_RATIO * r["plain_um"]
        r["given_law_worse"] = None if error is None else r["given_law_um"] > WORSE_RATIO * r["plain_um"]
    answers: dict[str, Answer] = {"answered": proportion([r["answered"] for r in rows], [_cluster(r) for r in rows])}
    places = sorted({(r["kind"], r["hall"], r["strength"]) for r in answered}, key=lambda p: (p[0] != "clean", p))
    for kind, hall, strength in places:
        of = [r for r in answered if (r["kind"], r["hall"], r["strength"]) == (kind, hall, strength)]
        if kind == "clean":
            answers[f"false alarms, {hall}"] = _proportion(of, "detected")
            continue
        for key, question in QUESTIONS.items():
            scored = [r for r in of if key != "place" or r.get("named", r.get("unknown"))]
            if any(key in r for r in of):
                answers[f"{kind} {hall} {strength}: {question}"] = _proportion(scored, key)
        for level, word in ((0.25, "lower quartile"), (0.5, "median"), (0.75, "upper quartile")):
            answers[f"{kind} {hall} {strength}: explained fraction of the signal, {word}"] = _quantile(
                of, "explained_fraction", level
            )
        answers[f"{kind} {hall} {strength}: number of coefficients over that of the law, median"] = _quantile(
            of, "coefficients", 0.5
        )
        for who, error in (("targets", "error_um"), ("targets of the linear adjustment", "plain_um")):
            measured = [r for r in of if r.get("error_um") is not None]
            ratios = [r[error] / r["given_law_um"] for r in measured]
            for level, word in ((0.5, "median"), (0.95, "95 %")):
                over = f"{kind} {hall} {strength}: error of {who} over that given the law, {word}"
                answers[over] = quantile(ratios, [_cluster(r) for r in measured], level)
    judged = [(ok, _cluster(r)) for r in answered for ok in r.get("parameters", [])]
    answers["catalogued: parameters inside their 95 % intervals"] = proportion(*_columns(judged, 2))
    findings = [(p, ok, _cluster(r)) for r in answered for p, ok in r["probabilities"]]
    for low, high in pairwise(EDGES):
        bin_ = _columns([s for s in findings if low <= s[0] and (s[0] < high or high == EDGES[-1])], 3)
        answers[f"findings with probability {low:g} to {high:g}: right; mean probability"] = answer = proportion(
            *bin_[1:]
        )
        if answer["total"]:
            answer["mean_probability"] = float(np.mean(bin_[0]))
            answer["holds"] = answer["low"] <= answer["mean_probability"] <= answer["high"]
    for hall in sorted({r["hall"] for r in answered}):
        seconds = [r["seconds"] for r in answered if r["hall"] == hall]
        answers[f"seconds for a recording, {hall}, median"] = {"value": float(np.median(seconds))}
    return answers


def _cluster(r: Row) -> str:
    return str(r["law"] or r["name"])


def _columns(rows: Sequence[tuple[Any, ...]], width: int) -> list[tuple[Any, ...]]:
    return list(zip(*rows, strict=True)) or [()] * width


def _proportion(rows: Sequence[Row], key: str) -> Answer:
    answered = [r for r in rows if r.get(key) is not None]
    return proportion([bool(r[key]) for r in answered], [_cluster(r) for r in answered])


def _quantile(rows: Sequence[Row], key: str, level: float) -> Answer:
    answered = [r for r in rows if r.get(key) is not None]
    return quantile([r[key] for r in answered], [_cluster(r) for r in answered], level)


def compare_with_calibrate(rows: dict[str, list[Row]]) -> None:
    """Mark the answers whose target errors are more than 5 % larger than those of `plain` for the same recording."""
    plain = {r["name"]: r["error_um"] for r in rows.get("plain", ()) if r.get("error_um") is not None}
    for r in (r for entrant_rows in rows.values() for r in entrant_rows):
        if r.get("error_um") is not None and r["name"] in plain:
            r["worse_than_calibrate"] = r["error_um"] > WORSE_RATIO * plain[r["name"]]


def write_report(entrants: dict[str, list[Row]], out: Path, head: dict[str, Any]) -> None:
    """Write recordings.jsonl, scores.json, table.md; other entrants keep their earlier rows for the same truth."""
    out.mkdir(parents=True, exist_ok=True)
    scores = out / "scores.json"
    before = json.loads(scores.read_text(encoding="utf-8")) if scores.is_file() else {}
    same = before.get("sha256") == head["sha256"]
    rows = (read_rows(out / ROWS) if same else {}) | entrants
    compare_with_calibrate(rows)
    columns = ["entrant", *dict.fromkeys(key for entrant_rows in rows.values() for r in entrant_rows for key in r)]
    lines = [[name, *(r.get(key) for key in columns[1:])] for name, entrant_rows in rows.items() for r in entrant_rows]
    texts = (
        json.dumps(_with_six_digits(_without_nulls_behind(line)), separators=(",", ":")) for line in [columns, *lines]
    )
    (out / ROWS).write_text("".join(text + "\n" for text in texts), encoding="utf-8")
    summaries = (before["entrants"] if same else {}) | {
        name: summarise(entrant_rows) for name, entrant_rows in entrants.items()
    }
    scores.write_text(json.dumps(_with_six_digits(head | {"entrants": summaries}), indent=1) + "\n", encoding="utf-8")
    (out / "table.md").write_text(table(summaries, head), encoding="utf-8")


def rewrite_report(out: Path) -> None:
    """Write scores.json and table.md again from the rows of recordings.jsonl."""
    scores = json.loads((out / "scores.json").read_text(encoding="utf-8"))
    head = {key: value for key, value in scores.items() if key != "entrants"}
    write_report(read_rows(out / ROWS), out, head)


def _without_nulls_behind(line: list[Any]) -> list[Any]:
    """Row without null values at its end."""
    return line[: max((i + 1 for i, value in enumerate(line) if value is not None), default=0)]


def _with_six_digits(content: Any) -> Any:
    """Content with numbers rounded to six digits."""
    return json.loads(json.dumps(content), parse_float=lambda text: float(f"{float(text):.6g}"))


def read_rows(file: Path) -> dict[str, list[Row]]:
    """Rows by entrant of a file whose first line names the columns; a missing value is null, or omitted at the end."""
    rows: dict[str, list[Row]] = {}
    columns, *lines = map(json.loads, file.read_text(encoding="utf-8").splitlines()) if file.is_file() else [[]]
    for line in lines:
        row = {key: value for key, value in zip(columns, line, strict=False) if value is not None}
        rows.setdefault(row.pop("entrant"), []).append(row)
    return rows


def table(summaries: dict[str, dict[str, Answer]], head: dict[str, Any]) -> str:
    """Table in Markdown with a row for each question and a column for each entrant."""
    lines = [f"# {head['plan']}: {head['recordings']} recordings, {head['draws_excluded']} draws excluded", ""]
    lines += [f"Truth: sha256 {head['sha256']}", "", "| question | " + " | ".join(summaries) + " |"]
    lines += ["|---" * (len(summaries) + 1) + "|"]
    for question in dict.fromkeys(q for s in summaries.values() for q in s):
        lines.append(
            f"| {question} | " + " | ".join(_answer_text(s.get(question, {})) for s in summaries.values()) + " |"
        )
    return "\n".join(lines) + "\n"


def _answer_text(a: Answer) -> str:
    if "count" in a and a["total"]:
        bin_ = f"; {a['mean_probability']:.3f}{'' if a['holds'] else ' **no**'}" if "mean_probability" in a else ""
        return f"{a['count']} of {a['total']} ({100 * a['low']:.0f} to {100 * a['high']:.0f} %){bin_}"
    if "value" in a:
        return f"{a['value']:.2f}" + (f" ({a['low']:.2f} to {a['high']:.2f})" if "low" in a else "")
    return "–"
