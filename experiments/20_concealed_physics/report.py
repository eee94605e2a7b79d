"""Rows of answers as scores.json, one table and one figure, an entrant beside the other.

Shares and quantiles have 95 % intervals that know that recordings of one law are alike.
"""

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from .score import Row

RESAMPLES = 2000
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
DRAWN = ("catalogued", "found"), ("catalogued", "named"), ("unknown", "found"), ("unknown", "observable")
COLOURS = ("#1a5a96", "#b8470d", "#4a7c1f", "#6b4c9a", "#4a5056")


# intervals


def share(hits: Sequence[bool], clusters: Sequence[str]) -> dict[str, Any]:
    """How many are right, with the 95 % interval of Wilson for the effective number of independent recordings.

    The design effect is the variance between clusters over that of independent draws, between 1 and the mean size of
    a cluster; where all are right, or none, nothing tells it, and the number of clusters is taken.
    """
    n, k = len(hits), int(sum(hits))
    if not n:
        return {"right": 0, "of": 0}
    own = np.unique(clusters, return_inverse=True)[1]
    right, of = np.bincount(own, np.asarray(hits, dtype=np.float64)), np.bincount(own)
    c, p = len(of), k / n
    effect = n / c
    if 0 < k < n and c > 1:
        between = ((right - p * of) ** 2).sum() * c / (c - 1)
        effect = float(np.clip(between / (n * p * (1 - p)), 1.0, effect))
    m, z = n / effect, float(student.ppf(0.975, c - 1)) if c > 1 else 12.7
    middle = (p + z**2 / (2 * m)) / (1 + z**2 / m)
    half = z / (1 + z**2 / m) * np.sqrt(p * (1 - p) / m + (z / m) ** 2 / 4)
    low, high = float(max(middle - half, 0.0)), float(min(middle + half, 1.0))
    return {"right": k, "of": n, "laws": c, "share": p, "low": low, "high": high, "design_effect": effect}


def quantile(values: Sequence[float], clusters: Sequence[str], level: float) -> dict[str, Any]:
    """A quantile with its 95 % interval over resamples of whole clusters."""
    if not values:
        return {"of": 0}
    numbers, names = np.array(values), np.array(clusters)
    groups = [numbers[names == name] for name in np.unique(names)]
    rng = np.random.default_rng(0)
    drawn = [np.quantile(np.concatenate([groups[i] for i in rng.integers(0, len(groups), len(groups))]), level)
             for _ in range(RESAMPLES)]  # fmt: skip
    low, high = np.quantile(drawn, [0.025, 0.975])
    return {"value": float(np.quantile(values, level)), "low": float(low), "high": float(high), "of": len(values)}


# what is counted


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """All that the examination asks of one entrant."""
    answered = [r for r in rows if r["answered"]]
    clean = [r for r in answered if r["kind"] == "clean"]
    own = float(np.quantile([r["p_value"] for r in clean], LEVEL)) if len(clean) >= ENOUGH else None
    for r in answered:
        r["found_at_equal_alarms"] = None if own is None else r["p_value"] <= own
    halls = sorted({r["hall"] for r in answered})
    result: dict[str, Any] = {"recordings": len(rows), "not_answered": [r["name"] for r in rows if not r["answered"]]}
    result |= {"draws_excluded": sum(r["excluded"] for r in rows), "limit_at_equal_alarms": own}
    alarms = {h: _share([r for r in clean if r["hall"] == h], "found") for h in halls}
    result["false_alarms"] = {h: found for h, found in alarms.items() if found["of"]}
    for kind, asked in ASKED.items():
        of = [r for r in answered if r["kind"] == kind]
        result[kind] = {f"{h} {s}": _block([r for r in of if (r["hall"], r["strength"]) == (h, s)], asked)
                        for h, s in sorted({(r["hall"], r["strength"]) for r in of})}  # fmt: skip
    judged = [(ok, r["cluster"]) for r in answered if r["kind"] == "catalogued" for ok in r.get("parameters", [])]
    result["parameters_inside_95"] = share([ok for ok, _ in judged], [c for _, c in judged])
    result["reliability"] = _reliability(answered)
    result["seconds"] = {h: float(np.median([r["seconds"] for r in answered if r["hall"] == h])) for h in halls}
    return result


def _share(rows: Sequence[Row], key: str) -> dict[str, Any]:
    own = [r for r in rows if r.get(key) is not None]
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


def _reliability(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Each bin of the stated probability of findings: mean stated, share right with its interval, whether it holds."""
    stated = [(p, ok, r["cluster"]) for r in rows for p, ok in r["stated"]]
    found = []
    for low, high in pairwise(EDGES):
        inside = [s for s in stated if low <= s[0] and (s[0] < high or high == EDGES[-1])]
        if inside:
            mean = float(np.mean([p for p, _, _ in inside]))
            part = share([ok for _, ok, _ in inside], [c for _, _, c in inside])
            holds = part["low"] <= mean <= part["high"]
            found.append({"from": low, "to": high, "stated": mean, **part, "holds": holds})
    return found


# what is written


def write_report(entrants: dict[str, list[Row]], out: Path, head: dict[str, Any]) -> None:
    """scores.json, table.md, recordings.jsonl, scores.svg."""
    out.mkdir(parents=True, exist_ok=True)
    summaries = {name: summarise(rows) for name, rows in entrants.items()}
    lines = [json.dumps({"entrant": name} | {k: v for k, v in r.items() if k not in ("excluded", "cluster")})
             for name, rows in entrants.items() for r in rows]  # fmt: skip
    (out / "scores.json").write_text(json.dumps(head | {"entrants": summaries}, indent=1) + "\n", encoding="utf-8")
    (out / "recordings.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (out / "table.md").write_text(table(summaries, head), encoding="utf-8")
    draw(summaries, out / "scores.svg")


def table(summaries: dict[str, dict[str, Any]], head: dict[str, Any]) -> str:
    """One table: a question a row, an entrant a column; intervals of 95 % that are clustered by law."""
    first, columns = next(iter(summaries.values())), [_cells(s) for s in summaries.values()]
    lines = [f"# {head['plan']}: {first['recordings']} recordings, {first['draws_excluded']} draws excluded", ""]
    lines += [f"Truth: sha256 {head['sha256']}", "", "| question | " + " | ".join(summaries) + " |"]
    lines += ["|---" * (len(columns) + 1) + "|"]
    lines += [f"| {question} | " + " | ".join(c.get(question, "–") for c in columns) + " |" for question in columns[0]]
    return "\n".join(lines) + "\n"


def _cells(s: dict[str, Any]) -> dict[str, str]:
    """Every question with one entrant's answer."""
    said = {"not answered": str(len(s["not_answered"]))}
    said |= {f"false alarms, {hall}": _counted(found) for hall, found in s["false_alarms"].items()}
    for kind, asked in ASKED.items():
        for place, block in s[kind].items():
            for key in (*asked, "worse_than_plain", "told_worse_than_plain"):
                said[f"{kind} {place}: {SAID.get(key, key.replace('_', ' '))}"] = _counted(block[key])
            for name in ("targets", "plain"):
                ratios = [q for q in block[f"{name}_over_told"].values() if q["of"]]
                words = [f"{q['value']:.2f} ({q['low']:.2f} to {q['high']:.2f})" for q in ratios]
                said[f"{kind} {place}: error of {name} over told, median; 95 %"] = "; ".join(words) or "–"
    said["catalogued: parameters inside their 95 % intervals"] = _counted(s["parameters_inside_95"])
    bins = {b["from"]: f"{_counted(b)}; {b['stated']:.3f}{'' if b['holds'] else ' **no**'}" for b in s["reliability"]}
    said |= {f"findings stated {a:g} to {b:g}: right; mean stated": bins.get(a, "–") for a, b in pairwise(EDGES)}
    said["seconds a recording, median"] = ", ".join(f"{h} {t:.1f}" for h, t in s["seconds"].items())
    return said


def _counted(r: dict[str, Any]) -> str:
    return f"{r['right']} of {r['of']} ({100 * r['low']:.0f} to {100 * r['high']:.0f} %)" if r["of"] else "–"


def draw(summaries: dict[str, dict[str, Any]], file: Path) -> None:
    """Power of the first entrant against strength in small halls; stated against right of all."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (power, stated) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained", sharey=True)
    for axes in (power, stated):
        axes.set_prop_cycle(color=COLOURS)
    name, summary = next(iter(summaries.items()))
    for kind, key in (
        ("catalogued", "found"),
        ("catalogued", "named"),
        ("unknown", "found"),
        ("unknown", "observable"),
    ):
        blocks = {float(place.split()[1]): b[key] for place, b in summary[kind].items() if place.startswith("hall ")}
        _bars(power, {x: b for x, b in blocks.items() if b["of"]}, f"{kind}: {SAID.get(key, key).lstrip('. ')}")
    power.set(xscale="log", xlabel="strength: noncentrality left by least squares", ylabel="share", title=name)
    stated.plot([0, 1], [0, 1], color="0.6", lw=1, label="as stated")
    for who, s in summaries.items():
        _bars(stated, {b["stated"]: b for b in s["reliability"]}, who)
    stated.set(xlabel="stated probability of a finding", title="share that is right", ylim=(0, 1.03))
    for axes in (power, stated):
        axes.legend(fontsize=8, loc="best")
    figure.savefig(file, metadata={"Date": None})
    plt.close(figure)


def _bars(axes: Any, points: dict[float, dict[str, Any]], label: str) -> None:
    if points:
        low, y, high = (np.array([b[key] for b in points.values()]) for key in ("low", "share", "high"))
        gaps = np.maximum([y - low, high - y], 0)
        axes.errorbar(list(points), y, gaps, marker="o", ms=4, capsize=3, label=label)
