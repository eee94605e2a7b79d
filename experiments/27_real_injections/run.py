"""Causes put into real recordings of others: what share is found, placed and told rightly, and what is told falsely.

    python -m experiments 27               # strength 100; goes on where it was broken off
    python -m experiments 27 ideal         # the ideal observer on the same injections
    python -m experiments 27 told-noise    # strength 100, the noise that the readings have being stated
    python -m experiments 27 strengths     # all strengths, and the curves over them

Reads ../shared/recordings beside the checkout; writes figures found.
"""

from __future__ import annotations

import json
import time
from itertools import product
from pathlib import Path

import pandas as pd

import ltsim as lt
from experiments.common import RECORDINGS as DATA, Made, Options, Row, show_table, tell, write_figure, write_table
from experiments.intervals import share
from ltsim.core.errors import LtsimError, ModelError
from ltsim.core.parallel import run_parallel
from ltsim.reports.figures.campaign import SweepPoint, sweep_panels_figure

from . import ideal
from .injections import background, injection, key, named, new, placed

MEASURES = {"found": "found", "placed": "place right", "right": "told rightly"}
DRAWN = (*MEASURES.values(), "reliability")
COUNTED = ("site", "file", "kind", "strength", "trial", "hidden", *MEASURES, "new", "injected", "retold")


def one(network: Row, kind: str, strength: float, trial: int, seed: int, told_noise: bool) -> Row:
    """One injection, diagnosed once by the default settings; `hidden` where the network shows no such cause."""
    recording, _, before = background(network["file"], network.get("clockwise", False), told_noise)
    row = {"site": network["site"], "file": network["file"], "kind": kind, "strength": strength, "trial": trial}
    try:
        drawn, truth = injection(network, kind, strength, trial, seed, told_noise)
    except ModelError:
        return row | {"hidden": True}
    start, cause = time.perf_counter(), truth.injected_effects[0].effect
    try:
        told = lt.diagnose(recording.with_readings(drawn.readings), held_out=False).findings
    except (ArithmeticError, ValueError, LtsimError) as error:  # a diagnosis that breaks down has found nothing
        told, row["failed"] = (), f"{type(error).__name__}: {error}"
    fresh = [f for f in told if new(f, before, strength)]
    here = [f for f in fresh if placed(cause, f.where, recording)]
    mine = [f for f in fresh if f in here or named(cause, f)]
    again = [f for f in fresh if f not in mine and any(f.effect == b.effect or key(f) == key(b) for b in before)]
    where = " ".join([*cause.stations, *cause.targets])
    largest = truth.injected_effects[0].largest_changes
    return row | {
        "hidden": False, "where": where, "found": bool(mine), "placed": bool(here),
        "right": any(named(cause, f) for f in here), "new": len(fresh), "injected": len(mine), "retold": len(again),
        "told": "; ".join(f"{f.effect} {' '.join((*f.where.stations, *f.where.targets))}".strip() for f in fresh),
        **{name: f"{size:.4g}" for name, size in largest.items()}, "seconds": f"{time.perf_counter() - start:.1f}",
    }  # fmt: skip


def rates(rows: list[Row], strength: float | str, network: str) -> list[Row]:
    """Completeness by injections and reliability by findings, with 95 % intervals that know the sites."""
    asked = {label: [(r["site"], r[name]) for r in rows] for name, label in MEASURES.items()}
    for label, known in (("", ""), (", without what was told before in other words", "retold")):
        told = [(r["site"], k < r["injected"]) for r in rows for k in range(r["new"] - r.get(known, 0))]
        asked[f"reliability{label}"] = told
    found = []
    for label, answers in asked.items():
        own = share([hit for _, hit in answers], [site for site, _ in answers])
        own = {k: round(v, 3) if isinstance(v, float) else v for k, v in own.items() if k != "laws"}
        found.append({"network": network, "strength": strength, "measure": label} | own)
    return found


def table_of(rows: list[Row], strengths: list[float]) -> list[Row]:
    """All networks by strength, then each network and each kind."""
    seen, found = [r for r in rows if not r["hidden"]], []
    for strength in (s for s in strengths if any(r["strength"] == s for r in seen)):
        found += rates([r for r in seen if r["strength"] == strength], strength, "all")
    for column in ("file", "kind"):
        for name in dict.fromkeys(r[column] for r in seen):
            some = [r for r in seen if r[column] == name]
            found += rates(some, strengths[0] if len(strengths) == 1 else "all", name)
    return found


def injected(given: Options, settings: Row, told_noise: bool) -> list[Row]:
    """Rows of all injections, a batch a file; a run that was broken off goes on from them."""
    rows, start = [], time.perf_counter()
    (given.out / "rows").mkdir(parents=True, exist_ok=True)
    batches = product(range(given.trials or settings["trials"]), settings["strengths"], settings["network"])
    for trial, strength, network in batches:
        said = f"{network['site']}-{strength}-{trial}{'-told' * told_noise}"
        kept = given.out / "rows" / f"{said}.json"
        if not (DATA / network["file"]).exists():
            tell(f"{said}: left out, {network['file']} is not there")
            continue
        if not kept.is_file():
            seed = settings["seed"]
            tasks = product([network], settings["kinds"], [float(strength)], [trial], [seed], [told_noise])
            kept.write_text(json.dumps(list(run_parallel(one, list(tasks), given.jobs))), encoding="utf-8")
        rows += (own := json.loads(kept.read_text(encoding="utf-8")))
        minutes = (time.perf_counter() - start) / 60
        tell(f"{said}: {sum(not row['hidden'] for row in own)} injections, {minutes:.1f} min")
    return rows


def run(given: Options) -> Made:
    settings = given.config
    if "ideal" in given.words:
        networks = [network for network in settings["network"] if (DATA / network["file"]).exists()]
        asked = run_parallel(ideal.asked, [(n, settings) for n in networks], given.jobs)
        rows = [row for some in asked for row in some]
        write_table(given.out / "ideal.csv", rows)
        ltsim = pd.read_csv(given.out / "rows.csv").convert_dtypes().to_dict("records")
        show_table(given.out / "table_ideal.csv", ideal.table_of(rows, ltsim))
        return Made(settings["seed"], given.trials)
    strengths = sorted(settings["strengths"]) if "strengths" in given.words else [100]
    ending = "".join(f"_{word.replace('-', '_')}" for word in given.words)
    rows = injected(given, settings | {"strengths": strengths}, "told-noise" in given.words)
    table = table_of(rows, strengths)
    write_table(given.out / f"rows{ending}.csv", [{k: r.get(k, "") for k in COUNTED} for r in rows])
    write_table(given.out / f"table{ending}.csv", table)
    if "strengths" in given.words:
        draw_curves(given.out, table)
    return Made(settings["seed"], given.trials)


def draw_curves(out: Path, table: list[Row]) -> None:
    """Shares of all networks over strength."""
    ends = ("share", "low", "high", "share", "share")
    curves = [SweepPoint(str(r["strength"]), r["measure"], "", *(100 * r[k] for k in ends))
              for r in table if r["network"] == "all" and r["strength"] != "all" and r["measure"] in DRAWN]  # fmt: skip
    axis = "noncentrality after the adjustment"
    title = "share of causes, of findings [%]"
    write_figure(out / "curves.svg", sweep_panels_figure(curves, statistic_title=title, x_title=axis))
