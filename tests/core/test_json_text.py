"""The text of a JSON object in parts is the text of the whole."""

from __future__ import annotations

import json
from typing import Any

import pytest

from ltsim.core.json_text import json_object_parts


@pytest.mark.parametrize(
    ("content", "entries"),
    [
        ({}, {}),
        ({"a": []}, {"a": []}),
        ({"a": [], "b": {"c": ["ä\u2028\x85", {"d": None}]}, "e": []}, {"a": [{"x": 1.5, "y": []}, 2], "e": ["z"]}),
        ({"a": 1, "b": "text"}, {"c": [1]}),
    ],
)
def test_parts_make_the_text_of_the_whole(content: dict[str, Any], entries: dict[str, list[Any]]) -> None:
    whole = content | {key: value for key, value in entries.items() if key in content}
    assert "".join(json_object_parts(content, {key: iter(value) for key, value in entries.items()})) == json.dumps(
        whole, indent=1
    )


def test_entries_are_made_in_sequence() -> None:
    made = []

    def entries() -> Any:
        for number in range(3):
            made.append(number)
            yield {"number": number}

    for part in json_object_parts({"a": []}, {"a": entries()}):
        if '"number": 0' in part:
            assert made == [0]
    with pytest.raises(ValueError, match="not JSON compliant"):
        "".join(json_object_parts({"a": []}, {"a": [float("nan")]}))
