"""Each result is declared once: the class that a verb returns is the class that its file validates to."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import pkgutil
import sys
from typing import Any

import pytest

import ltsim
import ltsim as lt
from ltsim.campaigns.statistics import CampaignStatistics
from ltsim.campaigns.summary import CampaignSummary, SolverComparison, StatisticSummary, ZScoreSummary
from ltsim.cli.main import run
from ltsim.core.descriptions import field_descriptions
from ltsim.core.results import Result
from ltsim.physics.effects.descriptions import EffectDescription, ParameterDescription, ShapeParameterDescription
from ltsim.recordings.result_file import ResultFile
from ltsim.reports.schemas import MODEL_BY_FILE_NAME, RESULT_MODELS

FILE_OF: dict[str, str] = {
    "accept": "accept.json",
    "adjust": "calibration.json",
    "bench": "bench.json",
    "calibrate": "calibration.json",
    "check": "check.json",
    "compare": "comparison.json",
    "diagnose": "diagnosis.json",
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
WITHOUT_FILE: dict[str, str] = {
    "add_effect": "class of the user",
    "campaign": "rows on the disk; their summary is one model",
    "catalogue": "one model, which no command writes",
    "compare_calibrations": "table",
    "convert": "recording",
    "correct": "recording",
    "inject": "recording and the injected effects",
    "injection_curve": "table",
    "read": "any of the results",
    "recovery_checks": "entries of a recovery",
    "report": "page",
    "scenario": "file of the user",
    "station_alternatives": "layouts",
    "view": "picture",
    "write": "files",
}
"""Public functions whose result is no model of a file, with what it is."""
SHARED = 3
"""Names of fields that a data class may have in common with a result without repeating it."""


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
    assert MODEL_BY_FILE_NAME[file] is kind and file == kind.FILE and kind in RESULT_MODELS
    assert field_descriptions(kind).keys() == kind.model_fields.keys(), (
        f"{kind.__name__} has a field without a description"
    )


def test_the_summary_of_a_campaign_is_a_single_model() -> None:
    """What `ltsim campaign --json` prints: its entries are those that Python, figures and pages use."""
    statistics = CampaignSummary, StatisticSummary, ZScoreSummary, SolverComparison
    assert all(field_descriptions(kind).keys() == kind.model_fields.keys() for kind in statistics)
    signature = inspect.signature(CampaignStatistics.summary)
    assert signature.return_annotation in (CampaignSummary, "CampaignSummary")


def test_the_catalogue_of_effects_is_a_single_model(capsys: pytest.CaptureFixture[str]) -> None:
    """`ltsim effects --json` prints the descriptions that `lt.catalogue` returns."""
    kinds = EffectDescription, ParameterDescription, ShapeParameterDescription
    assert all(field_descriptions(kind).keys() == kind.model_fields.keys() for kind in kinds)
    assert run(["effects", "station-settling", "--json"]) == 0
    (effect,) = lt.catalogue("station-settling").descriptions
    assert json.loads(capsys.readouterr().out) == effect.model_dump(mode="json")


def test_every_verb_with_a_file_is_listed() -> None:
    """A verb that returns a model of a file is in the list, and a file has one model."""
    verbs = [name for name in lt.__all__ if inspect.isfunction(getattr(lt, name))]
    kinds = {name: returned(name) for name in verbs if name != "simulate"}
    models = {name for name, kind in kinds.items() if inspect.isclass(kind) and issubclass(kind, ResultFile)}
    assert models | {"simulate"} == set(FILE_OF)
    assert set(verbs) - {"Effect"} == {*FILE_OF, *WITHOUT_FILE}
    assert len({model.FILE for model in RESULT_MODELS}) == len(RESULT_MODELS)


def test_no_result_is_declared_twice() -> None:
    """Every model of a result file is registered, and no data class repeats most of the fields of one."""
    for module in pkgutil.walk_packages(ltsim.__path__, "ltsim."):
        if module.name.rpartition(".")[2] != "__main__":
            importlib.import_module(module.name)
    classes = {
        kind
        for name, module in sys.modules.items()
        if name.partition(".")[0] == "ltsim"
        for kind in vars(module).values()
        if inspect.isclass(kind) and kind.__module__ == name
    }
    assert {kind for kind in classes if issubclass(kind, ResultFile)} - {ResultFile} == set(RESULT_MODELS)
    fields = {model.__name__: set(model.model_fields) - set(ResultFile.model_fields) for model in RESULT_MODELS}
    assert [
        f"{kind.__name__} repeats {name}"
        for kind in classes
        if dataclasses.is_dataclass(kind)
        for name, declared in fields.items()
        if len(declared & {f.name for f in dataclasses.fields(kind)}) > max(SHARED, len(declared) / 2)
    ] == []
