"""Comparison of the injected effects of a simulated recording with its diagnosis, in a report."""

from __future__ import annotations

from itertools import zip_longest
from typing import Any

import numpy as np

from ltsim.core.errors import LtsimError
from ltsim.core.notation import MISSING_TEXT, number_text, with_sigma
from ltsim.core.results import Table, text_columns
from ltsim.core.units import SI_PER_UNIT
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.schema import Finding
from ltsim.diagnosis.sentences import finding_title
from ltsim.physics.effects import effect_title, parameter_text
from ltsim.physics.effects.verbs import make_effect
from ltsim.recordings.recording import OBSERVABLES
from ltsim.reports import figures
from ltsim.reports.document_model import Block, PictureBlock, table_blocks
from ltsim.reports.formatting import names_text, typographic_text
from ltsim.reports.residuals import OBSERVABLE_UNITS
from ltsim.reports.sections.network import AdjustmentsWithoutAndWithParameters
from ltsim.simulation.truth import AppliedEffect, Truth

INJECTED_EFFECTS_TABLE = Table(
    "injected.csv",
    "injected effects of a simulated recording, and the findings",
    text_columns(
        quantity="effect, its place, or a parameter", injected="true value", diagnosed="estimate +- one sigma"
    ),
)
"""Table of the injected effects of a simulated recording, and of the findings of its diagnosis."""


def effect_place_text(effect: Any) -> str:
    """Text with the stations and targets at which an effect acts."""
    return names_text([*effect.stations, *effect.targets]) or "everywhere"


def truth_blocks(
    content: Diagnosis, truth: Truth, adjustments: AdjustmentsWithoutAndWithParameters | None
) -> list[Block]:
    """Figure and table that compare the injected effects of a simulated recording with the findings of a diagnosis.

    `truth` has the injected effects. `adjustments` are those without and with instrument parameters, from which the
    changes of the readings are computed.
    """
    applied_by_name = {applied.effect.name: applied for applied in truth.applied_effects}
    effects_of_findings = [applied_by_name.get(f.effect) for f in content.findings]
    effects_of_findings += [
        applied for name, applied in applied_by_name.items() if name not in {f.effect for f in content.findings}
    ]
    table_rows = [
        row
        for injected, finding in zip_longest(effects_of_findings, content.findings)
        for row in _injected_and_finding_rows(injected, finding)
    ]
    note = "Injected values are from truth.json, which the diagnosis does not read; estimates +- one sigma."
    table = table_blocks("Injected and diagnosed", INJECTED_EFFECTS_TABLE.with_rows(table_rows), note=note)
    return [*_injected_and_estimated_curves(content, truth.applied_effects[0], adjustments), *table]


def _injected_and_finding_rows(injected: AppliedEffect | None, finding: Finding | None) -> list[list[str]]:
    """Table rows of an injected effect and its finding: effect, stations and targets, sizes, shape parameters.

    `finding` is None if the effect was not detected.
    """
    true_values: dict[str, tuple[float | None, str]] = {}
    if injected is not None:
        sizes = zip(injected.effect.parameters, injected.parameter_values, strict=True)
        true_values = {p.name: (value / p.si_per_display_unit, p.unit) for p, value in sizes}
        true_values |= {
            s.name: (getattr(injected.effect, s.name) / SI_PER_UNIT[s.unit], s.unit)
            for s in injected.effect.shape_parameters
        }
    estimate_by_name = {} if finding is None else {p.name: p for p in finding.parameters}
    place_texts = [
        effect_place_text(x) if x else MISSING_TEXT for x in (injected and injected.effect, finding and finding.where)
    ]
    table_rows = [
        [
            "effect",
            effect_title(injected.effect.name) if injected else MISSING_TEXT,
            finding_title(finding) if finding else "not detected",
        ],
        ["where", *place_texts],
    ]
    for name in dict.fromkeys([*true_values, *estimate_by_name]):
        estimate = estimate_by_name.get(name)
        value, unit = true_values.get(name, (None, estimate.unit if estimate else ""))
        text = with_sigma(estimate.value, estimate.sigma) if estimate else MISSING_TEXT
        table_rows.append(
            [f"{parameter_text(name)} [{unit}]" if unit else parameter_text(name), number_text(value), text]
        )
    return table_rows


def _injected_and_estimated_curves(
    content: Diagnosis, applied_effect: AppliedEffect, adjustments: AdjustmentsWithoutAndWithParameters | None
) -> list[Block]:
    """List with a figure of injected and estimated changes of readings; empty for an undetected effect."""
    finding = next((f for f in content.findings if f.effect == applied_effect.effect.name), None)
    if adjustments is None or finding is None:
        return []
    estimates, sightings, injected = (
        {p.name: p.value for p in finding.parameters},
        adjustments[1].sightings,
        applied_effect.effect,
    )
    try:
        shape = {s.name: estimates[s.name] for s in injected.shape_parameters if s.name in estimates}
        effect = make_effect(
            injected.name, {"stations": finding.where.stations, "targets": finding.where.targets}, shape
        )
        values = np.array([estimates.get(p.name, 0.0) * p.si_per_display_unit for p in injected.parameters])
        injected_changes, estimated_changes = (
            injected.reading_change(sightings, applied_effect.parameter_values),
            effect.reading_change(sightings, values),
        )
    except LtsimError:
        return []
    column = int(np.argmax(np.abs(injected_changes).max(axis=0) * [1.0, *2 * [float(np.median(sightings.range_))]]))
    rows, observable = np.abs(injected_changes).max(axis=1) > 0, OBSERVABLES[column]
    unit = OBSERVABLE_UNITS[observable]
    is_over_distance = "distance" in injected.covariates
    covariate = sightings.range_[rows] if is_over_distance else sightings.time[rows] / 60.0
    injected_values, estimated_values = (
        shift[rows, column] / SI_PER_UNIT[unit] for shift in (injected_changes, estimated_changes)
    )
    axis_labels = (
        "distance [m]" if is_over_distance else "time [min]",
        f"change of the {observable} [{typographic_text(unit)}]",
    )
    cause = f"{effect_title(injected.name)} ({effect_place_text(injected)})"
    text = f"Change of the {observable} readings by {cause}: injected and estimated."
    return [
        PictureBlock(
            "Injected and estimated",
            lambda: figures.residuals.injected_and_estimated_figure(
                covariate, injected_values, estimated_values, *axis_labels
            ),
            text,
        )
    ]
