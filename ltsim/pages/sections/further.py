"""What a report says of `plan --after`: what to measure next, and what each proposal is worth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ltsim.pages import style
from ltsim.pages.document import Block, Fact, Mood, Note, Section, Table, mood
from ltsim.pages.words import duration
from ltsim.planning.schema import NextFile, ProposalEntry
from ltsim.recording.result_file import read_result

SHOWN = 10


def next_section(folder: Path) -> Section:
    """The section of a folder with `next.json`; raises RecordError."""
    content = read_result(folder, NextFile)
    best = content.proposals[0]
    facts = [Fact("time for it", duration(60 * best.minutes)), Fact("instrument sharper by", _percent(best.sharper))]
    if content.between:
        facts.append(Fact("decides", "yes" if best.decides else "no", mood(best.decides)))
    facts.append(Fact("proposals", str(len(content.proposals))))
    blocks: list[Block] = [_table("Further measurements, the best first", content.proposals[:SHOWN])]
    if content.between:
        blocks.append(_evidence(content))
    if content.diagnosis:
        blocks.append(Note("What the diagnosis of the recording said", content.diagnosis))
    if len(content.proposals) > SHOWN:
        blocks.append(_table("All further proposals", content.proposals[SHOWN:]))
    return Section(folder.name, "Next measurement", _answer(content), _mood(content), facts, blocks)


def _mood(content: NextFile) -> Mood:
    return mood(content.proposals[0].decides) if content.between else "plain"


def _percent(factor: float) -> str:
    """What a factor on a standard deviation takes off it."""
    return f"{100 * (1 - factor):.0f} %"


def _answer(content: NextFile) -> str:
    """The first sentence."""
    best = content.proposals[0]
    if content.between and content.advice:
        return f"{content.advice[0].upper()}{content.advice[1:]}."
    begin = f"Measure next: {best.do} ({duration(60 * best.minutes)})"
    return (
        f"{begin}; the instrument's parameters become {_percent(best.sharper)} sharper on average, "
        f"{best.serves} by {_percent(best.serves_factor)}."
    )


def _table(title: str, proposals: Sequence[ProposalEntry]) -> Table:
    """Some proposals."""
    rows = [
        [
            p.do, f"{p.minutes:.0f}", _percent(p.sharper), f"{p.serves} ({_percent(p.serves_factor)})",
        ]
        for p in proposals
    ]  # fmt: skip
    header = ["do", "time [min]", "sharper by", "most for"]
    note = "'Sharper' is the mean fall of the standard deviations of the instrument's parameters."
    return Table(title, header, rows, 1, note)


def _evidence(content: NextFile) -> Table:
    """Chi-square between the explanations, now and after each proposal."""
    rivals = content.between[1:]
    now = ["as it is now", *(style.fixed(content.evidence_now.get(name, 0.0), 1) for name in rivals), "–"]
    rows = [now] + [
        [p.do, *(style.fixed(p.evidence.get(name, 0.0), 1) for name in rivals), "yes" if p.decides else "no"]
        for p in content.proposals
        if p.evidence
    ]
    header = ["measurement", *(f"χ² against {name}" for name in rivals), "decides"]
    note = f"The larger, the more surely {content.between[0]} is told from it."
    return Table("What would decide", header, rows, 1, note)
