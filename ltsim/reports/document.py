"""Report as data: sections of facts, tables, pictures and a scene, rendered to HTML or text.

Pictures are drawn only when HTML is written.
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ltsim.core import results
from ltsim.core.descriptions import descriptions
from ltsim.core.notation import MISSING_TEXT, align_columns, number_text
from ltsim.recordings import Recording
from ltsim.recordings.result_file import ResultFile, companion_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CONTENT_SECURITY_POLICY = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline' blob:; worker-src blob:; connect-src data: blob:; frame-src 'self'"
)
"""Content Security Policy of a page: no external resources."""
Mood = Literal["good", "bad", "plain"]
Detail = Literal["turn", "plan", "none"]
"""View of the workshop in a section: interactive 3D, floor plan only, or none if another section shows it."""
FOLDED_ROWS = 30
UNPRINTED_ROWS = 120
"""Number of rows above which a table is folded, and above which it is not printed (three pages)."""
TERMINAL_ROWS = 8
TERMINAL_WIDTH = 160
"""Number of rows of a folded table on a terminal, and largest width of a table there [characters]."""


@dataclass(frozen=True)
class ReportContext:
    """Folder and recording of a result, and the level of detail of its section.

    A `brief` section leaves residuals to another one.
    """

    folder: Path | None = None
    recording: Recording | None = None
    detail: Detail = "none"
    brief: bool = False

    def file(self, name: str, content: ResultFile) -> Path | None:
        """Companion file of a result; None if it does not exist; raises RecordError if it belongs to another result."""
        return None if self.folder is None else companion_path(self.folder, name, content)


def mood(good: bool) -> Mood:
    """Mood `good` or `bad` for a flag."""
    return "good" if good else "bad"


@dataclass(frozen=True)
class Fact:
    """Key figure of a section."""

    name: str
    value: str
    mood: Mood = "plain"


@dataclass(frozen=True)
class TableBlock:
    """Table of texts; the first `text_columns` columns are flush left; `meanings` explain the header."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    text_columns: int = 1
    note: str = ""
    marked: frozenset[int] = frozenset()
    meanings: Sequence[str] = ()
    folds: bool = True
    """True if the table is folded when it is long; False for a table that is the product."""
    kind: Literal["table"] = "table"

    @property
    def endless(self) -> bool:
        """True if the table is too long to print."""
        return len(self.rows) > UNPRINTED_ROWS

    @property
    def long(self) -> bool:
        """True if the table starts folded."""
        return len(self.rows) > FOLDED_ROWS and self.folds


@dataclass(frozen=True)
class Picture:
    """Figure or SVG with a caption, which is also its alternative text; drawn on first use."""

    title: str
    draw: Callable[[], Figure | str]
    caption: str
    kind: Literal["picture"] = "picture"

    @cached_property
    def uri(self) -> str:
        """Picture as a `data:` URI."""
        from ltsim.reports.style import svg, svg_uri

        drawn = self.draw()
        return svg_uri(drawn if isinstance(drawn, str) else svg(drawn))


@dataclass(frozen=True)
class Scene:
    """3D view: a picture, and the interactive page that it opens."""

    title: str
    image: str
    caption: str
    page: str
    kind: Literal["scene"] = "scene"

    @property
    def packed(self) -> str:
        """Interactive page as gzip in base64, unpacked by the browser."""
        return base64.b64encode(gzip.compress(self.page.encode(), mtime=0)).decode()


@dataclass(frozen=True)
class Note:
    """Paragraph with a heading."""

    title: str
    text: str
    mood: Mood = "plain"
    kind: Literal["note"] = "note"


@dataclass(frozen=True)
class CodeBlock:
    """Preformatted text, such as settings; folded."""

    title: str
    text: str
    kind: Literal["listing"] = "listing"


@dataclass(frozen=True)
class BulletList:
    """Bullet list of sentences."""

    title: str
    lines: Sequence[str]
    kind: Literal["points"] = "points"


Block = BulletList | TableBlock | Picture | Scene | Note | CodeBlock


@dataclass(frozen=True)
class Section:
    """Section of a page: one result of one folder; `answer` is its first sentence.

    `notice` comes before the answer and states that the data are simulated.

    `title` is the title of a page with this section alone; `kind` and `folder` are its heading among others. The first
    `shown` blocks are open, the others are details; the first `lead` blocks are side by side at the head of the page. A
    terminal prints the first `terminal_blocks`, or all.
    """

    title: str
    kind: str
    answer: str
    mood: Mood = "plain"
    facts: Sequence[Fact] = ()
    blocks: Sequence[Block] = ()
    folder: str = ""
    actions: Sequence[str] = ()
    seed: str = ""
    versions: Sequence[tuple[str, str]] = ()
    axes: str = ""
    instrument: str = ""
    measured: str = ""
    shown: int = 3
    lead: int = 0
    terminal_blocks: int | None = None
    notice: str = ""

    def text(self) -> str:
        """Text for a terminal: answer, facts, sentences, tables, next actions."""
        facts = "; ".join(f"{fact.name}: {fact.value}" for fact in self.facts)
        parts = [self.notice, self.answer, facts, *map(_as_text, self.blocks[: self.terminal_blocks])]
        parts += ["\n".join(["What to do next:", *(f"- {line}" for line in self.actions)])] if self.actions else []
        return "\n\n".join(filter(None, parts))


@dataclass(frozen=True)
class Document:
    """Content of the page: header lines, headline `verdict`, sentence `answer`, next actions, sections."""

    title: str
    answer: str
    mood: Mood
    sections: Sequence[Section] = ()
    versions: Sequence[tuple[str, str]] = ()
    about: Sequence[tuple[str, str]] = ()
    verdict: str = ""
    actions: Sequence[str] = ()
    notice: str = ""


def _as_text(block: Block) -> str:
    """Text of a block for a terminal; empty for pictures and settings."""
    match block:
        case Note():
            return f"{block.title}: {block.text}" if block.title else block.text
        case BulletList():
            return "\n".join([f"{block.title}:", *(f"- {line}" for line in block.lines)])
        case TableBlock():
            rows = block.rows[:TERMINAL_ROWS] if block.long else block.rows
            lines = [f"{block.title}:", _lines(replace(block, rows=rows))]
            lines += [f"and {len(block.rows) - TERMINAL_ROWS} more"] if block.long else []
            return "\n".join(lines + ([block.note] if block.note else []))
    return ""


def _lines(table: TableBlock) -> str:
    """Text of a table in columns, or in one line per row if it is too wide."""
    text = align_columns(table.header, table.rows, table.text_columns)
    if max(map(len, text.split("\n"))) <= TERMINAL_WIDTH:
        return text
    heads = ["" if i < table.text_columns else f"{head}: " for i, head in enumerate(table.header)]
    rows = (
        [head + cell for head, cell in zip(heads, row, strict=True) if cell not in ("", MISSING_TEXT)]
        for row in table.rows
    )
    return "\n".join(f"- {'; '.join(row)}" for row in rows)


def table_of(
    title: str,
    entries: Iterable[Any],
    *fields: str,
    note: str = "",
    marked: Callable[[Any], bool] | None = None,
    folds: bool = True,
) -> list[TableBlock]:
    """Table of entries of a result file, with meanings and units of their model; empty list without entries.

    A field is `name`, `name=title`, or `name+-sigma` with the field of its standard deviation.
    """
    rows = list(entries)
    columns: list[results.Column] = []
    for field in fields if rows else ():
        (name, _, sigma), head = field.partition("=")[0].partition("+-"), field.partition("=")[2]
        first = getattr(rows[0], name)
        kind: results.ColumnKind = (
            "chance" if name == "p_value" else "text" if isinstance(first, str | tuple) else "number"
        )
        about = descriptions(type(rows[0])).get(name, "")
        columns.append(results.Column(name, about, kind, sigma=sigma, title=head or {"p_value": "p"}.get(name, "")))
        columns += [results.Column(sigma)] if sigma else []
    cells = [[_joined(getattr(row, column.name)) for column in columns] for row in rows]
    chosen = frozenset(i for i, row in enumerate(rows) if marked is not None and marked(row))
    return table_block(
        title, results.Table("", "", tuple(columns)).filled(cells), note=note, marked=chosen, folds=folds
    )


def table_block(
    title: str, table: results.Table, *, note: str = "", marked: frozenset[int] = frozenset(), folds: bool = True
) -> list[TableBlock]:
    """Table of a result as a block, text flush left, numbers flush right; empty list without rows."""
    if not table.rows:
        return []
    heads = table.headings
    words = [next(c.kind == "text" for c in table.columns if c.heading == head) for head in heads]
    text_columns = words.index(False) if False in words else len(words)
    meanings = [table.meanings.get(head, "") for head in heads]
    return [TableBlock(title, heads, table.cells(), text_columns, note, marked, meanings, folds)]


def _joined(value: Any) -> Any:
    """Text of a list in one cell."""
    if isinstance(value, str) or not isinstance(value, Sequence):
        return value
    return ", ".join(v if isinstance(v, str) else number_text(v) for v in value)
