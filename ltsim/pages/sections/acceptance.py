"""What a report says of acceptance tests: the chance to pass or the verdict, every error over its limit."""

from __future__ import annotations

from pathlib import Path

from ltsim.acceptance.files import AcceptanceFile, passes_words
from ltsim.pages import style
from ltsim.pages.document import Block, Fact, Section, Table, mood, picture
from ltsim.pages.figures.acceptance import shares_of_limits
from ltsim.recording.result_file import read_result

LIKELY = 0.5
"""Chance to pass from which a prediction is good news."""
MOST_ROWS = 200
"""Tests in the table, the hardest first; accept.csv holds all."""


def acceptance_section(folder: Path) -> Section:
    """The section of a folder with `accept.json`; raises RecordError."""
    content = read_result(folder, AcceptanceFile)
    predicted = content.kind == "predicted"
    good = mood(content.passes >= (LIKELY if predicted else 1.0))
    caption = "Each test's error over its limit, with its expanded uncertainty; the limit is at ±1."
    blocks: list[Block] = [picture("Errors over limits", shares_of_limits(content), caption), _groups(content)]
    if content.sensitivities:
        blocks.append(_sensitivities(content))
    blocks.append(_tests(content))
    return Section(
        title=content.title or folder.name,
        kind="Acceptance",
        answer=content.sentence[:1].upper() + content.sentence[1:] + ".",
        mood=good,
        facts=[
            Fact("tests", str(len(content.tests))),
            Fact("chance to pass" if predicted else "passed", passes_words(content, content.passes), good),
            Fact("plan", content.plan),
            *([Fact("limits", content.specification.name)] if content.specification.name else []),
        ],
        blocks=blocks,
    )


def _groups(content: AcceptanceFile) -> Table:
    rows = [[g.name, str(g.tests), passes_words(content, g.passes)] for g in content.groups]
    note = f"assumed: {content.assumption}" if content.assumption else ""
    return Table("Groups", ["tests", "number", "all pass"], rows, text_columns=1, note=note)


def _sensitivities(content: AcceptanceFile) -> Table:
    rows = [
        [
            s.name,
            style.number(s.prior_sigma),
            "no test sees it" if s.smallest_failing is None else style.number(s.smallest_failing),
            style.unit_text(s.unit),
            s.test,
            "" if content.worst_passing is None else style.number(content.worst_passing.constants[s.name], 2),
        ]
        for s in content.sensitivities
    ]
    note = ""
    if content.worst_passing is not None:
        worst = content.worst_passing
        note = (
            f"The last column is an instrument that passes every test and places points 1.5 to 9 m away by "
            f"{worst.rms_um:.0f} µm (root mean square; {worst.largest_um:.0f} µm at most) off."
        )
    header = ["constant alone", "usual size", "fails from", "unit", "first failed test", "passes with"]
    return Table("What the tests see", header, rows, text_columns=1, note=note)


def _tests(content: AcceptanceFile) -> Table:
    predicted = content.kind == "predicted"
    ranked = sorted(content.tests, key=lambda t: (t.passes, -abs(t.error_um) / t.limit_um))[:MOST_ROWS]
    rows = [
        [
            t.name,
            style.fixed(t.error_um, 1),
            "–" if t.expanded_um is None else style.fixed(t.expanded_um, 1),
            style.fixed(t.limit_um, 1),
            passes_words(content, t.passes),
        ]
        for t in ranked
    ]
    marked = frozenset(i for i, t in enumerate(ranked) if not predicted and t.passes < 1)
    title = "Every test" if len(ranked) == len(content.tests) else f"The hardest {len(ranked)} of {len(content.tests)}"
    header = ["test", "error [µm]", "U [µm]", "limit [µm]", "passes"]
    return Table(title, header, rows, text_columns=1, marked=marked)
