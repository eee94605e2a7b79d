"""Section of a diagnosis: verdict, findings, evidence, and a comparison with the truth of a simulation."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ltsim.adjustment.identification.selection import MAX_LOG_EVIDENCE_GAIN
from ltsim.calibration.schema import RESIDUALS_TABLE
from ltsim.core.errors import LtsimError
from ltsim.core.notation import MISSING_TEXT, number_text, with_sigma
from ltsim.core.probability import p_text, two_sided
from ltsim.core.results import Table, texts
from ltsim.core.units import SI_PER_UNIT
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.schema import BEFORE, TARGETS, UNDETECTABLE, Finding, Misfit, Where
from ltsim.diagnosis.words import clear_constants, effect_words, parameter_words
from ltsim.physics.effects import title_of
from ltsim.physics.effects.verbs import make_effect
from ltsim.recordings.recording import OBSERVABLES
from ltsim.recordings.result_file import require_same_recording
from ltsim.reports import figures
from ltsim.reports.document import (
    Block,
    BulletList,
    Fact,
    Note,
    Picture,
    ReportContext,
    Section,
    TableBlock,
    mood,
    table_block,
    table_of,
)
from ltsim.reports.residuals import OBSERVABLE_UNIT, Residuals
from ltsim.reports.sections.network import (
    Pair,
    adjusted_if_possible,
    combined,
    over_covariates,
    scene,
    target_table,
    truth_of,
)
from ltsim.reports.words import count, listing, sentence, typeset
from ltsim.simulation.truth import AppliedEffect, Truth

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INJECTED = Table(
    "injected.csv",
    "injected effects of a simulated recording beside the findings",
    texts(quantity="effect, its place, or a parameter", injected="true value", diagnosed="estimate +- one sigma"),
)
MAX_MARKED = 12
"""Largest number of targets that are marked in one picture."""
MIN_ERROR_UM = 0.1
"""Threshold [um] below which the error that an undetectable effect causes in targets is negligible."""
MAX_INSPECTIONS = 2
"""Largest number of actions besides the use of the coordinates."""
MAX_STEPS = 3
"""Number of points up to which a response is drawn as steps and not as a curve."""


def diagnosis_section(content: Diagnosis, context: ReportContext) -> Section:
    """Section of a `diagnosis.json`; with a truth in its folder it begins with a comparison of both.

    Residuals without the findings are read from `residuals_before.csv`, those with them from `residuals.csv`.

    Raises
    ------
    RecordError
        When a file is malformed.
    """
    recording = context.recording
    require_same_recording(content, recording, context.folder or Path())
    pair = adjusted_if_possible(recording)
    before, after = _residuals(content, context, pair)
    truth = truth_of(context)
    blocks: list[Block] = _against_truth(content, truth, pair) if truth is not None and truth.effects else []
    if pair is not None and context.detail == "turn" and blocks:
        from ltsim.reports.workshop import from_adjustment

        blocks = [scene(from_adjustment(pair[1], plain=pair[0])), *blocks]
    lead = len(blocks)
    for number_, finding in enumerate(content.findings, start=1):
        blocks += _finding(finding, number_, sentence(content.summary), pair, (before, after))
    blocks += target_table(context.file(TARGETS.file, content), note="Adjusted with the findings in the model.")
    modelled = ", with the findings in the model" if content.findings else ""
    if constants := clear_constants(content.instruments):
        blocks.append(Note(f"Most significant constants of the instruments{modelled}", f"{'; '.join(constants)}."))
    blocks += _hidden(content)
    shown = len(blocks)
    blocks += _fit(content)
    if after is not None and pair is not None:
        blocks += over_covariates(after)
    for entry in content.instruments:
        name = f" of {entry.name}" if entry.name else ""
        title = f"Constants{name}{modelled}"
        blocks += table_of(title, entry.parameters, "name=constant", "value+-sigma", "unit")
        blocks += combined(f"Determined combinations{name}", entry.determined)
    blocks += _detectability(content)
    named = (recording.setup.title if recording else "") or (content.recording.title if content.recording else "")
    answer, notice = sentence(content.summary), ""
    if truth is not None and truth.effects:
        what = listing([f"{title_of(a.effect.name)} ({_place_of(a.effect)})" for a in truth.applied_effects])
        notice = f"This recording is simulated, with {what} injected on purpose; the diagnosis does not read the truth."
    return Section(
        f"Diagnosis: {named}" if named else "Diagnosis of a tracker network", "Diagnosis", answer,
        mood(content.verdict == "consistent"), _facts(content), blocks, shown=shown, lead=lead, terminal_blocks=shown,
        actions=_actions(content), notice=notice,
    )  # fmt: skip


def _actions(content: Diagnosis) -> list[str]:
    """Next actions: the measurement that separates explanations, places to inspect, coordinates to use."""
    if not content.findings:
        return []
    separate = [sentence(finding.separate_by) for finding in content.findings if finding.separate_by]
    inspect = [_inspection(finding) for finding in content.findings]
    use = "Use the coordinates in targets.csv, which account for the findings."
    return [*separate[:1], *dict.fromkeys(inspect[: MAX_INSPECTIONS - len(separate[:1])]), use]


def _inspection(finding: Finding) -> str:
    """Action at the place of a finding."""
    where = finding.where
    trackers = [f"instrument {name}" for name in where.instruments]
    place = listing([*trackers, *where.stations, *where.targets]) or "the whole recording"
    if _swapped(finding):
        names = listing(where.targets)
        if not where.stations:
            return f"Exchange the reference coordinates of {names} in setup.toml."
        return f"Exchange the names {names} at {listing(where.stations)}."
    if finding.effect == "noise-level":
        return "Set the noise in setup.toml to the estimated values."
    if finding.carrier.startswith("reference"):
        return f"Check the {finding.carrier} ({place})."
    follows = f" with {listing(where.covariates)}" if where.covariates else ""
    change = f"change of the {finding.carrier or 'readings'}{follows}"
    title = title_of(finding.effect) if finding.is_catalogued else change
    return f"Inspect {place} for the cause: {title}."


def _swapped(finding: Finding) -> bool:
    """True if the names of two reflectors were exchanged."""
    return finding.effect == "target-swap" and len(finding.where.targets) == 2


def _facts(content: Diagnosis) -> list[Fact]:
    test = content.global_test
    plain = test.p_value if test.dof > 0 else None
    verdict = mood(content.verdict == "consistent")
    facts = [
        Fact("findings", str(len(content.findings)), verdict),
        Fact("global test, two-sided p", p_text(None if plain is None else two_sided(plain))),
    ]
    if test.search_p_value is not None:
        facts.append(Fact("whole search, p", p_text(test.search_p_value)))
    if content.fit is not None:
        ratios = dict.fromkeys(_ratio(fit) for fit in (content.fit.before, content.fit.after))
        facts.append(Fact("chi2 per degree of freedom", " to ".join(ratios)))
    return facts


def _ratio(fit: Misfit) -> str:
    return f"{fit.chi2 / fit.dof:.3f}" if fit.dof > 0 and fit.chi2 is not None else MISSING_TEXT


def _residuals(
    content: Diagnosis, context: ReportContext, pair: Pair | None
) -> tuple[Residuals | None, Residuals | None]:
    """Residuals without and with the findings, with covariates from the geometry of the recording."""
    file, stored = (context.file(name, content) for name in (RESIDUALS_TABLE.file, BEFORE.file))
    geometry = Residuals.from_adjustment(pair[0]) if pair is not None else None
    after, before = (Residuals.read(f).with_covariates(geometry) if f is not None else None for f in (file, stored))
    return (before if after is not None else None), after


def _finding(
    finding: Finding, number_: int, answer: str, pair: Pair | None, residuals: tuple[Residuals | None, Residuals | None]
) -> list[Block]:
    """Blocks of a finding: its sentence unless it is in the answer, figure, place, and table of values."""
    name = effect_words(finding.effect)
    words = finding.sentence or f"{name} {_place(finding.where)}"
    cure = f" To separate it from the alternatives: {finding.separate_by.rstrip('.')}." if finding.separate_by else ""
    new = finding.formula not in finding.sentence
    formula = f" Proposed term: {finding.formula}." if finding.formula and new else ""
    text = f"{words.rstrip('.')}.{formula}{cure}"
    blocks: list[Block] = [] if text in answer else [Note(f"Finding {number_}: {name}", text, "bad")]
    drawn = finding_drawing(finding, *residuals)
    if drawn is not None:
        text = "Residuals without the finding (left) and with the finding in the model (right)."
        if finding.curve is not None and len(finding.curve.at) >= MAX_STEPS:
            text = f"Estimated change of the {finding.carrier} over {finding.curve.covariate}."
        blocks.append(Picture(f"Effect of finding {number_}", drawn, text))
    blocks += _whereabouts(finding, number_, pair)
    evidence = finding.evidence
    sizes = [p.model_copy(update={"name": parameter_words(p.name)}) for p in finding.parameters]
    lines = [
        f"where: {_place(finding.where)}",
        "without it, no network fits the readings"
        if evidence.chi2_drop >= MAX_LOG_EVIDENCE_GAIN
        else f"chi2 falls by {number_text(evidence.chi2_drop)} for {count(evidence.parameters, 'parameter')}",
        f"p, corrected for the search: {p_text(evidence.p_value)}",
        f"probability: {100 * evidence.probability:.3g} %",
        *(f"alternative: {effect_words(e.effect)}, {100 * e.probability:.2g} %" for e in finding.equivalents),
    ]
    blocks += table_of(f"Finding {number_} in figures", sizes, "name=parameter", "value+-sigma", "unit")
    return [*blocks, BulletList(f"Evidence of finding {number_}", lines)]


def finding_drawing(finding: Finding, before: Residuals | None, after: Residuals | None) -> Callable[[], Figure] | None:
    """Figure of a finding: its response over its regressor if it has a curve, else residuals without and with it.

    It is None for blunders such as gross errors and exchanged names, which are removed from both residuals.
    """
    curve = finding.curve
    if curve is not None and len(curve.at) >= MAX_STEPS:
        return lambda: figures.residuals.driver_curve(curve, finding.carrier, before)
    is_mistake = finding.evidence.p_value is None
    if before is None or after is None or is_mistake or np.array_equal(before.residual, after.residual):
        return None
    where = finding.where
    wanted = [before.order if name == "time" else name for name in (*where.covariates, "time", "elevation", "row")]
    available = [name for name in wanted if name in before.covariates and name in after.covariates]
    place = where.stations, where.targets
    if not available or not before.at(*place).any() or not after.at(*place).any():
        return None
    return lambda: figures.residuals.signature_figure(before, after, available[0], where)


def _whereabouts(finding: Finding, number_: int, pair: Pair | None) -> list[Block]:
    """Floor plan with the place of a finding in the hall, at few stations or targets, or with the exchanged targets."""
    from ltsim.reports.workshop import from_adjustment

    stations, targets = finding.where.stations, finding.where.targets
    centre = {p.name.removeprefix("centre-"): p for p in finding.parameters if p.name in ("centre-x", "centre-y")}
    if pair is None or not (targets or centre) or len(targets) > MAX_MARKED:
        return []
    swapped = _swapped(finding)
    marked, pairs = (*stations, *targets), [(targets[0], targets[1])] if swapped else []
    text = "The names of the red targets were exchanged: each reading belongs to the other end of the arrow."
    caption = text if swapped else "Seen from above, in red."
    caption += " The shaded area is the place in the hall, two standard deviations wide." if centre else ""
    workshop = from_adjustment(pair[1])
    area = {axis: (p.value, 2.0 * p.sigma) for axis, p in centre.items()}
    figure = partial(figures.floor_plan.whereabouts, workshop, marked, pairs, area)
    return [Picture(f"Place of finding {number_}", figure, caption)]


def _place(where: Where) -> str:
    parts = [
        f"{word} {listing(list(names))}"
        for word, names in (
            ("in", where.observables),
            ("of instrument", where.instruments),
            ("at station", where.stations),
            ("at target", where.targets),
            ("along", where.covariates),
        )
        if names
    ]
    return ", ".join(parts) or "everywhere"


def _place_of(effect: Any) -> str:
    return listing([*effect.stations, *effect.targets]) or "everywhere"


def _fit(content: Diagnosis) -> list[TableBlock]:
    note = (
        "Held-out error: 5-fold cross-validated prediction error over the declared noise (or the estimated noise, if "
        "larger); 1 is the limit set by the noise."
    )
    return table_block("Fit before and after", content.table("fit"), note=note)


def _hidden(content: Diagnosis) -> list[TableBlock]:
    """Table of undetectable effects that cause relevant errors, the largest first."""
    relevant = [
        u for u in content.undetectable if u.undetected_target_error_um and u.undetected_target_error_um >= MIN_ERROR_UM
    ]
    worst = sorted(relevant, key=lambda u: -(u.undetected_target_error_um or 0.0))
    named = [u.model_copy(update={"effect": title_of(u.effect)}) for u in worst]
    table = UNDETECTABLE.filled(named).with_columns("effect undetected_target_error_um detectable_at_factor")
    cures = " or ".join(dict.fromkeys(u.cure for u in worst if u.cure))
    note = "Poses, targets and instrument constants absorb these effects at a plausible worst-case size."
    note += f" To detect them: {cures}." if cures else ""
    return table_block("Undetectable in this recording", table, note=note)


def _detectability(content: Diagnosis) -> list[TableBlock]:
    """Table of the smallest detectable sizes of effects."""
    note = (
        "Size at which about 80 % of the recordings of this network give a mismatch, for a median place; naming may "
        "need a larger effect."
    )
    return table_of("Smallest detectable size", content.detectable, "effect", "parameter", "size", "unit", note=note)


def _against_truth(content: Diagnosis, truth: Truth, pair: Pair | None) -> list[Block]:
    """Comparison of the injected effects of a simulated recording with the diagnosis, as curve and table."""
    named = {a.effect.name: a for a in truth.applied_effects}
    ordered = [named.get(f.effect) for f in content.findings]
    ordered += [a for name, a in named.items() if name not in {f.effect for f in content.findings}]
    rows = [
        row for injected, finding in zip_longest(ordered, content.findings) for row in _pair_rows(injected, finding)
    ]
    note = "Injected values are from truth.json, which the diagnosis does not read; estimates +- one sigma."
    table = table_block("Injected and diagnosed", INJECTED.filled(rows), note=note)
    return [*_curves(content, truth.applied_effects[0], pair), *table]


def _pair_rows(injected: AppliedEffect | None, finding: Finding | None) -> list[list[str]]:
    """Rows of an injected effect and its finding: effect, place, values, shape constants."""
    true: dict[str, tuple[float | None, str]] = {}
    if injected is not None:
        sizes = zip(injected.effect.parameters, injected.parameter_values, strict=True)
        true = {p.name: (value / p.si_per_display_unit, p.unit) for p, value in sizes}
        true |= {
            s.name: (getattr(injected.effect, s.name) / SI_PER_UNIT[s.unit], s.unit)
            for s in injected.effect.shape_parameters
        }
    values = {} if finding is None else {p.name: p for p in finding.parameters}
    where = [_place_of(x) if x else MISSING_TEXT for x in (injected and injected.effect, finding and finding.where)]
    rows = [
        [
            "effect",
            title_of(injected.effect.name) if injected else MISSING_TEXT,
            effect_words(finding.effect) if finding else "not detected",
        ],
        ["where", *where],
    ]
    for name in dict.fromkeys([*true, *values]):
        estimate = values.get(name)
        value, unit = true.get(name, (None, estimate.unit if estimate else ""))
        text = with_sigma(estimate.value, estimate.sigma) if estimate else MISSING_TEXT
        rows.append([f"{parameter_words(name)} [{unit}]" if unit else parameter_words(name), number_text(value), text])
    return rows


def _curves(content: Diagnosis, applied: AppliedEffect, pair: Pair | None) -> list[Block]:
    finding = next((f for f in content.findings if f.effect == applied.effect.name), None)
    if pair is None or finding is None:
        return []
    estimates, sightings, injected = {p.name: p.value for p in finding.parameters}, pair[1].sightings, applied.effect
    try:
        shape = {s.name: estimates[s.name] for s in injected.shape_parameters if s.name in estimates}
        effect = make_effect(
            injected.name, {"stations": finding.where.stations, "targets": finding.where.targets}, shape
        )
        values = np.array([estimates.get(p.name, 0.0) * p.si_per_display_unit for p in injected.parameters])
        true, fitted = (
            injected.reading_change(sightings, applied.parameter_values),
            effect.reading_change(sightings, values),
        )
    except LtsimError:
        return []
    column = int(np.argmax(np.abs(true).max(axis=0) * [1.0, *2 * [float(np.median(sightings.range_))]]))
    rows, observable = np.abs(true).max(axis=1) > 0, OBSERVABLES[column]
    unit = OBSERVABLE_UNIT[observable]
    far = "distance" in injected.covariates
    at = sightings.range_[rows] if far else sightings.time[rows] / 60.0
    hid, got = (shift[rows, column] / SI_PER_UNIT[unit] for shift in (true, fitted))
    names = "distance [m]" if far else "time [min]", f"change of the {observable} [{typeset(unit)}]"
    cause = f"{title_of(injected.name)} ({_place_of(injected)})"
    text = f"Change of the {observable} readings by {cause}: injected and estimated."
    return [
        Picture("Injected and estimated", lambda: figures.residuals.injected_and_estimated(at, hid, got, *names), text)
    ]
