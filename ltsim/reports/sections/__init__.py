"""Sections of a report: a function for each kind of result makes a `Section` from the content of its file."""

from importlib import import_module
from pathlib import Path
from typing import Any

from ltsim.recordings.result_file import ResultFile, read_result
from ltsim.reports.document_model import Section, SectionContext

SECTION_FUNCTION_BY_RESULT_FILE = {
    "diagnosis.json": ("diagnosis", "Diagnosis", "diagnosis_section"),
    "calibration.json": ("calibration", "Calibration", "calibration_section"),
    "plan.json": ("plan", "Plan", "plan_section"),
    "history.json": ("simple_sections", "History", "history_section"),
    "uncertainty.json": ("simple_sections", "Uncertainty", "uncertainty_section"),
    "check.json": ("simple_sections", "Check", "check_section"),
    "comparison.json": ("simple_sections", "Comparison", "comparison_section"),
    "accept.json": ("simple_sections", "AcceptanceFile", "acceptance_section"),
    "next.json": ("simple_sections", "NextMeasurement", "next_measurement_section"),
}
"""Module, data model and section function of each result file; a module is imported on first use."""


def read_content(folder: Path, file: str) -> ResultFile:
    """Content of a result file in a folder; raises RecordError."""
    module, model, _ = SECTION_FUNCTION_BY_RESULT_FILE[file]
    content: ResultFile = read_result(folder, getattr(_import_section_module(module), model))
    return content


def result_section(content: ResultFile, context: SectionContext | None = None) -> Section:
    """Section of a result for a page or a terminal."""
    module, _, function = SECTION_FUNCTION_BY_RESULT_FILE[content.FILE]
    section: Section = getattr(_import_section_module(module), function)(content, context or SectionContext())
    return section


def _import_section_module(name: str) -> Any:
    """Module `name` of this package."""
    return import_module(f"{__name__}.{name}")
