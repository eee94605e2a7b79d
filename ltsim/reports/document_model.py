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
MAX_UNFOLDED_TABLE_ROWS = 30
"""Largest number of rows of a table that the page shows; of a longer table it shows only the title, until the title is
clicked."""
MAX_PRINTED_TABLE_ROWS = 120
"""Largest number of rows of a table that is printed on paper (three pages)."""
MAX_TERMINAL_TABLE_ROWS = 8
"""Largest number of rows that a terminal prints of a table that starts folded on a page (only its title)."""
MAX_RECOMMENDED_ACTIONS = 3
"""Largest number of next actions at the head of a page and on a terminal."""
MAX_TERMINAL_TABLE_WIDTH = 160
"""Largest width of a table on a terminal [characters]; a wider table is printed as one line per row."""


@dataclass(frozen=True)
class SectionContext:
    """Context of a result for its section of a report: folder, recording, and view of the hall."""

    folder: Path | None = None
    """Folder of the result; None for a result in memory."""
    recording: Recording | None = None
    """Recording from which the result was computed; None if it is not available."""
    hall_view: HallView = "none"
    """View of the hall in the section."""
    omits_residuals: bool = False
    """True if another section of the page shows the residuals of this recording."""

    def companion_file(self, name: str, content: ResultFile) -> Path | None:
        """Path of the file `name` that belongs to the result `content`, in its folder.

        The result is None if there is no such file. RecordError is raised if the file belongs to another result.
        """
        return None if self.folder is None else companion_path(self.folder, name, content)


def assessment_of(is_good: bool) -> Assessment:
    """Assessment `good` if `is_good`, otherwise `bad`."""
    return "good" if is_good else "bad"


@dataclass(frozen=True)
class KeyFigure:
    """Key figure of a section: name, value as text, and assessment."""

    name: str
    value: str
    assessment: Assessment = "plain"


@dataclass(frozen=True)
class TableBlock:
    """Table of a section, whose cells are texts."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    """Cells of each row."""
    n_text_columns: int = 1
    """Number of leading columns whose cells are flush left; all others are flush right."""
    note: str = ""
    """Text below the table."""
    marked_rows: frozenset[int] = frozenset()
    """Indices of highlighted rows."""
    column_meanings: Sequence[str] = ()
    """Meaning of each column, shown when the pointer is over its heading."""
    is_foldable: bool = True
    """True if a long table starts folded (only its title is shown); False for a table that readers need completely."""
    kind: Literal["table"] = "table"
    """Name of this kind of block in the template of the page."""

    @property
    def is_too_long_to_print(self) -> bool:
        """True if the table has too many rows to be printed on paper."""
        return len(self.rows) > MAX_PRINTED_TABLE_ROWS

    @property
    def is_folded(self) -> bool:
        """True if the page shows only the title of the table, until the title is clicked."""
        return len(self.rows) > MAX_UNFOLDED_TABLE_ROWS and self.is_foldable


@dataclass(frozen=True)
class PictureBlock:
    """Picture with a caption, which is also its alternative text."""

    title: str
    draw_figure: Callable[[], Figure | str]
    """Function that returns a figure or an SVG text; it is called when the page is written."""
    caption: str
    kind: Literal["picture"] = "picture"
    """Name of this kind of block in the template of the page."""

    @cached_property
    def data_uri(self) -> str:
        """Picture as a `data:` URI."""
        from ltsim.reports.style import svg_data_uri, svg_text

        drawn = self.draw_figure()
        return svg_data_uri(drawn if isinstance(drawn, str) else svg_text(drawn))


def picture_if_few_items(
    title: str, draw_figure: Callable[[], Figure | str], caption: str, n_items: int
) -> PictureBlock | NoteBlock:
    """Picture of `n_items` points, bars or curves; a note if there are more than `MAX_FIGURE_ITEMS`.

    `draw_figure` returns the figure and is called when the page is written.
    """
    if n_items <= MAX_FIGURE_ITEMS:
        return PictureBlock(title, draw_figure, caption)
    return NoteBlock(f"No figure: {title}", f"{n_items} items are too many to draw; the limit is {MAX_FIGURE_ITEMS}.")


@dataclass(frozen=True)
class SceneBlock:
    """3D view: picture as a `data:` URI, and the interactive HTML page that opens after a click on the picture."""

    title: str
    image_uri: str
    caption: str
    page_html: str
    kind: Literal["scene"] = "scene"
    """Name of this kind of block in the template of the page."""

    @property
    def page_gzip_base64(self) -> str:
        """Interactive page as gzip in base64, which the browser unpacks."""
        return base64.b64encode(gzip.compress(self.page_html.encode(), mtime=0)).decode()


@dataclass(frozen=True)
class NoteBlock:
    """Paragraph with a heading in a section."""

    title: str
    text: str
    assessment: Assessment = "plain"
    kind: Literal["note"] = "note"
    """Name of this kind of block in the template of the page."""


@dataclass(frozen=True)
class CodeBlock:
    """Preformatted text of a section, such as settings; the page shows only its title until the title is clicked."""

    title: str
    text: str
    kind: Literal["listing"] = "listing"
    """Name of this kind of block in the template of the page."""


@dataclass(frozen=True)
class BulletListBlock:
    """Bullet list of sentences in a section."""

    title: str
    lines: Sequence[str]
    kind: Literal["points"] = "points"
    """Name of this kind of block in the template of the page."""


Block = BulletListBlock | TableBlock | PictureBlock | SceneBlock | NoteBlock | CodeBlock
"""Part of a section below its key figures."""


@dataclass(frozen=True)
class Section:
    """Section of a page that reports the result in a folder."""

    title: str
    """Title of a page that contains only this section; on a page with several sections its heading consists of `kind`
    and `folder`."""
    kind: str
    """Kind of the result, such as `Calibration`."""
    summary: str
    """First sentence of the section."""
    assessment: Assessment = "plain"
    key_figures: Sequence[KeyFigure] = ()
    blocks: Sequence[Block] = ()
    folder: str = ""
    """Name of the folder of the result."""
    next_actions: Sequence[str] = ()
    """Recommended actions, the most urgent first."""
    seed_text: str = ""
    """Seed of the random draws of the result, as text; empty for none."""
    package_versions: Sequence[tuple[str, str]] = ()
    """Pairs of the name and the version of the packages that computed the result."""
    axes_text: str = ""
    """Definition of the coordinate axes."""
    instrument_text: str = ""
    measurement_date: str = ""
    n_open_blocks: int = 3
    """Number of leading blocks (tables, pictures, ...) that are open; the page shows only the titles of all other
    blocks."""
    n_side_by_side_blocks: int = 0
    """Number of leading blocks (tables, pictures, ...) that are side by side at the head of the page."""
    n_terminal_blocks: int | None = None
    """Number of leading blocks (tables, lists, ...) that a terminal prints; None for all."""
    simulation_notice: str = ""
    """Notice before the summary that the data are simulated; empty for real data."""
    method: str = ""
    """Method by which the result was computed, shown in the heading after the kind of the result; empty for none."""

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
    """Document with the content of a page: sections, and the texts at the head of the page."""

    title: str
    summary: str
    assessment: Assessment
    sections: Sequence[Section] = ()
    package_versions: Sequence[tuple[str, str]] = ()
    """Pairs of the name and the version of the packages that contribute to the page."""
    header_lines: Sequence[tuple[str, str]] = ()
    """Pairs of name and text at the head of the page, such as instrument and date."""
    headline: str = ""
    """Headline: the main result in one sentence."""
    next_actions: Sequence[str] = ()
    """Recommended actions at the head of the page."""
    simulation_notice: str = ""
    """Notice that the data are simulated; empty for real data."""


def _block_text(block: Block) -> str:
    """Text of a block for a terminal; empty for pictures and settings."""
    match block:
        case NoteBlock():
            return f"{block.title}: {block.text}" if block.title else block.text
        case BulletListBlock():
            return "\n".join([f"{block.title}:", *(f"- {line}" for line in block.lines)])
        case TableBlock():
            rows = block.rows[:MAX_TERMINAL_TABLE_ROWS] if block.is_folded else block.rows
            lines = [f"{block.title}:", _table_text(replace(block, rows=rows))]
            lines += [f"and {len(block.rows) - MAX_TERMINAL_TABLE_ROWS} more"] if block.is_folded else []
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
    """List with the table of entries of a result file; empty without entries.

    The model of the entries gives meanings and units. Each of `fields` is the name of a field, `name=title`, or
    `name+-sigma` with the field of the standard deviation. `note` is a text below the table, and `is_marked` selects
    the entries whose rows are highlighted. With `is_foldable` the page shows only the title of a long table.
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
    """List with the table of a result as a block, text flush left, numbers flush right; empty without rows.

    `note` is a text below the table, and `marked_rows` are the indices of highlighted rows. With `is_foldable` the page
    shows only the title of a long table.
    """
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
    """Value of a table cell; a list becomes a text with commas."""
    if isinstance(value, str) or not isinstance(value, Sequence):
        return value
    return ", ".join(v if isinstance(v, str) else number_text(v) for v in value)
