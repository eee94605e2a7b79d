"""What a report tells its reader to do next, from the result files of the folders it shows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ltsim.calibration.schema import CalibrationFile
from ltsim.chances import AGREES
from ltsim.diagnosis.schema import DiagnosisFile
from ltsim.pages.words import count, listing
from ltsim.planning.schema import NextFile
from ltsim.recording.result_file import read_result
from ltsim.tasks.comparison import Comparison

MOST = 5
"""Actions at the head of a page."""


def actions_of(kind: str, folder: Path) -> list[str]:
    """Sentences, the most urgent first, for a folder whose file `kind` is readable; empty where nothing follows."""
    return WRITERS[kind](folder) if kind in WRITERS else []


def headline(kind: str, mood: str) -> str:
    """The verdict in a few words; empty for a kind that gives none."""
    first = kind.split(" ", maxsplit=1)[0]
    return HEADLINES.get((first, mood), "")


HEADLINES = {
    ("Recording", "good"): "The recording agrees with itself.",
    ("Recording", "bad"): "The recording does not agree with itself.",
    ("Calibration", "good"): "The calibration can be used.",
    ("Calibration", "bad"): "The calibration should not be used yet.",
    ("Network", "good"): "The network agrees with itself.",
    ("Network", "bad"): "The network does not agree with itself.",
    ("Diagnosis", "good"): "Nothing was found wrong.",
    ("Diagnosis", "bad"): "Something is wrong with this recording.",
    ("History", "good"): "The instrument has not changed.",
    ("History", "bad"): "The instrument has changed.",
    ("Acceptance", "good"): "The limits are kept.",
    ("Acceptance", "bad"): "The limits are not kept.",
    ("Comparison", "good"): "No point moved.",
    ("Comparison", "bad"): "Points moved.",
}


def _calibration(folder: Path) -> list[str]:
    content = read_result(folder, CalibrationFile)
    said = []
    left = [o for o in content.outliers if not o.left_out]
    if left:
        which = listing([f"{o.station} to {o.target} ({o.observable}, row {o.row})" for o in left], 3)
        said.append(f"Measure again or leave out {count(len(left), 'reading')} that did not fit: {which}.")
    test = content.fit.p_value
    if test is not None and test < AGREES / 2 and not content.noise_estimated:
        said.append("Find out why readings and model disagree: ltsim diagnose names what is missing from the model.")
    cures = dict.fromkeys(entry.cure.partition(" (gain ")[0] for entry in content.undetermined if entry.cure)
    said += [f"To determine what is still open: {cure.rstrip('.')}." for cure in list(cures)[:3]]
    if content.parameters and not said:
        said.append("Apply the calibration to later readings: ltsim correct.")
    return said


def _diagnosis(folder: Path) -> list[str]:
    content = read_result(folder, DiagnosisFile)
    said = [_sentence(finding.separate_by) for finding in content.findings if finding.separate_by]
    for finding in content.findings:
        where = finding.where
        trackers = [f"instrument {name}" for name in where.instruments]
        place = listing([*trackers, *where.stations, *where.targets]) or "the whole recording"
        follows = f" with {listing(where.covariates)}" if where.covariates else ""
        unnamed = f"what changes the {finding.carrier or 'readings'}{follows}"
        cause = f"the cause of {finding.effect}" if finding.known else unnamed
        said.append(f"Look for {cause} ({place}); targets.csv holds coordinates that allow for it.")
    return said


def _next(folder: Path) -> list[str]:
    return [_sentence(proposal.do) for proposal in read_result(folder, NextFile).proposals[:2]]


def _comparison(folder: Path) -> list[str]:
    moved = [d.target for d in read_result(folder, Comparison).displacements if d.moved]
    said = f"Look at what moved, and measure it again before it is used as a reference: {listing(moved)}."
    return [said] if moved else []


def _sentence(words: str) -> str:
    return f"{words[:1].upper()}{words[1:].rstrip('.')}."


WRITERS: dict[str, Callable[[Path], list[str]]] = {
    "diagnosis.json": _diagnosis,
    "calibration.json": _calibration,
    "comparison.json": _comparison,
    "next.json": _next,
}
