"""A report as data: sections of facts, tables, pictures and a scene. The template turns it into HTML."""

from __future__ import annotations

import base64
import gzip
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from matplotlib.figure import Figure

from ltsim.notation import NONE, number, with_sigma
from ltsim.pages.style import svg, svg_uri
from ltsim.units import BY_ENDING

POLICY = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline' blob:; worker-src blob:; connect-src data: blob:; frame-src 'self'"
)
"""Of a page: the browser itself refuses whatever is not in the file."""
Mood = Literal["good", "bad", "plain"]
Detail = Literal["turn", "plan", "none"]
"""How a section shows the workshop: in 3D to turn, from above alone, or not, since another section shows it."""
LONG, ENDLESS = 30, 120
"""Rows of a table from which it is folded, and from which a print leaves it out: three pages."""


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
class Table:
    """Cells are texts; `text_columns` are set left, all others right; `meanings` of the columns explain the header."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    text_columns: int = 1
    note: str = ""
    marked: frozenset[int] = frozenset()
    meanings: Sequence[str] = ()
    folds: bool = True
    """Whether it is folded where it is long: not where it is the product."""
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
    """A figure as a `data:` address with a caption that also serves readers who cannot see it."""

    title: str
    uri: str
    caption: str
    kind: Literal["picture"] = "picture"


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
class Points:
    """A few sentences, one a line."""

    title: str
    lines: Sequence[str]
    kind: Literal["points"] = "points"


Block = Points | Table | Picture | Scene | Note | Listing


@dataclass(frozen=True)
class Section:
    """One folder's part of the report; `answer` is one sentence that stands first.

    `title` says what a page of this section alone is about; `kind` and `folder` head it among others. The first
    `shown` blocks stand open, the others are details; `lead` of them stand side by side in the head of the page.
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
    measured: str = ""
    shown: int = 3
    lead: int = 0


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


def picture(title: str, figure: Figure, caption: str) -> Picture:
    """A figure for the page."""
    return Picture(title, svg_uri(svg(figure)), caption)


def table_of(
    title: str,
    entries: Iterable[Any],
    *fields: str,
    note: str = "",
    marked: Callable[[Any], bool] | None = None,
    folds: bool = True,
) -> list[Table]:
    """Entries of a result file as a table, with the meanings that their model gives; none where there are no entries.

    A field that has a `sigma` (or `FIELD_sigma`) beside it is written with it, one that has a `unit` with that;
    `field=head` gives a column another head. A column in which nothing stands is left out.
    """
    rows = list(entries)
    if not rows:
        return []
    names, heads = zip(*((f.partition("=")[0], f.partition("=")[2] or _head(f)) for f in fields), strict=True)
    known = getattr(type(rows[0]), "model_fields", {})
    columns = [[_cell(row, name) for row in rows] for name in names]
    kept = [i for i, column in enumerate(columns) if any(cell not in ("", NONE) for cell in column)]
    words = [isinstance(getattr(rows[0], names[i]), str) for i in kept]
    return [
        Table(
            title,
            [heads[i] for i in kept],
            list(zip(*(columns[i] for i in kept), strict=True)),
            text_columns=words.index(False) if False in words else len(words),
            note=note,
            marked=frozenset(i for i, row in enumerate(rows) if marked is not None and marked(row)),
            meanings=[known[names[i]].description or "" if names[i] in known else "" for i in kept],
            folds=folds,
        )
    ]


def _head(field: str) -> str:
    """`position_mm` as `position [mm]`."""
    ending = next((e for e in BY_ENDING if field.endswith(e)), "")
    unit = f" [{BY_ENDING[ending]}]" if ending else ""
    return field.removesuffix(ending).replace("_", " ").replace("p value", "p") + unit


def _cell(entry: Any, name: str) -> str:
    """One field as a person reads it."""
    value = getattr(entry, name)
    if isinstance(value, bool):
        return "yes" if value else ""
    if isinstance(value, str | int):
        return str(value)
    if isinstance(value, dict):
        return " ".join(f"{weight:+.2f} {of}" for of, weight in value.items())
    if isinstance(value, Sequence):
        return ", ".join(v if isinstance(v, str) else number(v) for v in value)
    unit = "" if any(name.endswith(ending) for ending in BY_ENDING) else getattr(entry, "unit", "")
    sigma = getattr(entry, f"{name}_sigma", getattr(entry, "sigma", None) if name == "value" else None)
    return with_sigma(value, sigma, unit if value is not None and name not in UNITLESS else "")


UNITLESS = ("p_value", "w", "redundancy", "share", "probability", "factor", "chi2_drop", "gain", "wrong")
"""Numbers that stand beside a unit which is not theirs."""
