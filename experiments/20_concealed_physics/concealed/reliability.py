"""Are stated probabilities true? Of first findings stated with 0.9, nine of ten are to be right."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import binomtest

from ltsim.pages.style import MARKERS, new_figure, styled

from .score import Row

EDGES = (0.0, 0.5, 0.7, 0.9, 0.99, 1.0)
FLOOR = 1e-3
"""Least chance that a finding counts with in the log score: a certain error costs 6.9 nat, not infinity."""


def told(rows: Sequence[Row]) -> list[Row]:
    """Rows with a first finding that is stated with a probability."""
    return [r for r in rows if r["exit"] == 0 and r["first"] and np.isfinite(r["probability"])]


def reliability(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Each bin of the stated probability: how many, mean stated, right, and the 95 % interval of the share."""
    chosen, found = told(rows), []
    for low, high in pairwise(EDGES):
        last = high == EDGES[-1]
        inside = [r for r in chosen if low <= r["probability"] and (r["probability"] < high or last)]
        if not inside:
            continue
        right = sum(bool(r["right"]) for r in inside)
        interval = binomtest(right, len(inside)).proportion_ci(0.95)
        stated = float(np.mean([r["probability"] for r in inside]))
        row = {"low": low, "high": high, "of": len(inside), "right": right, "stated": stated}
        row |= {"least": interval.low, "most": interval.high, "holds": interval.low <= stated <= interval.high}
        found.append(row)
    return found


def log_score(rows: Sequence[Row]) -> float | None:
    """Mean of minus the log of the chance given to what was true [nat]; less is better."""
    chances = [r["probability"] if r["right"] else 1.0 - r["probability"] for r in told(rows)]
    return float(np.mean(-np.log(np.maximum(chances, FLOOR)))) if chances else None


def by_kind(rows: Sequence[Row]) -> dict[str, Any]:
    """Reliability and log score of each kind of recording, and of all."""
    found: dict[str, Any] = {}
    for kind in (*dict.fromkeys(r["kind"] for r in rows), "all"):
        own = [r for r in rows if kind in (r["kind"], "all")]
        if told(own):
            found[kind] = {"bins": reliability(own), "log_score": log_score(own)}
    return found


def lines(rows: Sequence[Row]) -> list[str]:
    """The table of a page."""
    made = ["", "Stated probabilities of first findings against the truth:", ""]
    made += [
        "| kind | stated | recordings | mean stated | right | 95 % interval | as stated | log score |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kind, block in by_kind(rows).items():
        for i, b in enumerate(block["bins"]):
            score = f"{block['log_score']:.2f}" if i == 0 else ""
            share = f"{b['right']} ({100 * b['right'] / b['of']:.0f} %)"
            holds = "yes" if b["holds"] else "no"
            interval = f"{100 * b['least']:.0f} to {100 * b['most']:.0f}"
            stated = f"{b['low']:g} to {b['high']:g} | {b['of']} | {b['stated']:.3f}"
            made.append(f"| {kind} | {stated} | {share} | {interval} | {holds} | {score} |")
    return made


@styled
def reliability_figure(rows: Sequence[Row]) -> Figure:
    """Share that is right against the stated probability, one line a kind."""
    figure = new_figure(4.0, width=5.0)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="0.6", label="as stated")
    for (kind, block), marker in zip(by_kind(rows).items(), MARKERS, strict=False):
        x = [b["stated"] for b in block["bins"]]
        y = np.array([b["right"] / b["of"] for b in block["bins"]])
        low, high = (np.array([b[k] for b in block["bins"]]) for k in ("least", "most"))
        axes.errorbar(x, y, [np.maximum(y - low, 0.0), np.maximum(high - y, 0.0)], marker=marker, capsize=3, label=kind)
    axes.set(
        xlabel="stated probability of the first finding", ylabel="share that is right", xlim=(0, 1.02), ylim=(0, 1.02)
    )
    axes.legend(loc="upper left", frameon=False)
    return figure
