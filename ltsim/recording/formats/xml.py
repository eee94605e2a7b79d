"""XML from strangers: no entities, no external references, bounded in size and depth."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError, TreeBuilder

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from ltsim.errors import RecordError
from ltsim.recording.files import number, read_bytes, shown

LINE = "{ltsim}line"
"""An attribute that no file can set: its namespace is none, and what a file says is overwritten."""


class _Numbered(TreeBuilder):
    """Elements that know the line they begin in."""

    parser: Any = None

    def start(self, tag: Any, attrs: Any, /) -> Element:
        return super().start(tag, {**attrs, LINE: str(self.parser.parser.CurrentLineNumber)})


def parse(path: Path) -> Element:
    """The root of an XML file.

    Raises
    ------
    RecordError
        When it is not well formed (cut, badly encoded), or declares entities.
    """
    content = read_bytes(path)
    try:
        builder = _Numbered()
        builder.parser = parser = DefusedXMLParser(target=builder)  # without entities and external references
        parser.feed(content)
        root = parser.close()
    except DefusedXmlException:
        raise RecordError("declares entities, which are not read", file=path) from None
    except ParseError as problem:
        line = getattr(problem, "position", (0, 0))[0]
        raise RecordError(f"is not well-formed XML ({shown(str(problem), 80)})", file=path, row=line) from None
    except (ValueError, LookupError, RecursionError):
        raise RecordError("is not XML in an encoding that is known here", file=path) from None
    if not isinstance(root, Element):
        raise RecordError("holds no XML element", file=path)
    return root


def line_of(element: Element) -> int:
    """The line of the file that an element begins in."""
    return int(element.get(LINE, "0"))


def tag(element: Element) -> str:
    """The name of an element without its namespace."""
    return str(element.tag).rpartition("}")[2]


def attribute(element: Element, name: str, file: Path) -> str:
    """An attribute that has to be there, without blanks around it."""
    value = element.get(name)
    if value is None:
        raise RecordError(f"<{shown(tag(element))}> lacks the attribute {name}", file=file)
    return value.strip()


def value_of(element: Element, name: str, file: Path, default: float | None = None) -> float:
    """An attribute that is a number; `default` where it is absent.

    Raises
    ------
    RecordError
        When it is absent without a default, or is not a finite number.
    """
    text = element.get(name)
    if text is None and default is not None:
        return default
    found = attribute(element, name, file)
    return number(found, file=file, column=f"<{shown(tag(element))}> {name}")
