"""Safe parser of XML files: no entities, no external references, limited size and depth."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError, TreeBuilder

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import RecordError
from ltsim.core.limits import (
    MAX_COVARIANCE_VALUES,
    MAX_TAG_ATTRIBUTES,
    MAX_XML_ATTRIBUTES,
    MAX_XML_DEPTH,
    MAX_XML_TAGS,
)
from ltsim.recordings.files import SourceLocation, read_bytes, safe_excerpt

_LONG_TAG_PATTERN = re.compile(rb"<[^<]{4096,}+")
"""Pattern of tags with more than 4096 characters; shorter tags cannot exceed the limit of attributes."""
BAND_MATRIX_SIZE_MESSAGE = "a <cov-mat> whose numbers do not match dim and band"
"""Error message for a matrix of GNU Gama with too many or too few values."""
LINE_NUMBER_ATTRIBUTE = "{ltsim}line"
"""Attribute in which the parser stores the line number of an element; it replaces one in the file."""


class _LineNumberBuilder(TreeBuilder):
    """Tree builder that adds the line number to each element, and limits the depth; raises RecordError."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.parser: Any = None
        self._depth = DepthCheck(file)

    def start(self, tag: Any, attrs: Any, /) -> Element:
        self._depth.start(tag, attrs)
        return super().start(tag, {**attrs, LINE_NUMBER_ATTRIBUTE: str(self.parser.parser.CurrentLineNumber)})

    def end(self, tag: Any, /) -> Element:
        self._depth.end(tag)
        return super().end(tag)


class DepthCheck:
    """Parser target that builds no tree, and raises RecordError for elements nested deeper than `MAX_XML_DEPTH`."""

    def __init__(self, file: Path) -> None:
        self._file, self._depth = file, 0

    def start(self, _tag: Any, _attributes: Any) -> None:
        """Beginning of an element, called by the parser; raises RecordError for one nested too deeply."""
        self._depth += 1
        if self._depth > MAX_XML_DEPTH:
            raise RecordError(
                f"the file nests elements deeper than {MAX_XML_DEPTH}, the limit for reading", file=self._file
            )

    def end(self, _tag: Any) -> None:
        """End of an element, called by the parser."""
        self._depth -= 1

    def close(self) -> None:
        """End of the file, called by the parser; no tree was built, so nothing is returned."""


def check_tag_attributes(content: bytes, file: Path) -> None:
    """Check that no tag of an XML text has more than the permitted number of attributes; raises RecordError.

    An attribute cannot contain `<`. Therefore all attributes of a tag are before the next `<`.
    """
    if any(match[0].count(b"=") > MAX_TAG_ATTRIBUTES for match in _LONG_TAG_PATTERN.finditer(content)):
        raise RecordError(
            f"the file holds a tag with more than {MAX_TAG_ATTRIBUTES} attributes, the limit for reading", file=file
        )


def parse_xml(path: Path) -> XmlNode:
    """Root element of an XML file.

    Raises RecordError if the file is not well formed (for example incomplete), has an unknown encoding or declares
    entities.
    """
    content = read_bytes(path)
    if content.count(b"<") > MAX_XML_TAGS or content.count(b"=") > MAX_XML_ATTRIBUTES:
        most = f"{MAX_XML_TAGS} tags or {MAX_XML_ATTRIBUTES} attributes"
        raise RecordError(f"the file holds more than {most}, the limit for reading", file=path)
    check_tag_attributes(content, path)
    try:
        builder = _LineNumberBuilder(path)
        builder.parser = parser = DefusedXMLParser(target=builder)  # without entities and external references
        parser.feed(content)
        root = parser.close()
    except DefusedXmlException:
        raise RecordError("declares entities, which are not read", file=path) from None
    except ParseError as problem:
        line = getattr(problem, "position", (0, 0))[0]
        raise RecordError(
            f"the file is not well-formed XML ({safe_excerpt(str(problem), 80)})", file=path, row=line
        ) from None
    except (ValueError, LookupError, RecursionError):
        raise RecordError("the file is not XML in a supported encoding", file=path) from None
    if not isinstance(root, Element):
        raise RecordError("the file contains no XML element", file=path)
    return XmlNode(root, path)


@dataclass(frozen=True)
class XmlNode:
    """Element of an XML file; errors about its content name the line."""

    element: Element
    file: Path

    def __iter__(self) -> Iterator[XmlNode]:
        return (XmlNode(inner, self.file) for inner in self.element)

    def descendants(self, *tags: str) -> Iterator[XmlNode]:
        """Elements with one of the names `tags`: this element and all below it, in the order of the file."""
        nodes = (XmlNode(inner, self.file) for inner in self.element.iter())
        return (node for node in nodes if node.tag in tags)

    @property
    def tag(self) -> str:
        """Name of the element without its namespace."""
        return str(self.element.tag).rpartition("}")[2]

    @property
    def line(self) -> int:
        """Line number in the file where the element begins."""
        return int(self.element.get(LINE_NUMBER_ATTRIBUTE, "0"))

    @property
    def location(self) -> SourceLocation:
        """Location of the element in its file."""
        return SourceLocation(self.file, self.line)

    @property
    def text(self) -> str:
        """Text of the element on one line."""
        return " ".join((self.element.text or "").split())

    def attribute(self, name: str, default: str = "") -> str:
        """Value of an attribute without surrounding blanks; `default` if the attribute is missing."""
        return self.element.get(name, default).strip()

    def __contains__(self, name: str) -> bool:
        return name in self.element.attrib

    def required_attribute(self, name: str) -> str:
        """Value of a required attribute; raises RecordError if the attribute is missing."""
        if name not in self:
            raise self.location.error(f"<{safe_excerpt(self.tag)}> lacks the attribute {name}")
        return self.attribute(name)

    def read_number(self, name: str, default: float | None = None, limit: float = 1e12) -> float:
        """Value of an attribute as a number of at most `limit` in magnitude; `default` if the attribute is missing.

        Raises RecordError for other content, and for a missing attribute if `default` is None.
        """
        if default is not None and name not in self:
            return default
        return self.location.parse_number(
            self.required_attribute(name), f"<{safe_excerpt(self.tag)}> {name}", limit=limit
        )

    def read_name(self, name: str, kind: str) -> str:
        """Value of a required attribute, checked as name of a station, target or point (`kind`); raises RecordError."""
        return self.location.checked_name(self.required_attribute(name), kind)


def band_matrix_value_count(node: XmlNode, n_rows: float, band: float) -> int:
    """Number of values in the upper band of a symmetric matrix of GNU Gama: diagonal and `band` further diagonals.

    The matrix has `n_rows` rows. Raises RecordError, which names `node`, if a size is impossible or the number exceeds
    the limit.
    """
    if not 0 <= band < n_rows or n_rows % 1:
        raise node.location.error(BAND_MATRIX_SIZE_MESSAGE)
    rows, width = int(n_rows), int(band)
    size = rows * (width + 1) - width * (width + 1) // 2
    if size > MAX_COVARIANCE_VALUES:
        message = f"a <cov-mat> of more than {MAX_COVARIANCE_VALUES} values, the limit for reading; reduce its band"
        raise node.location.error(message)
    return size


def band_matrix_entries(
    node: XmlNode, n_rows: float, band: float, band_values: Sequence[float]
) -> tuple[Ints, Ints, Floats]:
    """Row index (k,), column index (k,) and value (k,) of the k values in the upper band of a symmetric matrix.

    `band_values` are in the order of GNU Gama: row by row, the diagonal entry and the next `band` entries. Raises
    RecordError, which names `node`, if their number is wrong.
    """
    if len(band_values) != band_matrix_value_count(node, n_rows, band):
        raise node.location.error(BAND_MATRIX_SIZE_MESSAGE)
    row_indices = np.arange(int(n_rows))
    last_columns = np.minimum(row_indices + int(band), int(n_rows) - 1)
    counts = last_columns - row_indices + 1
    column = np.concatenate([np.arange(i, j + 1) for i, j in zip(row_indices, last_columns, strict=True)])
    return np.repeat(row_indices, counts), column, np.array(band_values)
