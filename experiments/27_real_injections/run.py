"""Effects injected into real recordings of others: fractions detected, located and correctly reported.

    python -m experiments 27               # strength 100; continues an interrupted run
    python -m experiments 27 ideal         # the ideal observer on the same injections
    python -m experiments 27 estimated-noise    # strength 100, with the declared noise set to the estimated noise
    python -m experiments 27 strengths          # all strengths, and detection curves

Reads ../shared/recordings next to the checkout.
"""

from __future__ import annotations

import json
import time
from itertools import product
from pathlib import Path

import pandas as pd

import ltsim as lt
from experiments.common import (
    RECORDINGS as DATA,
    Options,
    Row,
    RunRecord,
    print_line,
    show_table,
    write_figure,
    write_table,
)
from experiments.intervals import proportion
from ltsim.core.errors import LtsimError, ModelError
from ltsim.core.parallel import run_parallel
from ltsim.diagnosis.schema import Finding
from ltsim.reports.figures.campaign import SweepPoint, sweep_panels_figure

from . import ideal
from .injections import background, injection, is_located, is_named_correctly, is_new, key

MEASURES = {"detected": "detected", "located": "correctly located", "reported": "correctly reported"}
DRAWN_MEASURES = (*MEASURES.values(), "reliability")
ESTIMATED_NOISE = "estimated-noise"
FINDING_COUNTS = ("new_findings", "findings_of_injection", "reworded_findings")
ROW_COLUMNS = ("site", "file", "kind", "strength", "trial", "hidden", *MEASURES, *FINDING_COUNTS)


def examined_injection(network: Row, kind: str, strength: float, trial: int, seed: int, estimates_noise: bool) -> Row:
    """Scored diagnosis of one injection; `hidden` if the network cannot show this kind of cause."""
    recording, _, before = background(network["file"], network.get("clockwise", False), estimates_noise)
    row = {"site": network["site"], "file": network["file"], "kind": kind, "strength": strength, "trial": trial}
    try:
        drawn, truth = injection(network, kind, strength, trial, seed, estimates_noise)
    except ModelError:
        return row | {"hidden": True}
    start, cause = time.perf_counter(), truth.injected_effects[0].effect
    try:
        findings = lt.diagnose(recording.with_readings(drawn.readings), held_out=False).findings
    except (ArithmeticError, ValueError, LtsimError) as error:  # a diagnosis that fails has detected nothing
        findings, row["failed"] = (), f"{type(error).__name__}: {error}"
    new_findings = [f for f in findings if is_new(f, before, strength)]
    at_place = [f for f in new_findings if is_located(cause, f.where, recording)]
    of_injection = [f for f in new_findings if f in at_place or is_named_correctly(cause, f)]
    reworded = [
        f
        for f in new_findings
        if f not in of_injection and any(f.effect == b.effect or key(f) == key(b) for b in before)
    ]
    where = " ".join([*cause.stations, *cause.targets])
    largest = truth.injected_effects[0].largest_changes
    return row | {
        "hidden": False, "where": where, "detected": bool(of_injection), "located": bool(at_place),
        "reported": any(is_named_correctly(cause, f) for f in at_place),
        **dict(zip(FINDING_COUNTS, map(len, (new_findings, of_injection, reworded)), strict=True)),
        "findings": "; ".join(finding_text(f) for f in new_findings),
        **{name: f"{size:.4g}" for name, size in largest.items()}, "seconds": f"{time.perf_counter() - start:.1f}",
    }  # fmt: skip


def finding_text(finding: Finding) -> str:
    """Name, stations and targets of a finding."""
    return " ".join([finding.effect, *finding.where.stations, *finding.where.targets])


def rates(rows: list[Row], strength: float | str, network: str) -> list[Row]:
    """Fractions of injections and of new findings, with 95 % intervals clustered by site."""
    outcomes = {label: [(r["site"], r[name]) for r in rows] for name, label in MEASURES.items()}
    new, of_injection, reworded = FINDING_COUNTS
    for label, excluded in (("reliability", ""), ("reliability without reworded findings", reworded)):
        counts = [(r["site"], r[of_injection], r[new] - r.get(excluded, 0)) for r in rows]
        outcomes[label] = [(site, k < right) for site, right, count in counts for k in range(count)]
    table = []
    for label, pairs in outcomes.items():
        interval = proportion([is_success for _, is_success in pairs], [site for site, _ in pairs])
        interval = {k: round(v, 3) if isinstance(v, float) else v for k, v in interval.items() if k != "clusters"}
        table.append({"network": network, "strength": strength, "measure": label} | interval)
    return table


def table_of(rows: list[Row], strengths: list[float]) -> list[Row]:
    """Rows of `table.csv`: all networks at each strength, then each network and each kind."""
    visible, table = [r for r in rows if not r["hidden"]], []
    for strength in (s for s in strengths if any(r["strength"] == s for r in visible)):
        table += rates([r for r in visible if r["strength"] == strength], strength, "all")
    for column in ("file", "kind"):
        for name in dict.fromkeys(r[column] for r in visible):
            group = [r for r in visible if r[column] == name]
            table += rates(group, strengths[0] if len(strengths) == 1 else "all", name)
    return table


def injected_rows(options: Options, settings: Row, estimates_noise: bool) -> list[Row]:
    """Rows of all injections, stored in one file for each batch, from which an interrupted run continues."""
    rows, start = [], time.perf_counter()
    (options.out / "rows").mkdir(parents=True, exist_ok=True)
    batches = product(range(options.trials or settings["trials"]), settings["strengths"], settings["network"])
    for trial, strength, network in batches:
        title = f"{network['site']}-{strength}-{trial}{'-estimated-noise' * estimates_noise}"
        file = options.out / "rows" / f"{title}.json"
        if not (DATA / network["file"]).exists():
            print_line(f"{title}: skipped, because {network['file']} does not exist")
            continue
        if not file.is_file():
            seed = settings["seed"]
            tasks = product([network], settings["kinds"], [float(strength)], [trial], [seed], [estimates_noise])
            file.write_text(
                json.dumps(list(run_parallel(examined_injection, list(tasks), options.jobs))), encoding="utf-8"
            )
        rows += (batch := json.loads(file.read_text(encoding="utf-8")))
        minutes = (time.perf_counter() - start) / 60
        print_line(f"{title}: {sum(not row['hidden'] for row in batch)} injections, {minutes:.1f} min")
    return rows


def run(options: Options) -> RunRecord:
    settings = options.config
    if "ideal" in options.arguments:
        networks = [network for network in settings["network"] if (DATA / network["file"]).exists()]
        answers = run_parallel(ideal.examined_network, [(n, settings) for n in networks], options.jobs)
        rows = [row for site_rows in answers for row in site_rows]
        write_table(options.out / "ideal.csv", rows)
        ltsim = pd.read_csv(options.out / "rows.csv").convert_dtypes().to_dict("records")
        show_table(options.out / "table_ideal.csv", ideal.table_of(rows, ltsim))
        return RunRecord(settings["seed"], options.trials)
    strengths = sorted(settings["strengths"]) if "strengths" in options.arguments else [100]
    ending = "".join(f"_{word.replace('-', '_')}" for word in options.arguments)
    rows = injected_rows(options, settings | {"strengths": strengths}, ESTIMATED_NOISE in options.arguments)
    table = table_of(rows, strengths)
    write_table(options.out / f"rows{ending}.csv", [{k: r.get(k, "") for k in ROW_COLUMNS} for r in rows])
    write_table(options.out / f"table{ending}.csv", table)
    if "strengths" in options.arguments:
        draw_curves(options.out, table)
    return RunRecord(settings["seed"], options.trials)


def draw_curves(out: Path, table: list[Row]) -> None:
    """Figure of the fractions over the strength, for all networks."""
    ends = ("proportion", "low", "high", "proportion", "proportion")
    rows = [r for r in table if r["network"] == "all" and r["strength"] != "all" and r["measure"] in DRAWN_MEASURES]
    curves = [SweepPoint(str(r["strength"]), r["measure"], "", *(100 * r[k] for k in ends)) for r in rows]
    axis = "noncentrality after the adjustment"
    title = "fraction of causes or of findings [%]"
    write_figure(out / "curves.svg", sweep_panels_figure(curves, statistic_title=title, x_title=axis))
