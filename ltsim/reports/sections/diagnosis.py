"""Section of a diagnosis: verdict, findings, evidence, and a comparison with the truth of a simulation."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ltsim.adjustment.identification.cause_selection import MAX_LOG_EVIDENCE_GAIN
from ltsim.calibration.schema import RESIDUALS_TABLE
from ltsim.core.errors import ModelError
from ltsim.core.notation import MISSING_TEXT, number_text
from ltsim.core.probability import p_text, two_sided
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.schema import (
    DIAGNOSED_TARGETS_TABLE,
    RESIDUALS_BEFORE_TABLE,
    UNDETECTABLE_TABLE,
    Finding,
    FindingScope,
    Misfit,
)
from ltsim.diagnosis.words import clear_constants_texts, effect_text, parameter_text
from ltsim.physics.effects import find_effect, title_of
from ltsim.physics.effects.catalogue import catalogue_entry
from ltsim.recordings.result_file import require_same_recording
from ltsim.reports import figures
from ltsim.reports.document import (
    Block,
    BulletListBlock,
    KeyFigure,
    NoteBlock,
    PictureBlock,
    ReportContext,
    Section,
    TableBlock,
    assessment_of,
    entries_table,
    table_block,
)
from ltsim.reports.residuals import Residuals
from ltsim.reports.sections.network import (
    AdjustmentPair,
    adjustment_pair_if_possible,
    determined_table,
    residuals_over_covariates,
    scene_block,
    target_table,
    truth_in_folder,
)
from ltsim.reports.sections.truth_comparison import effect_place_text, truth_blocks
from ltsim.reports.words import as_sentence, count_text, listing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_MARKED_TARGETS = 12
"""Largest number of targets that are marked in one picture."""
MIN_REPORTED_TARGET_ERROR_UM = 0.1
"""Threshold [um] below which the error that an undetectable effect causes in targets is negligible."""
MIN_SEPARATED_PROBABILITY = 0.05
"""Smallest probability of an alternative that is worth a measurement, by convention 5 %."""
MAX_INSPECTION_ACTIONS = 2
"""Largest number of actions besides the use of the coordinates."""
MAX_STEP_POINTS = 3
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
    pair = adjustment_pair_if_possible(recording)
    before, after = _residuals_before_and_after(content, context, pair)
    truth = truth_in_folder(context)
    blocks: list[Block] = truth_blocks(content, truth, pair) if truth is not None and truth.effects else []
    if pair is not None and context.detail == "turn" and blocks:
        from ltsim.reports.workshop import workshop_from_adjustment

        blocks = [scene_block(workshop_from_adjustment(pair[1], without_parameters=pair[0])), *blocks]
    lead = len(blocks)
    for number_, finding in enumerate(content.findings, start=1):
        blocks += _finding_blocks(finding, number_, as_sentence(content.summary), pair, (before, after))
    blocks += target_table(
        context.companion_file(DIAGNOSED_TARGETS_TABLE.file, content), note="Adjusted with the findings in the model."
    )
    modelled = ", with the findings in the model" if content.findings else ""
    if constants := clear_constants_texts(content.instruments):
        blocks.append(NoteBlock(f"Most significant constants of the instruments{modelled}", f"{'; '.join(constants)}."))
    blocks += _undetectable_table(content)
    shown = len(blocks)
    blocks += _fit_table(content)
    if after is not None and pair is not None:
        blocks += residuals_over_covariates(after)
    for entry in content.instruments:
        name = f" of {entry.name}" if entry.name else ""
        title = f"Constants{name}{modelled}"
        blocks += entries_table(title, entry.parameters, "name=constant", "value+-sigma", "unit")
        blocks += determined_table(f"Determined combinations{name}", entry.determined)
    blocks += _detectable_size_table(content)
    named = (recording.setup.title if recording else "") or (content.recording.title if content.recording else "")
    answer, notice = as_sentence(content.summary), ""
    if truth is not None and truth.effects:
        what = listing([f"{title_of(a.effect.name)} ({effect_place_text(a.effect)})" for a in truth.applied_effects])
        notice = f"This recording is simulated, with {what} injected on purpose; the diagnosis does not read the truth."
    return Section(
        f"Diagnosis: {named}" if named else "Diagnosis of a tracker network", "Diagnosis", answer,
        assessment_of(content.verdict == "consistent"), _key_figures(content), blocks,
        n_open_blocks=shown, n_lead_blocks=lead, n_terminal_blocks=shown,
        next_actions=_next_actions(content), simulation_notice=notice,
    )  # fmt: skip


def _next_actions(content: Diagnosis) -> list[str]:
    """Next actions: the measurement that separates explanations, places to inspect, coordinates to use."""
    if not content.findings:
        return []
    separate = [
        as_sentence(finding.separate_by)
        for finding in content.findings
        if finding.separate_by and _has_probable_alternative(finding)
    ]
    inspect = [_inspection_action(finding) for finding in content.findings]
    use = "Use the coordinates in targets.csv, which account for the findings"
    moved = [name for finding in content.findings if finding.effect == "target-moved" for name in finding.where.targets]
    use += f"; those of {listing(moved)} are from before the motion." if moved else "."
    return [*separate[:1], *dict.fromkeys(inspect[: MAX_INSPECTION_ACTIONS - len(separate[:1])]), use]


def _has_probable_alternative(finding: Finding) -> bool:
    """True if an alternative in the catalogue is probable enough for a measurement that excludes it."""
    return any(e.effect != "unknown" and e.probability >= MIN_SEPARATED_PROBABILITY for e in finding.equivalents)


def _inspection_action(finding: Finding) -> str:
    """Action at the place of a finding."""
    scope = finding.where
    trackers = [f"instrument {name}" for name in scope.instruments]
    place = listing([*trackers, *scope.stations, *scope.targets])
    if _is_name_exchange(finding):
        names = listing(scope.targets)
        if not scope.stations:
            return f"Exchange the reference coordinates of {names} in setup.toml."
        return f"Exchange the names {names} at {listing(scope.stations)}."
    if finding.effect == "noise-level":
        return "Set the noise in setup.toml to the estimated values."
    if finding.carrier.startswith("reference"):
        return f"Check the {finding.carrier} ({place or 'all of them'})."
    follows = f" with {listing(scope.covariates)}" if scope.covariates else ""
    change = f"change of the {finding.carrier or 'readings'}{follows}"
    title = title_of(finding.effect) if finding.is_catalogued else f"a {change}"
    action = f"Inspect {place} for the cause: {title}" if place else f"Look for {title} in all set-ups"
    return f"{action}{_confirmation(finding)}."


def _confirmation(finding: Finding) -> str:
    """Measurement that confirms an effect, from its catalogue entry; empty for a law and if none is needed."""
    if not finding.is_catalogued:
        return ""
    try:
        texts = dict(catalogue_entry(find_effect(finding.effect)).sections())
    except ModelError:  # an effect of somebody else, which is not installed here
        return ""
    measurement = texts["Separate by"].partition(";")[0].partition(":")[0].rstrip(".")
    return "" if measurement.startswith("nothing") else f"; confirmed by {measurement}"


def _is_name_exchange(finding: Finding) -> bool:
    """True if the names of two reflectors were exchanged."""
    return finding.effect == "target-swap" and len(finding.where.targets) == 2


def _key_figures(content: Diagnosis) -> list[KeyFigure]:
    test = content.global_test
    plain = test.p_value if test.dof > 0 else None
    verdict = assessment_of(content.verdict == "consistent")
    facts = [
        KeyFigure("findings", str(len(content.findings)), verdict),
        KeyFigure("global test, two-sided p", p_text(None if plain is None else two_sided(plain))),
    ]
    if test.search_p_value is not None:
        facts.append(KeyFigure("whole search, p", p_text(test.search_p_value)))
    if content.fit is not None:
        ratios = dict.fromkeys(_chi2_per_dof_text(fit) for fit in (content.fit.before, content.fit.after))
        facts.append(KeyFigure("chi2 per degree of freedom", " to ".join(ratios)))
    return facts


def _chi2_per_dof_text(fit: Misfit) -> str:
    return f"{fit.chi2 / fit.dof:.3f}" if fit.dof > 0 and fit.chi2 is not None else MISSING_TEXT


def _residuals_before_and_after(
    content: Diagnosis, context: ReportContext, adjustments: AdjustmentPair | None
) -> tuple[Residuals | None, Residuals | None]:
    """Residuals without and with the findings, with covariates from the geometry of the recording."""
    file, stored = (
        context.companion_file(name, content) for name in (RESIDUALS_TABLE.file, RESIDUALS_BEFORE_TABLE.file)
    )
    geometry = Residuals.from_adjustment(adjustments[0]) if adjustments is not None else None
    after, before = (Residuals.read(f).with_covariates(geometry) if f is not None else None for f in (file, stored))
    return (before if after is not None else None), after


def _finding_blocks(
    finding: Finding,
    finding_number: int,
    answer: str,
    adjustments: AdjustmentPair | None,
    residuals: tuple[Residuals | None, Residuals | None],
) -> list[Block]:
    """Blocks of a finding: sentence (unless the summary contains it), figure, floor plan, table of values, evidence."""
    name = effect_text(finding.effect)
    words = finding.sentence or f"{name} {_place_text(finding.where)}"
    cure = f" To separate it from the alternatives: {finding.separate_by.rstrip('.')}." if finding.separate_by else ""
    new = finding.formula not in finding.sentence
    formula = f" Proposed term: {finding.formula}." if finding.formula and new else ""
    text = f"{words.rstrip('.')}.{formula}{cure}"
    blocks: list[Block] = [] if text in answer else [NoteBlock(f"Finding {finding_number}: {name}", text, "bad")]
    drawn = finding_figure(finding, *residuals)
    if drawn is not None:
        text = "Residuals without the finding (left) and with the finding in the model (right)."
        if finding.curve is not None and len(finding.curve.at) >= MAX_STEP_POINTS:
            text = f"Estimated change of the {finding.carrier} over {finding.curve.covariate}."
        blocks.append(PictureBlock(f"Effect of finding {finding_number}", drawn, text))
    blocks += _finding_place_blocks(finding, finding_number, adjustments)
    evidence = finding.evidence
    sizes = [p.model_copy(update={"name": parameter_text(p.name)}) for p in finding.parameters]
    lines = [
        f"where: {_place_text(finding.where)}",
        "without it, no network fits the readings"
        if evidence.chi2_drop >= MAX_LOG_EVIDENCE_GAIN
        else f"chi2 falls by {number_text(evidence.chi2_drop)} for {count_text(evidence.parameters, 'parameter')}",
        f"p, corrected for the search: {p_text(evidence.p_value)}",
        f"probability: {100 * evidence.probability:.3g} %",
        *(f"alternative: {effect_text(e.effect)}, {100 * e.probability:.2g} %" for e in finding.equivalents),
    ]
    blocks += entries_table(f"Finding {finding_number} in figures", sizes, "name=parameter", "value+-sigma", "unit")
    return [*blocks, BulletListBlock(f"Evidence of finding {finding_number}", lines)]


def finding_figure(
    finding: Finding, without_finding: Residuals | None, with_finding: Residuals | None
) -> Callable[[], Figure] | None:
    """Figure of a finding: its response over its regressor if it has a curve.

    Otherwise the residuals without and with the finding.

    It is None for blunders such as gross errors and exchanged names, which are removed from both residuals.
    """
    curve = finding.curve
    if curve is not None and len(curve.at) >= MAX_STEP_POINTS:
        return lambda: figures.residuals.response_curve_figure(curve, finding.carrier, without_finding)
    is_mistake = finding.evidence.p_value is None
    if (
        without_finding is None
        or with_finding is None
        or is_mistake
        or np.array_equal(without_finding.residual, with_finding.residual)
    ):
        return None
    scope = finding.where
    columns_used = [
        without_finding.order_covariate if name == "time" else name
        for name in (*scope.covariates, "time", "elevation", "row")
    ]
    available = [
        name for name in columns_used if name in without_finding.covariates and name in with_finding.covariates
    ]
    place = scope.stations, scope.targets
    if not available or not without_finding.is_at(*place).any() or not with_finding.is_at(*place).any():
        return None
    return lambda: figures.residuals.signature_figure(without_finding, with_finding, available[0], scope)


def _finding_place_blocks(finding: Finding, finding_number: int, adjustments: AdjustmentPair | None) -> list[Block]:
    """Floor plan with the place of a finding in the hall, at few stations or targets, or with the exchanged targets."""
    from ltsim.reports.workshop import workshop_from_adjustment

    stations, targets = finding.where.stations, finding.where.targets
    centre = {p.name.removeprefix("centre-"): p for p in finding.parameters if p.name in ("centre-x", "centre-y")}
    if adjustments is None or not (targets or centre) or len(targets) > MAX_MARKED_TARGETS:
        return []
    swapped = _is_name_exchange(finding)
    marked, pairs = (*stations, *targets), [(targets[0], targets[1])] if swapped else []
    text = "The names of the marked targets were exchanged: each reading belongs to the other end of the arrow."
    caption = text if swapped else "Seen from above; the place is marked."
    caption += " The shaded area is the place in the hall, two standard deviations wide." if centre else ""
    workshop = workshop_from_adjustment(adjustments[1])
    area = {axis: (p.value, 2.0 * p.sigma) for axis, p in centre.items()}
    figure = partial(figures.marked_floor_plans.marked_floor_plan, workshop, marked, pairs, area)
    return [PictureBlock(f"Place of finding {finding_number}", figure, caption)]


def _place_text(scope: FindingScope) -> str:
    parts = [
        f"{word} {listing(list(names))}"
        for word, names in (
            ("in", scope.observables),
            ("of instrument", scope.instruments),
            ("at station", scope.stations),
            ("at target", scope.targets),
            ("along", scope.covariates),
        )
        if names
    ]
    return ", ".join(parts) or "everywhere"


def _fit_table(content: Diagnosis) -> list[TableBlock]:
    note = (
        "Held-out error: 5-fold cross-validated prediction error over the declared noise (or the estimated noise, if "
        "larger); 1 is the limit set by the noise."
    )
    return table_block("Fit before and after", content.table("fit"), note=note)


def _undetectable_table(content: Diagnosis) -> list[TableBlock]:
    """Table of undetectable effects that cause relevant errors, the largest first."""
    relevant = [
        u
        for u in content.undetectable
        if u.undetected_target_error_um and u.undetected_target_error_um >= MIN_REPORTED_TARGET_ERROR_UM
    ]
    worst = sorted(relevant, key=lambda u: -(u.undetected_target_error_um or 0.0))
    named = [u.model_copy(update={"effect": title_of(u.effect)}) for u in worst]
    table = UNDETECTABLE_TABLE.with_rows(named).with_columns("effect undetected_target_error_um detectable_at_factor")
    cures = " or ".join(dict.fromkeys(u.cure for u in worst if u.cure))
    note = "Poses, targets and instrument constants absorb these effects at a plausible worst-case size."
    note += f" To detect them: {cures}." if cures else ""
    return table_block("Undetectable in this recording", table, note=note)


def _detectable_size_table(content: Diagnosis) -> list[TableBlock]:
    """Table of the smallest detectable sizes of effects."""
    note = (
        "Size at which about 80 % of the recordings of this network give a mismatch, for a median place; naming may "
        "need a larger effect."
    )
    return entries_table(
        "Smallest detectable size", content.detectable, "effect", "parameter", "size", "unit", note=note
    )
