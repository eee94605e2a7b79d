"""The card of an effect: what is known of a cause, in parts of fixed names.

A card is the docstring of the effect's file, or of its class where one file holds several. Its first line is the title,
a colon and the cause; then come the law, with its sign, and a paragraph for each of `PARTS`.
"""

import inspect
import re
import sys
from dataclasses import dataclass
from functools import cache
from typing import Self

from ltsim.errors import ModelError

PARTS = ("Size", "Like", "Separate by", "Valid", "Source", "Status")
_PART = re.compile(rf"^({'|'.join(PARTS)}): ", re.MULTILINE)


@dataclass(frozen=True)
class Card:
    """What is known of a physical cause."""

    title: str
    cause: str
    """What it is called, and what happens."""
    law: str
    """The equation with its sign, in lines as they are written; often with what gives it away."""
    size: str
    """Of a good and of a bad instrument or room."""
    like: str
    """What leaves similar residuals. Two numbers are correlations of the residuals in the reference workshop, one face
    and two faces.
    """
    separate_by: str
    """The measurement that tells it from these."""
    valid: str
    """Where the law holds."""
    source: str
    """Literature: author, year, title, equation or page where they are known."""
    status: str
    """How the law was validated."""

    @classmethod
    def read(cls, text: str) -> Self:
        """The card in a docstring; raises ModelError, naming the part that is missing, given twice or out of order."""
        head, _, rest = inspect.cleandoc(text).partition("\n\n")
        title, colon, cause = " ".join(head.split()).rstrip(".").partition(": ")
        if not colon or not cause:
            raise ModelError(f"a card begins with 'Title: what happens.', found {head.partition(chr(10))[0]!r}")
        pieces = _PART.split(rest)
        if tuple(pieces[1::2]) != PARTS:
            found = ", ".join(pieces[1::2]) or "none"
            raise ModelError(f"a card has the parts {', '.join(PARTS)} in this order, found {found}")
        law, *told = (piece.strip() for piece in (pieces[0], *pieces[2::2]))
        for name, part in zip(("law", *PARTS), (law, *told), strict=True):
            if not part:
                raise ModelError(f"the part {name} of a card is empty")
        return cls(title, cause, law, *(" ".join(part.split()) for part in told))

    def parts(self) -> tuple[tuple[str, str], ...]:
        """(name, text) of the parts after the law."""
        told = (self.size, self.like, self.separate_by, self.valid, self.source, self.status)
        return tuple(zip(PARTS, told, strict=True))


@cache
def card_of(kind: type) -> Card:
    """The card of an effect; raises ModelError when neither the class nor its file has one that is complete."""
    own = kind.__dict__.get("__doc__") or ""
    text = own if _PART.search(inspect.cleandoc(own)) else sys.modules[kind.__module__].__doc__
    try:
        return Card.read(text or "")
    except ModelError as problem:
        raise ModelError(f"{kind.__module__}.{kind.__name__}: {problem}") from None
