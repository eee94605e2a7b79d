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
Assessment = Literal["good", "caution", "bad", "plain"]
"""Assessment of a result, which determines its colour."""
WorkshopDetail = Literal["turn", "plan", "none"]
"""View of the workshop in a section: interactive 3D, floor plan only, or none if another section shows it."""
MAX_UNFOLDED_ROWS = 30
"""Number of rows above which a table on a page starts folded."""
MAX_PRINTED_ROWS = 120
"""Number of rows above which a table is not printed on paper (three pages)."""
MAX_TERMINAL_ROWS = 8
"""Number of rows of a folded table that a terminal prints."""
MAX_TERMINAL_WIDTH = 160
"""Largest width of a table on a terminal [characters]; a wider one is printed as one line per row."""


@dataclass(frozen=True)
class ReportContext:
    """Folder and recording of a result, and the level of detail of its section.

    A `is_brief` section leaves residuals to another one.
    """

    folder: Path | None = None
    recording: Recording | None = None
    detail: WorkshopDetail = "none"
    is_brief: bool = False

    def companion_file(self, name: str, content: ResultFile) -> Path | None:
        """Companion file of a result; None if it does not exist; raises RecordError if it belongs to another result."""
        return None if self.folder is None else companion_path(self.folder, name, content)


def assessment_of(is_good: bool) -> Assessment:
    """Mood `is_good` or `bad` for a flag."""
    return "good" if is_good else "bad"


@dataclass(frozen=True)
class KeyFigure:
    """Key figure of a section."""

    name: str
    value: str
    assessment: Assessment = "plain"


@dataclass(frozen=True)
class TableBlock:
    """Table of texts; the first `text_columns` columns are flush left; `meanings` explain the header."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    text_columns: int = 1
    note: str = ""
    marked_rows: frozenset[int] = frozenset()
    meanings: Sequence[str] = ()
    is_foldable: bool = True
    """True if the table is folded when it is long; False for a table that is the product."""
    kind: Literal["table"] = "table"

    @property
    def is_too_long_to_print(self) -> bool:
        """True if the table is too long to print."""
        return len(self.rows) > MAX_PRINTED_ROWS

    @property
    def is_folded(self) -> bool:
        """True if the table starts folded."""
        return len(self.rows) > MAX_UNFOLDED_ROWS and self.is_foldable


@dataclass(frozen=True)
class PictureBlock:
    """Figure or SVG with a caption, which is also its alternative text; drawn on first use."""

    title: str
    draw_figure: Callable[[], Figure | str]
    caption: str
    kind: Literal["picture"] = "picture"

    @cached_property
    def data_uri(self) -> str:
        """Picture as a `data:` URI."""
        from ltsim.reports.style import svg_data_uri, svg_text

        drawn = self.draw_figure()
        return svg_data_uri(drawn if isinstance(drawn, str) else svg_text(drawn))


@dataclass(frozen=True)
class SceneBlock:
    """3D view: a picture, and the interactive page that it opens."""

    title: str
    image: str
    caption: str
    page: str
    kind: Literal["scene"] = "scene"

    @property
    def page_gzip_base64(self) -> str:
        """Interactive page as gzip in base64, unpacked by the browser."""
        return base64.b64encode(gzip.compress(self.page.encode(), mtime=0)).decode()


@dataclass(frozen=True)
class NoteBlock:
    """Paragraph with a heading."""

    title: str
    text: str
    assessment: Assessment = "plain"
    kind: Literal["note"] = "note"


@dataclass(frozen=True)
class CodeBlock:
    """Preformatted text, such as settings; it starts folded on the page."""

    title: str
    text: str
    kind: Literal["listing"] = "listing"


@dataclass(frozen=True)
class BulletListBlock:
    """Bullet list of sentences."""

    title: str
    lines: Sequence[str]
    kind: Literal["points"] = "points"


Block = BulletListBlock | TableBlock | PictureBlock | SceneBlock | NoteBlock | CodeBlock


@dataclass(frozen=True)
class Section:
    """Section of a page: one result of one folder; `summary` is its first sentence.

    `simulation_notice` comes before the answer and states that the data are simulated.

    `title` is the title of a page with this section alone; `kind` and `folder` are its heading among others. The first
    `n_open_blocks` blocks are open, the others are details; the first `n_lead_blocks` blocks are side by side at the
    head of the page. A terminal prints the first `n_terminal_blocks`, or all.
    """

    title: str
    kind: str
    summary: str
    assessment: Assessment = "plain"
    key_figures: Sequence[KeyFigure] = ()
    blocks: Sequence[Block] = ()
    folder: str = ""
    next_actions: Sequence[str] = ()
    seed: str = ""
    versions: Sequence[tuple[str, str]] = ()
    axes: str = ""
    instrument: str = ""
    measured_on: str = ""
    n_open_blocks: int = 3
    n_lead_blocks: int = 0
    n_terminal_blocks: int | None = None
    simulation_notice: str = ""

    def terminal_text(self) -> str:
        """Text for a terminal: answer, facts, sentences, tables, next actions."""
        facts = "; ".join(f"{fact.name}: {fact.value}" for fact in self.key_figures)
        blocks = [self.simulation_notice, self.summary, facts, *map(_block_text, self.blocks[: self.n_terminal_blocks])]
        blocks += (
            ["\n".join(["What to do next:", *(f"- {line}" for line in self.next_actions)])] if self.next_actions else []
        )
        return "\n\n".join(filter(None, blocks))


@dataclass(frozen=True)
class Document:
    """Content of the page: header lines, headline `headline`, sentence `summary`, next actions, sections."""

    title: str
    summary: str
    assessment: Assessment
    sections: Sequence[Section] = ()
    versions: Sequence[tuple[str, str]] = ()
    header_lines: Sequence[tuple[str, str]] = ()
    headline: str = ""
    next_actions: Sequence[str] = ()
    simulation_notice: str = ""


def _block_text(block: Block) -> str:
    """Text of a block for a terminal; empty for pictures and settings."""
    match block:
        case NoteBlock():
            return f"{block.title}: {block.text}" if block.title else block.text
        case BulletListBlock():
            return "\n".join([f"{block.title}:", *(f"- {line}" for line in block.lines)])
        case TableBlock():
            rows = block.rows[:MAX_TERMINAL_ROWS] if block.is_folded else block.rows
            lines = [f"{block.title}:", _table_text(replace(block, rows=rows))]
            lines += [f"and {len(block.rows) - MAX_TERMINAL_ROWS} more"] if block.is_folded else []
            return "\n".join(lines + ([block.note] if block.note else []))
    return ""


def _table_text(table: TableBlock) -> str:
    """Text of a table in columns, or in one line per row if it is too wide."""
    text = align_columns(table.header, table.rows, table.text_columns)
    if max(map(len, text.split("\n"))) <= MAX_TERMINAL_WIDTH:
        return text
    heads = ["" if i < table.text_columns else f"{head}: " for i, head in enumerate(table.header)]
    rows = (
        [head + cell for head, cell in zip(heads, row, strict=True) if cell not in ("", MISSING_TEXT)]
        for row in table.rows
    )
    return "\n".join(f"- {'; '.join(row)}" for row in rows)


def entries_table(
    title: str,
    entries: Iterable[Any],
    *fields: str,
    note: str = "",
    is_marked: Callable[[Any], bool] | None = None,
    is_foldable: bool = True,
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
    cells = [[_cell_text(getattr(row, column.name)) for column in columns] for row in rows]
    marked_rows = frozenset(i for i, row in enumerate(rows) if is_marked is not None and is_marked(row))
    return table_block(
        title,
        results.Table("", "", tuple(columns)).with_rows(cells),
        note=note,
        marked_rows=marked_rows,
        is_foldable=is_foldable,
    )


def table_block(
    title: str,
    table: results.Table,
    *,
    note: str = "",
    marked_rows: frozenset[int] = frozenset(),
    is_foldable: bool = True,
) -> list[TableBlock]:
    """Table of a result as a block, text flush left, numbers flush right; empty list without rows."""
    if not table.rows:
        return []
    heads = table.headings
    words = [next(c.kind == "text" for c in table.columns if c.heading == head) for head in heads]
    text_columns = words.index(False) if False in words else len(words)
    meanings = [table.meanings.get(head, "") for head in heads]
    return [TableBlock(title, heads, table.cells(), text_columns, note, marked_rows, meanings, is_foldable)]


def _cell_text(value: Any) -> Any:
    """Text of a list in one cell."""
    if isinstance(value, str) or not isinstance(value, Sequence):
        return value
    return ", ".join(v if isinstance(v, str) else number_text(v) for v in value)
