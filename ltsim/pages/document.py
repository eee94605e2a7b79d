"""A report as data: sections of facts, tables, pictures and a scene. The template turns it into HTML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from matplotlib.figure import Figure

from ltsim.pages.style import narrow_uri, svg_uri

POLICY = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline' blob:; worker-src blob:; connect-src data: blob:; frame-src 'self'"
)
"""Of a page: the browser itself refuses whatever is not in the file."""
Mood = Literal["good", "bad", "plain"]
Detail = Literal["turn", "still", "none"]
"""How a section shows the workshop: in 3D to turn, as pictures, or not, since another section shows the same one."""


MOST_PRINTED = 120
"""Rows of a table that a print still holds: three pages."""


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
    """Cells are texts; `text_columns` are set left, all others right; long tables fold away."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    text_columns: int = 1
    note: str = ""
    marked: frozenset[int] = frozenset()
    kind: Literal["table"] = "table"

    @property
    def endless(self) -> bool:
        """Whether the table is left out of a print."""
        return len(self.rows) > MOST_PRINTED

    @property
    def long(self) -> bool:
        """Whether the table starts folded."""
        return len(self.rows) > 30


@dataclass(frozen=True)
class Picture:
    """A figure as a `data:` address with a caption that also serves readers who cannot see it; `narrow` for a phone."""

    title: str
    uri: str
    caption: str
    narrow: str = ""
    kind: Literal["picture"] = "picture"


@dataclass(frozen=True)
class Scene:
    """The 3D view: a page to turn (empty where only the picture is shown) and a picture for print."""

    title: str
    png: str
    caption: str
    page: str = ""
    kind: Literal["scene"] = "scene"


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

    `title` heads a page of this section alone; `kind` and `folder` head it among others.
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


@dataclass(frozen=True)
class Document:
    """The whole page: who and what, `verdict` in a few words, `answer` in a sentence, what to do, then the evidence."""

    title: str
    answer: str
    mood: Mood
    sections: Sequence[Section] = field(default_factory=tuple)
    versions: Sequence[tuple[str, str]] = ()
    about: Sequence[tuple[str, str]] = ()
    verdict: str = ""
    actions: Sequence[str] = ()


def picture(title: str, figure: Figure, caption: str) -> Picture:
    """A figure for the page."""
    return Picture(title, svg_uri(figure), caption, narrow_uri(figure))
