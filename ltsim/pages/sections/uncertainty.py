"""What a report says of tasks: how well each result is known, why, and whether it conforms."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ltsim.pages import style
from ltsim.pages.document import Block, Fact, Points, Section, Table, mood, picture
from ltsim.pages.figures.budget import budget
from ltsim.pages.words import count, listing
from ltsim.recording.result_file import read_result
from ltsim.tasks.files import Result, UncertaintyFile

MOST_BARS = 40
"""Results in one picture; the tables hold all."""


def uncertainty_section(folder: Path) -> Section:
    """The section of a folder with `uncertainty.json`; raises RecordError."""
    content = read_result(folder, UncertaintyFile)
    failed = [r for r in content.results if r.conformity is not None and r.conformity.judgement == "rejected"]
    blocks: list[Block] = [_results(content), *_conformity(content), *_budget(content)]
    if content.warnings:
        blocks.append(Points("What to mind", content.warnings))
    return Section(
        title=content.title or folder.name,
        kind="Uncertainty",
        answer=_answer(content),
        mood=mood(not failed),
        facts=[
            Fact("results", str(len(content.results))),
            Fact("coverage", f"{100 * content.coverage:g} %"),
            Fact("trials", f"{content.trials:,}".replace(",", " ")),
            *([] if content.sigma0 is None else [Fact("σ0 of the adjustment", style.number(content.sigma0, 3))]),
        ],
        blocks=blocks,
    )


def _answer(content: UncertaintyFile) -> str:
    judged = [r for r in content.results if r.conformity is not None]
    parts = []
    for word in ("accepted", "rejected", "undecided"):
        mine = [f"{r.task}, {r.name}" for r in judged if r.conformity and r.conformity.judgement == word]
        if mine:
            parts.append(f"{word}: {listing(mine)}" if len(mine) <= 3 else f"{word}: {count(len(mine), 'result')}")
    if parts:
        return "; ".join(parts) + "."
    first = content.results[0]
    value = f"{style.fixed(first.value, 4)} ± {style.number(first.expanded_uncertainty, 2)} {first.unit}".strip()
    return f"{first.task}, {first.name}: {value} ({100 * content.coverage:g} %)."


def _results(content: UncertaintyFile) -> Table:
    rows = []
    for r in content.results:
        digits = _decimals(r.expanded_uncertainty)
        low, high = r.monte_carlo.symmetric
        top = r.budget[0] if r.budget else None
        rows.append(
            [
                r.task,
                r.name,
                f"{r.value:.{digits}f}",
                f"{r.expanded_uncertainty:.{digits}f}",
                f"{low:.{digits}f} to {high:.{digits}f}" + ("" if r.monte_carlo.agrees else " *"),
                r.unit,
                f"{top.source} ({100 * top.share:.0f} %)" if top else "",
            ]
        )
    note = "* the distribution is not that of the linear propagation: take its interval (JCGM 101, clause 8)"
    header = ["task", "result", "value", "U", "Monte Carlo interval", "unit", "improve first"]
    marked = any(not r.monte_carlo.agrees for r in content.results)
    return Table(f"Results in {content.frame}", header, rows, text_columns=2, note=note if marked else "")


def _decimals(sigma: float) -> int:
    """Decimals that show two digits of an uncertainty."""
    decimals = 0
    while 0 < sigma * 10**decimals < 9.5 and decimals < 10:
        decimals += 1
    return decimals


def _conformity(content: UncertaintyFile) -> list[Block]:
    rows = []
    for r in content.results:
        c = r.conformity
        if c is not None:
            limits = ["" if x is None else style.number(x, 6) for x in (c.lower, c.upper)]
            figures = [style.number(c.guard_band, 2), f"{c.probability:.4f}", c.judgement, f"{c.wrong:.2g}"]
            rows.append([r.task, r.name, *limits, r.unit, *figures])
    if not rows:
        return []
    header = ["task", "result", "lower", "upper", "unit", "guard band", "conforms", "judgement", "wrong"]
    note = "conforms, wrong: probabilities that the true value conforms, and that the judgement is wrong (JCGM 106)"
    return [Table("Conformity", header, rows, text_columns=2, note=note)]


def _budget(content: UncertaintyFile) -> list[Block]:
    shown: Sequence[Result] = content.results[:MOST_BARS]
    sources = dict.fromkeys(part.source for r in shown for part in r.budget)
    shares = {name: [next((p.share for p in r.budget if p.source == name), 0.0) for r in shown] for name in sources}
    figure = budget([f"{r.task}, {r.name}" for r in shown], shares)
    rows = [
        [r.task, r.name, p.source, p.type, style.number(p.standard_uncertainty, 2), r.unit, f"{100 * p.share:.1f}"]
        for r in content.results
        for p in r.budget
        if p.share >= 0.001
    ]
    header = ["task", "result", "source", "type", "u", "unit", "share of the variance [%]"]
    return [
        picture("Budget", figure, "Where each result's variance comes from; the widest bar is what to improve first."),
        Table("Budget", header, rows, text_columns=3),
    ]
