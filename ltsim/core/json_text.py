"""Text of a JSON object with long lists, written entry by entry so that the entries are not in memory together."""

import json
from collections.abc import Iterable, Iterator, Mapping
from textwrap import indent
from typing import Any


def json_object_parts(content: Mapping[str, Any], entries_by_key: Mapping[str, Iterable[Any]]) -> Iterator[str]:
    """Parts of the text that `json.dumps(content, indent=1)` returns, with lists in place of some values of `content`.

    `entries_by_key` holds the entries of each such list by its key in `content`; they are converted one by one. A key
    that `content` does not have is not written. ValueError is raised for NaN and infinity.
    """
    separator = "{\n "
    for key, value in content.items():
        yield f"{separator}{json.dumps(key)}: "
        separator = ",\n "
        if key not in entries_by_key:
            yield indent(json.dumps(value, indent=1, allow_nan=False), " ").lstrip(" ")
            continue
        entry_separator = "[\n"
        for entry in entries_by_key[key]:
            yield entry_separator + indent(json.dumps(entry, indent=1, allow_nan=False), "  ")
            entry_separator = ",\n"
        yield "[]" if entry_separator.startswith("[") else "\n ]"
    yield "\n}" if content else "{}"
