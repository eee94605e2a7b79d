"""Tables of an examination: what is counted, with its uncertainty."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest

from .reliability import by_kind, lines as reliability_lines
from .score import EXPLAINED, Row

WORSE = (
    "targets_worse_than_plain_by_5_percent",
    "told_the_truth_worse_than_plain_by_5_percent",
    "targets_worse_than_plain_and_than_told_by_5_percent",
)
"""The first is asked. The second is what chance does: noise may make a wrong model end nearer to the truth than the
right one. The third is what a better diagnosis could avoid."""
RATIOS = ("error_over_told_median", "error_over_told_90", "ordinary_over_told_median")


def rate(hits: Iterable[Any]) -> dict[str, Any]:
    """Count, share and its 95 % interval (Clopper-Pearson)."""
    values = [bool(h) for h in hits]
    if not values:
        return {"right": 0, "of": 0}
    k, n = sum(values), len(values)
    interval = binomtest(k, n).proportion_ci(0.95)
    return {"right": k, "of": n, "share": k / n, "low": interval.low, "high": interval.high}


def _answered(rows: Sequence[Row]) -> list[Row]:
    return [r for r in rows if r["exit"] == 0]


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """All that the examination asks, by kind and strength."""
    by = {k: [r for r in rows if r["kind"] == k] for k in ("clean", "single", "unknown", "pair", "mistake")}
    result: dict[str, Any] = {
        "recordings": {k: len(v) for k, v in by.items()},
        "crashed": [r["name"] for r in rows if r["exit"] not in (0, 2)],
        "refused": [f"{r['name']}: {r['complaint'].strip()}" for r in rows if r["exit"] == 2],
        "seconds": {q: _quantile([r["seconds"] for r in rows], p) for q, p in (("median", 50), ("largest", 100))},
    }
    clean = _answered(by["clean"])
    result["false_alarms"] = rate(r["found"] for r in clean)
    for level in (0.01, 0.1, 0.2):
        result[f"clean_p_below_{level}"] = rate(r["search_p_value"] < level for r in clean)
    for strength in sorted({r["strength"] for r in by["single"]}):
        result[f"single_{strength}"] = _single([r for r in by["single"] if r["strength"] == strength])
    for strength in sorted({r["strength"] for r in by["unknown"]}):
        result[f"unknown_{strength}"] = _unknown([r for r in by["unknown"] if r["strength"] == strength])
    for strength in sorted({r["strength"] for r in by["pair"]}):
        chosen = _answered([r for r in by["pair"] if r["strength"] == strength])
        result[f"pair_{strength}"] = {
            "both_named_first": rate(r["pair_named"] == 2 for r in chosen),
            "both_named_or_stated": rate(r["pair_stated"] == 2 for r in chosen),
            "one_at_least": rate(r["pair_stated"] >= 1 for r in chosen),
            **_errors(chosen),
        }
    result |= {question: block for question, block in _errors(_answered(rows)).items() if question in WORSE}
    result["excluded_draws"] = dict(sum((Counter(json.loads(r.get("excluded", "{}"))) for r in rows), Counter[str]()))
    result["reliability"] = by_kind(rows)
    if by["mistake"]:
        result["mistakes"] = _single(by["mistake"])
    return result


def _single(rows: Sequence[Row]) -> dict[str, Any]:
    chosen = _answered(rows)
    named = [r for r in chosen if r["named"]]
    estimated = [r for r in chosen if r.get("parameters")]
    covered = sum(r["covered"] for r in estimated)
    return {
        "found": rate(r["found"] for r in chosen),
        "named_first": rate(r["named_first"] for r in chosen),
        "named": rate(r["named"] for r in chosen),
        "place_of_named": rate(r["right_place"] for r in named),
        "parameters_covered": rate([True] * covered + [False] * (sum(r["parameters"] for r in estimated) - covered)),
        "further_findings": rate(r["also_found"] > 0 for r in chosen),
        **_errors(chosen),
    }


def _unknown(rows: Sequence[Row]) -> dict[str, Any]:
    chosen = _answered(rows)
    own = [r for r in chosen if r["strength"] * (1 - r["nearest_share"]) > 20.0]
    return {
        "found": rate(r["found"] for r in chosen),
        "called_unknown": rate(r["called_unknown"] for r in chosen),
        "and_observable_right": rate(r["observable_right"] for r in chosen),
        "and_covariate_right": rate(r.get("right_covariates", False) for r in chosen),
        **{f"and_{what}": rate(r[what] for r in chosen if what in r) for what in EXPLAINED},
        "told_as_one_finding": rate(r["told_as_one"] for r in chosen),
        "wrong_name_above_0.9": rate(r["wrong_name"] for r in chosen),
        "distinct_from_catalogue": {
            "and_observable_right": rate(r["observable_right"] for r in own),
            "wrong_name_above_0.9": rate(r["wrong_name"] for r in own),
        },
        **_errors(chosen),
    }


def _errors(rows: Sequence[Row]) -> dict[str, Any]:
    """Target errors against the adjustment that was told the truth, and held-out errors."""
    usable = [r for r in rows if np.isfinite(r["told_um"]) and np.isfinite(r["error_um"])]
    ratio = [r["error_um"] / r["told_um"] for r in usable]
    ordinary = [r["ordinary_um"] / r["told_um"] for r in usable]
    worse = [r["held_out_after"] > r["held_out_before"] * (1 + 1e-6) for r in rows if r["answer"]]
    return {
        "error_over_told_median": _quantile(ratio, 50),
        "error_over_told_90": _quantile(ratio, 90),
        "ordinary_over_told_median": _quantile(ordinary, 50),
        "held_out_worse": rate(worse),
        WORSE[0]: rate(r["error_um"] > 1.05 * r["ordinary_um"] for r in usable),
        WORSE[1]: rate(r["told_um"] > 1.05 * r["ordinary_um"] for r in usable),
        WORSE[2]: rate(r["error_um"] > 1.05 * max(r["ordinary_um"], r["told_um"]) for r in usable),
    }


def _quantile(values: Sequence[float], percent: float) -> float | None:
    known = [v for v in values if np.isfinite(v)]
    return float(np.percentile(known, percent)) if known else None


def confusion(rows: Sequence[Row]) -> list[tuple[str, int, int, int, str]]:
    """(truth, recordings, named first, named or stated, the other first names with their counts)."""
    chosen = [r for r in _answered(rows) if r["kind"] in ("single", "mistake")]
    table = []
    for truth in sorted({r["truth"] for r in chosen}):
        own = [r for r in chosen if r["truth"] == truth]
        wrong = Counter(r["first"] or "nothing" for r in own if not r["named_first"])
        words = ", ".join(f"{name} {count}" for name, count in wrong.most_common())
        table.append((truth, len(own), sum(r["named_first"] for r in own), sum(r["named"] for r in own), words))
    return table


def markdown(rows: Sequence[Row], summary: dict[str, Any], command: str) -> str:
    """The tables a person reads."""
    counts = ", ".join(f"{n} {k}" for k, n in summary["recordings"].items() if n)
    lines = ["# Concealed physics", "", f"Made by `{command}`: {counts}.", ""]
    left_out = [f"{n} refused"] if (n := len(summary["refused"])) else []
    left_out += [f"{n} crashed"] if (n := len(summary["crashed"])) else []
    left_out += [f"{n} draws thrown away: {why}" for why, n in summary["excluded_draws"].items()]
    lines += [f"Left out: {'; '.join(left_out) or 'nothing'}.", ""]
    lines += ["| question | strength | right | of | share | 95 % interval |", "|---|---|---|---|---|---|"]
    lines.append(_line("false alarm at the 5 % level (clean)", "", summary["false_alarms"]))
    lines += [_line(f"all: {question.replace('_', ' ')}", "", summary[question]) for question in WORSE]
    for key, block in summary.items():
        kind, _, strength = key.partition("_")
        if kind in ("single", "unknown", "pair", "mistakes") and isinstance(block, dict):
            lines += [_line(f"{kind}: {q.replace('_', ' ')}", strength, r) for q, r in block.items() if _is_rate(r)]
            for q, r in block.get("distinct_from_catalogue", {}).items():
                lines.append(_line(f"{kind}, distinct from the catalogue: {q.replace('_', ' ')}", strength, r))
    lines += ["", "Errors of the targets over those of an adjustment that was told the truth:", ""]
    lines += ["| kind | strength | median | 90 % | ordinary adjustment, median |", "|---|---|---|---|---|"]
    for key, block in summary.items():
        if isinstance(block, dict) and "error_over_told_median" in block:
            kind, _, strength = key.partition("_")
            words = ["" if block[k] is None else f"{block[k]:.2f}" for k in RATIOS]
            lines.append(f"| {kind} | {strength} | " + " | ".join(words) + " |")
    lines += reliability_lines(rows)
    lines += ["", "| effect | recordings | named first | named or stated | other first names |"]
    lines.append("|---|---|---|---|---|")
    lines += [f"| {t} | {n} | {a} | {b} | {w} |" for t, n, a, b, w in confusion(rows)]
    return "\n".join(lines) + "\n"


def _is_rate(block: Any) -> bool:
    return isinstance(block, dict) and "of" in block


def _line(question: str, strength: str, r: dict[str, Any]) -> str:
    if not r["of"]:
        return f"| {question} | {strength} | 0 | 0 | | |"
    interval = f"{100 * r['low']:.1f} to {100 * r['high']:.1f}"
    return f"| {question} | {strength} | {r['right']} | {r['of']} | {100 * r['share']:.1f} % | {interval} |"
