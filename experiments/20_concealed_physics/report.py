"""Rows of answers as scores.json, one table and one figure, an entrant beside the other."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from .clusters import quantile, share
from .score import Row

EDGES = (0.0, 0.5, 0.7, 0.9, 0.99, 1.0)
LEVEL, ENOUGH = 0.05, 40
"""False alarms at which the power of entrants is compared, and clean recordings from which their limit is drawn."""
WORSE = 1.05
ASKED = {
    "catalogued": ("found", "found_at_equal_alarms", "named_first", "named", "place", "one_finding"),
    "unknown": ("found", "found_at_equal_alarms", "unknown", "observable", "all_covariates", "outside",
                "covariates_or_outside", "place", "wrong_name", "one_finding"),
}  # fmt: skip
SAID = {
    "found_at_equal_alarms": "found, at 5 % false alarms of its own",
    "named": "named first, or stated as one of three",
    "place": "place right, of what was named or called unknown",
    "unknown": "called unknown",
    "observable": "... and its observable",
    "all_covariates": "... and all covariates",
    "outside": "... or observable, and said that the cause is outside",
    "covariates_or_outside": "all covariates, or said outside",
    "wrong_name": "a wrong name above 0.9",
    "one_finding": "told as one finding",
}


COLOURS = ("#1a5a96", "#b8470d", "#4a7c1f", "#6b4c9a", "#4a5056")
"""Of the entrants, and of what each of them is asked."""


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """All that the examination asks of one entrant."""
    answered = [r for r in rows if r["answered"]]
    clean = [r for r in answered if r["kind"] == "clean"]
    own = float(np.quantile([r["p_value"] for r in clean], LEVEL)) if len(clean) >= ENOUGH else None
    for r in answered:
        r["found_at_equal_alarms"] = None if own is None else r["p_value"] <= own
    result: dict[str, Any] = {"recordings": len(rows), "not_answered": [r["name"] for r in rows if not r["answered"]]}
    result |= {"draws_excluded": sum(r["excluded"] for r in rows), "limit_at_equal_alarms": own}
    result["false_alarms"] = {h: _share(clean, "found", h) for h in _halls(clean)}
    for kind, asked in ASKED.items():
        of = [r for r in answered if r["kind"] == kind]
        result[kind] = {f"{h} {s}": _block([r for r in of if (r["hall"], r["strength"]) == (h, s)], asked)
                        for h, s in sorted({(r["hall"], r["strength"]) for r in of})}  # fmt: skip
    judged = [(ok, r["cluster"]) for r in answered if r["kind"] == "catalogued" for ok in r.get("parameters", [])]
    result["parameters_inside_95"] = share([ok for ok, _ in judged], [c for _, c in judged])
    result["reliability"] = reliability(answered)
    result["seconds"] = {
        h: float(np.median([r["seconds"] for r in answered if r["hall"] == h])) for h in _halls(answered)
    }
    return result


def _halls(rows: Sequence[Row]) -> list[str]:
    return sorted({r["hall"] for r in rows})


def _share(rows: Sequence[Row], key: str, hall: str = "") -> dict[str, Any]:
    own = [r for r in rows if r.get(key) is not None and hall in ("", r["hall"])]
    return share([bool(r[key]) for r in own], [r["cluster"] for r in own])


def _block(rows: Sequence[Row], asked: Sequence[str]) -> dict[str, Any]:
    named = [r for r in rows if r.get("named", r.get("unknown"))]
    block: dict[str, Any] = {key: _share(named if key == "place" else rows, key) for key in asked}
    known = [r for r in rows if r.get("error_um") is not None]
    clusters = [r["cluster"] for r in known]
    for name, error in (("targets", "error_um"), ("plain", "plain_um")):
        ratios = [r[error] / r["told_um"] for r in known]
        block[f"{name}_over_told"] = {str(q): quantile(ratios, clusters, q) for q in (0.5, 0.95)}
    block["worse_than_plain"] = share([r["error_um"] > WORSE * r["plain_um"] for r in known], clusters)
    block["told_worse_than_plain"] = share([r["told_um"] > WORSE * r["plain_um"] for r in known], clusters)
    return block


def reliability(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Each bin of the stated probability of findings: mean stated, share right with its interval, whether it holds."""
    stated = [(p, ok, r["cluster"]) for r in rows for p, ok in r["stated"]]
    found = []
    for low, high in pairwise(EDGES):
        inside = [s for s in stated if low <= s[0] and (s[0] < high or high == EDGES[-1])]
        if inside:
            mean = float(np.mean([p for p, _, _ in inside]))
            part = share([ok for _, ok, _ in inside], [c for _, _, c in inside])
            found.append(
                {"from": low, "to": high, "stated": mean, **part, "holds": part["low"] <= mean <= part["high"]}
            )
    return found


def write_report(entrants: dict[str, list[Row]], out: Path, head: dict[str, Any]) -> None:
    """scores.json, table.md, scores.svg."""
    out.mkdir(parents=True, exist_ok=True)
    summaries = {name: summarise(rows) for name, rows in entrants.items()}
    slim = {name: [{k: v for k, v in r.items() if k not in ("excluded", "cluster")} for r in rows]
            for name, rows in entrants.items()}  # fmt: skip
    (out / "scores.json").write_text(json.dumps(head | {"entrants": summaries}, indent=1) + "\n", encoding="utf-8")
    lines = (json.dumps({"entrant": name, **r}) for name, rows in slim.items() for r in rows)
    (out / "recordings.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (out / "table.md").write_text(table(summaries, head), encoding="utf-8")
    draw(summaries, entrants, out / "scores.svg")


def table(summaries: dict[str, dict[str, Any]], head: dict[str, Any]) -> str:
    """One table: a question a row, an entrant a column; intervals of 95 % that are clustered by law."""
    first = next(iter(summaries.values()))
    names = list(summaries)
    lines = [f"# {head['plan']}: {first['recordings']} recordings, {first['draws_excluded']} draws excluded", ""]
    lines += [
        f"Truth: sha256 {head['sha256']}",
        "",
        "| question | " + " | ".join(names) + " |",
        "|---" * (len(names) + 1) + "|",
    ]

    def row(question: str, cell: Callable[[dict[str, Any]], str]) -> None:
        lines.append(f"| {question} | " + " | ".join(cell(s) for s in summaries.values()) + " |")

    row("not answered", lambda s: str(len(s["not_answered"])))
    for hall in first["false_alarms"]:
        row(f"false alarms, {hall}", lambda s, h=hall: _counted(s["false_alarms"][h]))  # type: ignore[misc]
    for kind, asked in ASKED.items():
        for place in first[kind]:
            for key in (*asked, "worse_than_plain", "told_worse_than_plain"):
                said = f"{kind} {place}: {SAID.get(key, key.replace('_', ' '))}"
                row(said, lambda s, k=kind, p=place, q=key: _counted(s[k].get(p, {}).get(q, {})))  # type: ignore[misc]
            for name in ("targets", "plain"):
                said = f"{kind} {place}: error of {name} over told, median; 95 %"
                row(said, lambda s, k=kind, p=place, n=name: _ratio(s[k].get(p, {}).get(f"{n}_over_told")))  # type: ignore[misc]
    row("catalogued: parameters inside their 95 % intervals", lambda s: _counted(s["parameters_inside_95"]))
    for low, high in pairwise(EDGES):
        row(f"findings stated {low:g} to {high:g}: right; mean stated", lambda s, a=low: _bin(s["reliability"], a))  # type: ignore[misc]
    row("seconds a recording, median", lambda s: ", ".join(f"{h} {t:.1f}" for h, t in s["seconds"].items()))
    return "\n".join(lines) + "\n"


def _counted(r: dict[str, Any]) -> str:
    if not r.get("of"):
        return "–"
    return f"{r['right']} of {r['of']} ({100 * r['low']:.0f} to {100 * r['high']:.0f} %)"


def _ratio(r: dict[str, Any] | None) -> str:
    if not r or not r["0.5"]["of"]:
        return "–"
    return "; ".join(f"{q['value']:.2f} ({q['low']:.2f} to {q['high']:.2f})" for q in r.values())


def _bin(bins: Sequence[dict[str, Any]], low: float) -> str:
    found = next((b for b in bins if b["from"] == low), None)
    return f"{_counted(found)}; {found['stated']:.3f}{'' if found['holds'] else ' **no**'}" if found else "–"


def draw(summaries: dict[str, dict[str, Any]], entrants: dict[str, list[Row]], file: Path) -> None:
    """Power against strength, stated against right, errors of targets over those of somebody told the truth."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (power, stated, errors) = plt.subplots(1, 3, figsize=(15, 4.6), layout="constrained")
    for axes in (power, stated, errors):
        axes.set_prop_cycle(color=COLOURS)
    name, summary = next(iter(summaries.items()))
    wanted = (("catalogued", "found"), ("catalogued", "named"), ("unknown", "found"), ("unknown", "observable"),
              ("unknown", "covariates_or_outside"))  # fmt: skip
    for k, (kind, key) in enumerate(wanted):
        points = [(float(place.split()[1]) * 1.03 ** (k - 2), b[key]) for place, b in summary[kind].items()
                  if place.startswith("hall ") and b[key]["of"]]  # fmt: skip
        _bars(power, points, f"{kind}: {SAID.get(key, key).removeprefix('... and ')}")
    power.set(xscale="log", xlabel="strength: noncentrality left by least squares", ylabel="share", ylim=(0, 1.03))
    power.set_title(name)
    if power.has_data():
        power.legend(fontsize=8, loc="lower right")
    stated.plot([0, 1], [0, 1], color="0.6", lw=1, label="as stated")
    for who, s in summaries.items():
        if s["reliability"]:
            _bars(stated, [(b["stated"], b) for b in s["reliability"]], who)
    stated.set(xlabel="stated probability of a finding", ylabel="share that is right", xlim=(0, 1.03), ylim=(0, 1.03))
    stated.legend(fontsize=8, loc="upper left")
    for who, rows in entrants.items():
        ratios = np.sort([r["error_um"] / r["told_um"] for r in rows if r.get("error_um") and r["kind"] != "clean"])
        if len(ratios):
            errors.step(ratios, np.arange(1, len(ratios) + 1) / len(ratios), where="post", label=who)
    errors.set(
        xscale="log", xlabel="error of targets over that of somebody told the truth", ylabel="share of recordings"
    )
    errors.legend(fontsize=8, loc="lower right")
    figure.savefig(file, metadata={"Date": None})
    plt.close(figure)


def _bars(axes: Any, points: Sequence[tuple[float, dict[str, Any]]], label: str) -> None:
    if not points:
        return
    x, y = np.array([x for x, _ in points]), np.array([b["share"] for _, b in points])
    low, high = (np.array([b[key] for _, b in points]) for key in ("low", "high"))
    axes.errorbar(x, y, [np.maximum(y - low, 0), np.maximum(high - y, 0)], marker="o", ms=4, capsize=3, label=label)
