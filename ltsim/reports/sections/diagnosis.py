"""Section of a diagnosis: verdict, findings, evidence, and a comparison with the true values of a simulation."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ltsim.calibration.schema import RESIDUALS_TABLE
from ltsim.core.notation import MISSING_TEXT
from ltsim.core.probability import p_value_text, two_sided_p_value
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.recommendations import is_name_exchange
from ltsim.diagnosis.schema import (
    BASELINE_RESIDUALS_TABLE,
    DIAGNOSED_TARGETS_TABLE,
    UNDETECTABLE_TABLE,
    Finding,
    Misfit,
)
from ltsim.diagnosis.sentences import (
    finding_title,
    significant_instrument_constant_texts,
)
from ltsim.physics.effects import effect_title, parameter_text
from ltsim.recordings.result_file import require_same_recording
from ltsim.reports import figures
from ltsim.reports.document_model import (
    Block,
    BulletListBlock,
    KeyFigure,
    NoteBlock,
    PictureBlock,
    Section,
    SectionContext,
    TableBlock,
    assessment_of,
    entries_table_blocks,
    table_blocks,
)
from ltsim.reports.formatting import CORRECTIONS_NOTE, capitalised_sentence, names_text
from ltsim.reports.residuals import Residuals
from ltsim.reports.sections.diagnosis_answer import (
    diagnosis_answer,
    evidence_lines,
    finding_scope_text,
    next_actions_after_diagnosis,
    parameter_meanings_note,
    targets_note,
)
from ltsim.reports.sections.network import (
    AdjustmentsWithoutAndWithParameters,
    adjustments_without_and_with_parameters,
    determined_combination_tables,
    residuals_over_covariates,
    scene_block,
    target_tables,
    truth_in_folder,
)
from ltsim.reports.sections.truth_comparison import effect_place_text, truth_blocks

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_MARKED_TARGETS = 12
"""Largest number of targets of a finding that are marked on the floor plan."""
MIN_REPORTED_TARGET_ERROR_UM = 0.1
"""Smallest error of targets [um] for which an undetectable effect is listed; smaller errors are negligible."""
MIN_CURVE_POINTS = 3
"""Smallest number of points of an estimated curve that is drawn over its covariate."""


def diagnosis_section(content: Diagnosis, context: SectionContext) -> Section:
    """Section of a diagnosis; with a `truth.json` in the folder it compares true values and findings first.

    Residuals of the model without the findings are read from `residuals_before.csv`, of the model with the findings
    from `residuals.csv`.

    Raises
    ------
    RecordError
        When a file is malformed.
    """
    recording = context.recording
    require_same_recording(content, recording, context.folder or Path())
    adjustments = adjustments_without_and_with_parameters(recording)
    before, after = _residuals_before_and_after(content, context, adjustments)
    truth = truth_in_folder(context)
    blocks: list[Block] = truth_blocks(content, truth, adjustments) if truth is not None and truth.effects else []
    if adjustments is not None and context.hall_view == "3d" and blocks:
        from ltsim.reports.workshop_scene import workshop_from_adjustment

        blocks = [
            scene_block(workshop_from_adjustment(adjustments[1], adjustment_without_parameters=adjustments[0])),
            *blocks,
        ]
    n_side_by_side_blocks = len(blocks)
    if content.findings:
        blocks.append(NoteBlock("Details", capitalised_sentence(content.summary)))
    for finding_number, finding in enumerate(content.findings, start=1):
        blocks += _finding_blocks(finding, finding_number, content, adjustments, (before, after))
    blocks += target_tables(context.companion_file(DIAGNOSED_TARGETS_TABLE.file, content), note=targets_note(content))
    model_text = ", with the findings in the model" if content.findings else ""
    if constants := significant_instrument_constant_texts(content.instruments):
        blocks.append(
            NoteBlock(
                f"Most significant constants of the instruments{model_text}",
                f"{'; '.join(constants)}. {CORRECTIONS_NOTE}",
            )
        )
    blocks += _undetectable_tables(content)
    n_open_blocks = len(blocks)
    blocks += _misfit_tables(content)
    if after is not None and adjustments is not None:
        blocks += residuals_over_covariates(after)
    for entry in content.instruments:
        name = f" of {entry.name}" if entry.name else ""
        title = f"Constants{name}{model_text}"
        blocks += entries_table_blocks(
            title, entry.parameters, "name=constant", "value+-sigma", "unit", note=CORRECTIONS_NOTE
        )
        blocks += determined_combination_tables(f"Determined combinations{name}", entry.determined)
    blocks += _detectable_size_tables(content)
    recording_title = (recording.setup.title if recording else "") or (
        content.recording.title if content.recording else ""
    )
    next_actions, simulation_notice = next_actions_after_diagnosis(content), ""
    if truth is not None and truth.effects:
        injected = names_text(
            [f"{effect_title(a.effect.name)} ({effect_place_text(a.effect)})" for a in truth.applied_effects]
        )
        simulation_notice = f"This recording is simulated, with {injected} injected. "
        simulation_notice += "The diagnosis does not read the injected values."
    return Section(
        f"Diagnosis: {recording_title}" if recording_title else "Diagnosis of a tracker network", "Diagnosis",
        diagnosis_answer(content, next_actions),
        assessment_of(content.verdict == "consistent"), _key_figures(content), blocks,
        n_open_blocks=n_open_blocks, n_side_by_side_blocks=n_side_by_side_blocks, n_terminal_blocks=n_open_blocks,
        next_actions=next_actions, simulation_notice=simulation_notice,
    )  # fmt: skip


def _key_figures(content: Diagnosis) -> list[KeyFigure]:
    """Key figures of a diagnosis; the label of a test names the findings for which its readings were corrected."""
    test, corrected = content.global_test, _corrected_findings_text(content)
    after_text = f" after the correction of {corrected}" if corrected else ""
    p_value = test.p_value if test.dof > 0 else None
    verdict = assessment_of(content.verdict == "consistent")
    p_text_of_global_test = p_value_text(None if p_value is None else two_sided_p_value(p_value))
    facts = [
        KeyFigure("findings", str(len(content.findings)), verdict),
        KeyFigure(f"global test{after_text}, two-sided p", p_text_of_global_test),
    ]
    if test.search_p_value is not None:
        facts.append(KeyFigure(f"whole search{after_text}, p", p_value_text(test.search_p_value)))
    if content.fit is not None:
        ratios = dict.fromkeys(_chi2_per_dof_text(fit) for fit in (content.fit.before, content.fit.after))
        facts.append(KeyFigure(f"chi2 per degree of freedom{after_text}", " to ".join(ratios)))
    return facts


def _corrected_findings_text(content: Diagnosis) -> str:
    """Text with the numbers of the findings that were corrected before the global test; empty if there are none."""
    numbers = [
        str(number) for number, finding in enumerate(content.findings, start=1) if finding.is_corrected_before_search
    ]
    return f"finding{'s' if len(numbers) > 1 else ''} {names_text(numbers)}" if numbers else ""


def _chi2_per_dof_text(fit: Misfit) -> str:
    """Chi-square per degree of freedom as text."""
    return f"{fit.chi2 / fit.dof:.3f}" if fit.dof > 0 and fit.chi2 is not None else MISSING_TEXT


def _residuals_before_and_after(
    content: Diagnosis, context: SectionContext, adjustments: AdjustmentsWithoutAndWithParameters | None
) -> tuple[Residuals | None, Residuals | None]:
    """Residuals of the model without and of the model with the findings, each None if its file is missing.

    The covariates are computed from `adjustments` (without and with instrument parameters).
    """
    file_with_findings, file_without_findings = (
        context.companion_file(name, content) for name in (RESIDUALS_TABLE.file, BASELINE_RESIDUALS_TABLE.file)
    )
    geometry = Residuals.from_adjustment(adjustments[0]) if adjustments is not None else None
    after, before = (
        Residuals.read(f).with_covariates(geometry) if f is not None else None
        for f in (file_with_findings, file_without_findings)
    )
    return (before if after is not None else None), after


def _finding_blocks(
    finding: Finding,
    finding_number: int,
    content: Diagnosis,
    adjustments: AdjustmentsWithoutAndWithParameters | None,
    residuals: tuple[Residuals | None, Residuals | None],
) -> list[Block]:
    """Blocks of a finding: sentence, figure, floor plan, table of estimates, evidence.

    The sentence is omitted if the summary of the diagnosis `content` contains it. `adjustments` are those without and
    with instrument parameters, from which the floor plan is drawn.
    """
    name = finding_title(finding)
    sentence = finding.sentence or f"{name} {finding_scope_text(finding.where)}"
    separation_sentence = (
        f" To separate the finding from its rivals: {finding.separate_by.rstrip('.')}." if finding.separate_by else ""
    )
    formula_is_new = finding.formula not in finding.sentence
    formula_sentence = f" Proposed formula: {finding.formula}." if finding.formula and formula_is_new else ""
    text = f"{sentence.rstrip('.')}.{formula_sentence}{separation_sentence}"
    is_in_summary = text in capitalised_sentence(content.summary)
    blocks: list[Block] = [] if is_in_summary else [NoteBlock(f"Finding {finding_number}: {name}", text, "bad")]
    draw_figure = finding_figure(finding, *residuals)
    if draw_figure is not None:
        text = "Residuals without the finding (left) and with the finding in the model (right)."
        if finding.curve is not None and len(finding.curve.at) >= MIN_CURVE_POINTS:
            text = f"Estimated change of the {finding.carrier} over {finding.curve.covariate}."
        blocks.append(PictureBlock(f"Effect of finding {finding_number}", draw_figure, text))
    blocks += _finding_place_blocks(finding, finding_number, adjustments)
    renamed_parameters = [p.model_copy(update={"name": parameter_text(p.name)}) for p in finding.parameters]
    blocks += entries_table_blocks(
        f"Finding {finding_number} in figures",
        renamed_parameters,
        "name=parameter",
        "value+-sigma",
        "unit",
        note=parameter_meanings_note(finding),
    )
    return [*blocks, BulletListBlock(f"Evidence of finding {finding_number}", evidence_lines(finding, content.tests))]


def finding_figure(
    finding: Finding, without_finding: Residuals | None, with_finding: Residuals | None
) -> Callable[[], Figure] | None:
    """Function that draws a finding: the estimated curve over its covariate, or residuals without and with the finding.

    The result is None for blunders such as gross errors and exchanged names, which neither set of residuals contains.
    """
    curve = finding.curve
    if curve is not None and len(curve.at) >= MIN_CURVE_POINTS:
        return lambda: figures.residuals.response_curve_figure(curve, finding.carrier, without_finding)
    is_blunder = finding.evidence.p_value is None
    if (
        without_finding is None
        or with_finding is None
        or is_blunder
        or np.array_equal(without_finding.displayed_residual, with_finding.displayed_residual)
    ):
        return None
    scope = finding.where
    candidate_covariates = [
        without_finding.measurement_order_covariate if name == "time" else name
        for name in (*scope.covariates, "time", "elevation", "row")
    ]
    common_covariates = [
        name for name in candidate_covariates if name in without_finding.covariates and name in with_finding.covariates
    ]
    place = scope.stations, scope.targets
    has_no_rows = not (
        without_finding.station_and_target_mask(*place).any() and with_finding.station_and_target_mask(*place).any()
    )
    if not common_covariates or has_no_rows:
        return None
    return lambda: figures.residuals.finding_comparison_figure(
        without_finding, with_finding, common_covariates[0], scope
    )


def _finding_place_blocks(
    finding: Finding, finding_number: int, adjustments: AdjustmentsWithoutAndWithParameters | None
) -> list[Block]:
    """List with a floor plan that marks the stations, targets or area of a finding, or its two exchanged targets.

    The list is empty if the finding acts everywhere, or at more than `MAX_MARKED_TARGETS` targets. `adjustments` are
    those without and with instrument parameters, from which the floor plan is drawn.
    """
    from ltsim.reports.workshop_scene import workshop_from_adjustment

    stations, targets = finding.where.stations, finding.where.targets
    centre_parameters = {
        p.name.removeprefix("centre-"): p for p in finding.parameters if p.name in ("centre-x", "centre-y")
    }
    if adjustments is None or not (targets or centre_parameters) or len(targets) > MAX_MARKED_TARGETS:
        return []
    has_exchange = is_name_exchange(finding)
    marked_names, pairs = (*stations, *targets), [(targets[0], targets[1])] if has_exchange else []
    text = "The names of the marked targets were exchanged: each reading belongs to the other end of the arrow."
    caption = text if has_exchange else "Seen from above; stations and targets of the finding are marked."
    caption += " Shaded: region of the finding in the hall, +- two standard deviations." if centre_parameters else ""
    workshop = workshop_from_adjustment(adjustments[1])
    area = {axis: (p.value, 2.0 * p.sigma) for axis, p in centre_parameters.items()}
    figure = partial(figures.marked_floor_plans.marked_floor_plan, workshop, marked_names, pairs, area)
    return [PictureBlock(f"Place of finding {finding_number}", figure, caption)]


def _misfit_tables(content: Diagnosis) -> list[TableBlock]:
    """Table of the misfit without and with the findings in the model, with the error of held-out readings."""
    note = (
        "Held-out error: 5-fold cross-validated prediction error, divided by the declared noise (or by the estimated "
        "noise if this is larger). The noise alone gives 1."
    )
    if corrected := _corrected_findings_text(content):
        note = f"Both models are fitted after the correction of {corrected}. {note}"
    return table_blocks("Misfit without and with the findings", content.table("fit"), note=note)


def _undetectable_tables(content: Diagnosis) -> list[TableBlock]:
    """Table of undetectable effects that cause relevant errors of targets, the largest error first."""
    relevant = [
        u
        for u in content.undetectable
        if u.undetected_target_error_um and u.undetected_target_error_um >= MIN_REPORTED_TARGET_ERROR_UM
    ]
    largest_first = sorted(relevant, key=lambda u: -(u.undetected_target_error_um or 0.0))
    with_titles = [u.model_copy(update={"effect": effect_title(u.effect)}) for u in largest_first]
    table = UNDETECTABLE_TABLE.with_rows(with_titles).select_columns(
        "effect undetected_target_error_um detectable_at_factor"
    )
    cures = " or ".join(dict.fromkeys(u.cure for u in largest_first if u.cure))
    note = "Even at a plausible worst-case size, these effects are absorbed by poses, targets and instrument constants."
    note += f" Measurement that would detect these effects: {cures}." if cures else ""
    return table_blocks("Undetectable in this recording", table, note=note)


def _detectable_size_tables(content: Diagnosis) -> list[TableBlock]:
    """Table of the smallest detectable sizes of effects."""
    note = (
        "Size at which a diagnosis reports a mismatch in about 80 % of the recordings of this network, for the median "
        "of the stations or targets where the effect can act. The identification of the effect may need a larger size."
    )
    return entries_table_blocks(
        "Smallest detectable size", content.detectable, "effect", "parameter", "size", "unit", note=note
    )
