"""Content of a report before it becomes HTML or text: sections with key figures, tables, pictures and 3D views.

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
from ltsim.core.descriptions import field_descriptions
from ltsim.core.limits import MAX_FIGURE_ITEMS
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
"""Assessment of a result; it determines the colour of the result on a page."""
HallView = Literal["3d", "floor-plan", "none"]
"""View of the hall in a section: interactive (`3d`), from above (`floor-plan`), or `none`."""
MAX_UNFOLDED_ROWS = 30
"""Number of rows of a table above which the page shows the table folded (only its title) until it is clicked."""
MAX_PRINTED_ROWS = 120
"""Number of rows (three pages) above which a table is not printed on paper."""
MAX_TERMINAL_ROWS = 8
"""Number of rows that a terminal prints of a table that starts folded on a page."""
MAX_RECOMMENDED_ACTIONS = 3
"""Largest number of next actions at the head of a page and on a terminal."""
MAX_TERMINAL_TABLE_WIDTH = 160
"""Largest width of a table on a terminal [characters]; a wider one is printed as one line per row."""


@dataclass(frozen=True)
class SectionContext:
    """Data from which the section of a result is written: folder, recording, and view of the hall (`hall_view`).

    `omits_residuals` is True if another section of the page shows the residuals of this recording.
    """

    folder: Path | None = None
    recording: Recording | None = None
    hall_view: HallView = "none"
    omits_residuals: bool = False

    def companion_file(self, name: str, content: ResultFile) -> Path | None:
        """Path of a companion file of the result `content`; None without it; RecordError if it is of another result."""
        return None if self.folder is None else companion_path(self.folder, name, content)


def assessment_of(is_good: bool) -> Assessment:
    """Assessment `good` for True, `bad` for False."""
    return "good" if is_good else "bad"


@dataclass(frozen=True)
class KeyFigure:
    """Key figure of a section: name, value as text, and assessment."""

    name: str
    value: str
    assessment: Assessment = "plain"


@dataclass(frozen=True)
class TableBlock:
    """Table whose cells are texts.

    The first `n_text_columns` columns are flush left, the others flush right; `column_meanings` explains each heading.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    n_text_columns: int = 1
    note: str = ""
    marked_rows: frozenset[int] = frozenset()
    column_meanings: Sequence[str] = ()
    is_foldable: bool = True
    """True if the table is folded when it is long; False for a table that readers need completely."""
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
    """Picture with a caption, which is also its alternative text.

    `draw_figure` returns a figure or an SVG text and is called when the page is written.
    """

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


def picture_if_few_items(
    title: str, draw_figure: Callable[[], Figure | str], caption: str, n_items: int
) -> PictureBlock | NoteBlock:
    """Picture of `n_items` points, bars or curves; a note if there are more than `MAX_FIGURE_ITEMS`."""
    if n_items <= MAX_FIGURE_ITEMS:
        return PictureBlock(title, draw_figure, caption)
    return NoteBlock(f"No figure: {title}", f"{n_items} items are too many to draw; at most {MAX_FIGURE_ITEMS} are.")


@dataclass(frozen=True)
class SceneBlock:
    """3D view: picture as a `data:` URI, and the interactive HTML page that opens after a click on the picture."""

    title: str
    image_uri: str
    caption: str
    page_html: str
    kind: Literal["scene"] = "scene"

    @property
    def page_gzip_base64(self) -> str:
        """Interactive page as gzip in base64, unpacked by the browser."""
        return base64.b64encode(gzip.compress(self.page_html.encode(), mtime=0)).decode()


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
    """Section of a page on one result of one folder.

    `summary` is its first sentence; `simulation_notice` comes before it if the data are simulated. `title` is the title
    of a page with this section alone; on a page with several sections `kind` and `folder` are the heading. The first
    `n_side_by_side_blocks` blocks are side by side at the head of the page. Blocks after the first `n_open_blocks` are
    folded at first. A terminal prints the first `n_terminal_blocks` blocks, or all for None.
    """

    title: str
    kind: str
    """Kind of the result, such as `Calibration`."""
    summary: str
    assessment: Assessment = "plain"
    key_figures: Sequence[KeyFigure] = ()
    blocks: Sequence[Block] = ()
    folder: str = ""
    next_actions: Sequence[str] = ()
    seed_text: str = ""
    package_versions: Sequence[tuple[str, str]] = ()
    axes_text: str = ""
    instrument_text: str = ""
    measurement_date: str = ""
    n_open_blocks: int = 3
    n_side_by_side_blocks: int = 0
    n_terminal_blocks: int | None = None
    simulation_notice: str = ""
    method: str = ""
    """Method of the result, which the heading shows after its kind; empty for none."""

    @property
    def most_urgent_actions(self) -> list[str]:
        """First `MAX_RECOMMENDED_ACTIONS` different next actions, which the page and the terminal show."""
        return list(dict.fromkeys(self.next_actions))[:MAX_RECOMMENDED_ACTIONS]

    def terminal_text(self) -> str:
        """Text for a terminal: summary, key figures, sentences, tables and next actions."""
        facts = "; ".join(f"{fact.name}: {fact.value}" for fact in self.key_figures)
        blocks = [self.simulation_notice, self.summary, facts, *map(_block_text, self.blocks[: self.n_terminal_blocks])]
        if actions := self.most_urgent_actions:
            blocks.append("\n".join(["What to do next:", *(f"- {line}" for line in actions)]))
        return "\n\n".join(filter(None, blocks))


@dataclass(frozen=True)
class Document:
    """Content of a page: sections, and the title, headline, summary and next actions at the head of the page.

    `header_lines` are pairs of name and text, `package_versions` pairs of the name and version of a package.
    """

    title: str
    summary: str
    assessment: Assessment
    sections: Sequence[Section] = ()
    package_versions: Sequence[tuple[str, str]] = ()
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
    """Text of a table in columns; one line per row if the table is wider than `MAX_TERMINAL_TABLE_WIDTH`."""
    text = align_columns(table.header, table.rows, table.n_text_columns)
    if max(map(len, text.split("\n"))) <= MAX_TERMINAL_TABLE_WIDTH:
        return text
    headings = ["" if i < table.n_text_columns else f"{heading}: " for i, heading in enumerate(table.header)]
    text_rows = (
        [heading + cell for heading, cell in zip(headings, row, strict=True) if cell not in ("", MISSING_TEXT)]
        for row in table.rows
    )
    return "\n".join(f"- {'; '.join(row)}" for row in text_rows)


def entries_table_blocks(
    title: str,
    entries: Iterable[Any],
    *fields: str,
    note: str = "",
    is_marked: Callable[[Any], bool] | None = None,
    is_foldable: bool = True,
) -> list[TableBlock]:
    """List with the table of entries of a result file, whose model gives meanings and units; empty without entries.

    Each of `fields` is the name of a field, `name=title`, or `name+-sigma` with the field of the standard deviation.
    """
    entry_list = list(entries)
    columns: list[results.Column] = []
    for field in fields if entry_list else ():
        (name, _, sigma), heading = field.partition("=")[0].partition("+-"), field.partition("=")[2]
        first_value = getattr(entry_list[0], name)
        column_kind: results.ColumnKind = (
            "p_value" if name == "p_value" else "text" if isinstance(first_value, str | tuple) else "number"
        )
        meaning = field_descriptions(type(entry_list[0])).get(name, "")
        columns.append(
            results.Column(
                name, meaning, column_kind, sigma_column=sigma, title=heading or {"p_value": "p"}.get(name, "")
            )
        )
        columns += [results.Column(sigma)] if sigma else []
    cells = [[_cell_text(getattr(row, column.name)) for column in columns] for row in entry_list]
    marked_rows = frozenset(i for i, row in enumerate(entry_list) if is_marked is not None and is_marked(row))
    return table_blocks(
        title,
        results.Table("", "", tuple(columns)).with_rows(cells),
        note=note,
        marked_rows=marked_rows,
        is_foldable=is_foldable,
    )


def table_blocks(
    title: str,
    table: results.Table,
    *,
    note: str = "",
    marked_rows: frozenset[int] = frozenset(),
    is_foldable: bool = True,
) -> list[TableBlock]:
    """List with the table of a result as a block, text flush left, numbers flush right; empty without rows."""
    if not table.rows:
        return []
    headings = table.headings
    is_text = [next(c.kind == "text" for c in table.columns if c.heading == head) for head in headings]
    text_columns = is_text.index(False) if False in is_text else len(is_text)
    meanings = [table.meanings.get(head, "") for head in headings]
    return [
        TableBlock(title, headings, table.displayed_cells(), text_columns, note, marked_rows, meanings, is_foldable)
    ]


def _cell_text(value: Any) -> Any:
    """Value of a cell; a list becomes a text with commas."""
    if isinstance(value, str) or not isinstance(value, Sequence):
        return value
    return ", ".join(v if isinstance(v, str) else number_text(v) for v in value)
