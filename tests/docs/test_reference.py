"""Every key of every file says what it means, where it is declared."""

from __future__ import annotations

import re
import sys
from typing import Any, get_args

import pytest
from pydantic import BaseModel

from ltsim.core.descriptions import field_descriptions
from ltsim.recordings.native import COLUMN_VALUE_BOUNDS, ENUMERATED_COLUMNS, STANDARD_COLUMNS
from ltsim.reports.schemas import MODEL_BY_FILE_NAME
from tests.conftest import ROOT

sys.path.insert(0, str(ROOT / "docs"))

from from_code.keys import json_place, sections


def tables(model: type[BaseModel]) -> set[type[BaseModel]]:
    """The model and those of the tables in it."""
    models = {model}

    def search(annotation: Any) -> None:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel) and annotation not in models:
            models.update(tables(annotation))
        for inner in get_args(annotation):
            search(inner)

    for field in model.model_fields.values():
        search(field.annotation)
    return models


@pytest.mark.parametrize("file", MODEL_BY_FILE_NAME)
def test_every_key_says_what_it_means(file: str) -> None:
    keys = [(t, name) for t in tables(MODEL_BY_FILE_NAME[file]) for name in t.model_fields]
    assert [f"{table.__name__}.{name}" for table, name in keys if not field_descriptions(table).get(name)] == []


@pytest.mark.parametrize("file", MODEL_BY_FILE_NAME)
def test_every_file_has_a_page_of_its_keys(file: str) -> None:
    """The tables that Sphinx shows can be made of any model: the build itself is in the long run."""
    page = sections(MODEL_BY_FILE_NAME[file], json_place, "###", defaults=True)
    keys = [field.alias or name for name, field in MODEL_BY_FILE_NAME[file].model_fields.items()]
    assert [key for key in keys if not re.search(rf"`\[*{key}\b", page)] == []


def test_every_column_of_a_recording_is_in_the_reference() -> None:
    page = (ROOT / "docs" / "reference" / "recording.md").read_text(encoding="utf-8")
    assert [
        name for name in {*STANDARD_COLUMNS, *COLUMN_VALUE_BOUNDS, *ENUMERATED_COLUMNS} if f"`{name}`" not in page
    ] == []
