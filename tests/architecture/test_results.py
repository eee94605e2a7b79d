"""Each result is declared once: the class that a verb returns is the class that its file validates to."""

from __future__ import annotations

import inspect
from typing import Any

import pytest

import ltsim as lt
from ltsim.core.descriptions import descriptions
from ltsim.core.results import Result
from ltsim.recordings.result_file import ResultFile
from ltsim.reports.schemas import FILES, RESULTS

FILE_OF: dict[str, str] = {
    "accept": "accept.json",
    "adjust": "calibration.json",
    "bench": "bench.json",
    "calibrate": "calibration.json",
    "check": "check.json",
    "compare": "comparison.json",
    "evaluate": "criteria.json",
    "history": "history.json",
    "next_measurement": "next.json",
    "plan": "plan.json",
    "recover": "recovery.json",
    "simulate": "truth.json",
    "uncertainty": "uncertainty.json",
    "verify": "criteria.json",
}
"""Verbs whose result is the model of its file."""
OBJECTS: dict[str, str] = {
    "diagnose": "diagnosis.json",
}
"""Verbs whose result is an object of arrays, from which the content of its file is made."""


def returned(verb: str) -> Any:
    """Class that a public function returns."""
    function = getattr(lt, verb)
    annotation = inspect.signature(function).return_annotation
    kind = function.__globals__.get(annotation) if isinstance(annotation, str) else annotation
    return kind.__annotations__["truth"] if verb == "simulate" else kind


@pytest.mark.parametrize(("verb", "file"), FILE_OF.items())
def test_the_result_of_a_verb_is_the_model_of_its_file(verb: str, file: str) -> None:
    kind = returned(verb)
    assert issubclass(kind, ResultFile) and issubclass(kind, Result)
    assert FILES[file] is kind and file == kind.FILE and kind in RESULTS
    assert descriptions(kind).keys() == kind.model_fields.keys(), f"{kind.__name__} has a field without a description"


def test_every_verb_with_a_file_is_listed() -> None:
    """A verb that returns a model of a file is in the list, and a file has one model."""
    verbs = [name for name in lt.__all__ if inspect.isfunction(getattr(lt, name))]
    models = {name for name in verbs if inspect.isclass(kind := returned(name)) and issubclass(kind, ResultFile)}
    assert models == set(FILE_OF)
    assert set(FILE_OF.values()) | set(OBJECTS.values()) <= set(FILES)
    assert len({model.FILE for model in RESULTS}) == len(RESULTS)
    assert set(OBJECTS) <= set(lt.__all__) and not set(OBJECTS) & set(FILE_OF)
