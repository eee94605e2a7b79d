"""What a report says of a check in the field: go or no-go, and every test behind it."""

from __future__ import annotations

from pathlib import Path

from ltsim.chances import p_text
from ltsim.fieldcheck.files import CheckFile
from ltsim.pages.document import Block, Fact, Picture, Section, Table, mood
from ltsim.pages.style import svg_text_uri
from ltsim.recording.result_file import companion, read_result

PICTURES = ("check.svg", "check-narrow.svg")
"""For a page, and for a phone."""


def check_section(folder: Path) -> Section:
    """The section of a folder with `check.json` (and its picture); raises RecordError."""
    content = read_result(folder, CheckFile)
    rows = [
        [item.station or "all", item.kind, "ok" if item.passed else "no-go", item.sentence, p_text(item.p_value)]
        for item in content.items
    ]
    blocks: list[Block] = []
    drawn = [companion(folder, name, content) for name in PICTURES]
    wide, small = (svg_text_uri(f.read_text(encoding="utf-8")) if f is not None else "" for f in drawn)
    if wide:
        caption = "Above: half two-face differences over their limits. Below: what each pointing misses over time."
        blocks.append(Picture("At a glance", wide, caption, small))
    marked = frozenset(i for i, item in enumerate(content.items) if not item.passed)
    header = ["station", "test", "", "what was found", "p"]
    blocks.append(Table("Every test", header, rows, text_columns=4, marked=marked))
    failed = sum(not item.passed for item in content.items)
    return Section(
        title=folder.name,
        kind="Check",
        answer=content.sentence + ".",
        mood=mood(content.passed),
        facts=[
            Fact("verdict", "go" if content.passed else "no-go", mood(content.passed)),
            Fact("tests", str(len(content.items))),
            Fact("against going on", str(failed), mood(not failed)),
        ],
        blocks=blocks,
    )
