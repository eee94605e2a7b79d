"""What was hidden in a simulated recording, beside what its diagnosis found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

from ltsim.diagnosis.schema import DiagnosisFile, Finding
from ltsim.pages import style
from ltsim.pages.document import Section, Table
from ltsim.pages.words import listing
from ltsim.recording.result_file import read_result
from ltsim.simulation.truth import read_truth

TRUTH = "truth.json"


def beside_truth(section: Section, folder: Path) -> Section:
    """The section of a diagnosis; where a truth lies beside it, hidden and found stand side by side in front.

    Raises
    ------
    RecordError
        When the truth is malformed.
    """
    if not (folder / TRUTH).is_file():
        return section
    hidden: Sequence[Mapping[str, Any]] = read_truth(folder / TRUTH).to_json()["effects"]
    if not hidden:
        return section
    found = read_result(folder, DiagnosisFile).findings
    rows = [row for one, other in zip_longest(_in_order(hidden, found), found) for row in _rows(one, other)]
    what = listing([f"{h['effect']} ({_place(h['stations'], h['targets'])})" for h in hidden])
    begin = f"On purpose, {what} was hidden in this simulated recording."
    answer = f"{begin} The diagnosis, which was not told: {section.answer}"
    note = "From truth.json, which the diagnosis does not open; a found value carries its standard deviation."
    table = Table("Hidden on purpose, and found", ["", "hidden", "found"], rows, 1, note)
    return replace(section, answer=answer, blocks=[table, *section.blocks])


def _in_order(hidden: Sequence[Mapping[str, Any]], found: Sequence[Finding]) -> list[Mapping[str, Any] | None]:
    """The hidden effects in the order of the findings that name them; those that nobody found come last."""
    names = [finding.effect for finding in found]
    named = {h["effect"]: h for h in hidden}
    return [named.get(name) for name in names] + [h for h in hidden if h["effect"] not in names]


def _rows(hidden: Mapping[str, Any] | None, found: Finding | None) -> list[list[str]]:
    """Effect, place and values of one pair."""
    entries = {} if hidden is None else {p["name"]: p for p in hidden["parameters"]}
    values = {} if found is None else {p.name: p for p in found.parameters}
    rows = [
        ["effect", hidden["effect"] if hidden else "–", found.effect if found else "not found"],
        [
            "where",
            _place(hidden["stations"], hidden["targets"]) if hidden else "–",
            _place(found.where.stations, found.where.targets) if found else "–",
        ],
    ]
    for name in dict.fromkeys([*entries, *values]):
        true, estimate = entries.get(name), values.get(name)
        unit = style.unit_text(true["unit"] if true else estimate.unit if estimate else "")
        rows.append(
            [
                f"{name} [{unit}]" if unit else name,
                style.number(true["value"]) if true else "–",
                style.with_sigma(estimate.value, estimate.sigma or 0.0) if estimate else "–",
            ]
        )
    return rows


def _place(stations: Sequence[str], targets: Sequence[str]) -> str:
    return listing([*stations, *targets]) or "everywhere"
