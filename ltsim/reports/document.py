"""A report as data: sections of facts, tables, pictures and a scene. A template turns it into HTML, `text` into lines.

A picture is drawn when the page is written: a terminal says the same without drawing.
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
from ltsim.core.notation import NONE, aligned, number
from ltsim.recordings import Recording
from ltsim.recordings.result_file import ResultFile, companion

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POLICY = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline' blob:; worker-src blob:; connect-src data: blob:; frame-src 'self'"
)
"""Content security policy of a page: the browser itself refuses whatever is not in the file."""
Mood = Literal["good", "bad", "plain"]
Detail = Literal["turn", "plan", "none"]
"""View of the workshop in a section: in 3D to turn, from above alone, or not, since another section shows it."""
LONG, ENDLESS = 30, 120
"""Rows of a table from which it is folded, and from which a print leaves it out: three pages."""
FIRST, WIDEST = 8, 160
"""Rows of a folded table that a terminal shows, and the letters of a line up to which it shows columns."""


@dataclass(frozen=True)
class ReportContext:
    """Context of a result: its folder, the recording behind it, and how much of them its section shows.

    A `brief` section leaves residuals to another one.
    """

    folder: Path | None = None
    recording: Recording | None = None
    detail: Detail = "none"
    brief: bool = False

    def file(self, name: str, content: ResultFile) -> Path | None:
        """A file that was written with a result; None where there is none, RecordError where it is of another."""
        return None if self.folder is None else companion(self.folder, name, content)


def mood(good: bool) -> Mood:
    """Good or bad."""
    return "good" if good else "bad"


@dataclass(frozen=True)
class Fact:
    """One figure to see at a glance."""

    name: str
    value: str
    mood: Mood = "plain"


@dataclass(frozen=True)
class Grid:
    """Cells are texts; `text_columns` are set left, all others right; `meanings` of the columns explain the header."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    text_columns: int = 1
    note: str = ""
    marked: frozenset[int] = frozenset()
    meanings: Sequence[str] = ()
    folds: bool = True
    """True where the table is folded when it is long; False where the table is the product."""
    kind: Literal["table"] = "table"

    @property
    def endless(self) -> bool:
        """Whether the table is left out of a print."""
        return len(self.rows) > ENDLESS

    @property
    def long(self) -> bool:
        """Whether the table starts folded."""
        return len(self.rows) > LONG and self.folds


@dataclass(frozen=True)
class Picture:
    """A figure, or its SVG, with a caption that also serves readers who cannot see it; drawn when it is asked for."""

    title: str
    draw: Callable[[], Figure | str]
    caption: str
    kind: Literal["picture"] = "picture"

    @cached_property
    def uri(self) -> str:
        """As a `data:` address."""
        from ltsim.reports.style import svg, svg_uri

        drawn = self.draw()
        return svg_uri(drawn if isinstance(drawn, str) else svg(drawn))


@dataclass(frozen=True)
class Scene:
    """The 3D view: a picture, and behind it the page to turn."""

    title: str
    image: str
    caption: str
    page: str
    kind: Literal["scene"] = "scene"

    @property
    def packed(self) -> str:
        """The page as the browser unpacks it: gzip in base64."""
        return base64.b64encode(gzip.compress(self.page.encode(), mtime=0)).decode()


@dataclass(frozen=True)
class Note:
    """A paragraph with a heading."""

    title: str
    text: str
    mood: Mood = "plain"
    kind: Literal["note"] = "note"


@dataclass(frozen=True)
class Listing:
    """Settings or another text to keep as it is; folded away."""

    title: str
    text: str
    kind: Literal["listing"] = "listing"


@dataclass(frozen=True)
class Notes:
    """A few sentences, one a line."""

    title: str
    lines: Sequence[str]
    kind: Literal["points"] = "points"


Block = Notes | Grid | Picture | Scene | Note | Listing


@dataclass(frozen=True)
class Section:
    """One folder's part of the report; `answer` is one sentence that stands first.

    `title` says what a page of this section alone is about; `kind` and `folder` head it among others. The first
    `shown` blocks stand open, the others are details; `lead` of them stand side by side in the head of the page. A
    terminal prints the first `told`, or all.
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

    def text(self) -> str:
        """Text for a terminal: the answer, the facts, sentences and tables, what to do next."""
        facts = "; ".join(f"{fact.name}: {fact.value}" for fact in self.facts)
        parts = [self.answer, facts, *map(_as_text, self.blocks[: self.terminal_blocks])]
        parts += ["\n".join(["What to do next:", *(f"- {line}" for line in self.actions)])] if self.actions else []
        return "\n\n".join(filter(None, parts))


@dataclass(frozen=True)
class Document:
    """The whole page: who and what, `verdict` in a few words, `answer` in a sentence, what to do, then the evidence."""

    title: str
    answer: str
    mood: Mood
    sections: Sequence[Section] = ()
    versions: Sequence[tuple[str, str]] = ()
    about: Sequence[tuple[str, str]] = ()
    verdict: str = ""
    actions: Sequence[str] = ()


def _as_text(block: Block) -> str:
    """A block in lines; pictures and settings stay on the page."""
    match block:
        case Note():
            return f"{block.title}: {block.text}" if block.title else block.text
        case Notes():
            return "\n".join([f"{block.title}:", *(f"- {line}" for line in block.lines)])
        case Grid():
            rows = block.rows[:FIRST] if block.long else block.rows
            lines = [f"{block.title}:", _lines(replace(block, rows=rows))]
            lines += [f"and {len(block.rows) - FIRST} more"] if block.long else []
            return "\n".join(lines + ([block.note] if block.note else []))
    return ""


def _lines(table: Grid) -> str:
    """A table in columns, or where its texts are long a sentence a row."""
    text = aligned(table.header, table.rows, table.text_columns)
    if max(map(len, text.split("\n"))) <= WIDEST:
        return text
    heads = ["" if i < table.text_columns else f"{head}: " for i, head in enumerate(table.header)]
    rows = (
        [head + cell for head, cell in zip(heads, row, strict=True) if cell not in ("", NONE)] for row in table.rows
    )
    return "\n".join(f"- {'; '.join(row)}" for row in rows)


def table_of(
    title: str,
    entries: Iterable[Any],
    *fields: str,
    note: str = "",
    marked: Callable[[Any], bool] | None = None,
    folds: bool = True,
) -> list[Grid]:
    """Entries of a result file as a table, none where there are none; meanings and units are those of their model.

    A field may be `field=head`, and with its standard deviation beside it `field+-sigma`.
    """
    rows = list(entries)
    columns: list[results.Column] = []
    for field in fields if rows else ():
        (name, _, sigma), head = field.partition("=")[0].partition("+-"), field.partition("=")[2]
        declared = type(rows[0]).model_fields.get(name)
        first = getattr(rows[0], name)
        kind: results.Kind = "chance" if name == "p_value" else "text" if isinstance(first, str | tuple) else "number"
        about = (declared.description or "") if declared else ""
        columns.append(results.Column(name, about, kind, sigma=sigma, title=head or {"p_value": "p"}.get(name, "")))
        columns += [results.Column(sigma)] if sigma else []
    cells = [[_joined(getattr(row, column.name)) for column in columns] for row in rows]
    chosen = frozenset(i for i, row in enumerate(rows) if marked is not None and marked(row))
    return table_block(
        title, results.Table("", "", tuple(columns)).filled(cells), note=note, marked=chosen, folds=folds
    )


def table_block(
    title: str, table: results.Table, *, note: str = "", marked: frozenset[int] = frozenset(), folds: bool = True
) -> list[Grid]:
    """A table of a result as the page has it, none where it has no rows; text to the left, numbers to the right."""
    if not table.rows:
        return []
    heads = table.headings
    words = [next(c.kind == "text" for c in table.columns if c.heading == head) for head in heads]
    text_columns = words.index(False) if False in words else len(words)
    meanings = [table.meanings.get(head, "") for head in heads]
    return [Grid(title, heads, table.cells(), text_columns, note, marked, meanings, folds)]


def _joined(value: Any) -> Any:
    """A list as a person reads it in one cell."""
    if isinstance(value, str) or not isinstance(value, Sequence):
        return value
    return ", ".join(v if isinstance(v, str) else number(v) for v in value)
