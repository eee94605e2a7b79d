"""Section of a calibration or an adjustment in a report."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ltsim.adjustment.identification.recommendations import (
    corrected_faults,
    corrections_sentence,
    modelled_shifts,
    recommendations_for_causes,
)
from ltsim.adjustment.remedies.undetermined import MAX_UNINFORMATIVE_GAIN
from ltsim.adjustment.verdict import VerdictCase
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.files import read_targets
from ltsim.calibration.schema import (
    NOISE_TABLE,
    OUTLIERS_TABLE,
    PARAMETERS_TABLE,
    RESIDUALS_TABLE,
    TARGETS_TABLE,
    FitEntry,
)
from ltsim.calibration.uncertainty import uncertainty_sentences
from ltsim.core.errors import option_text
from ltsim.core.notation import fixed_point_text, number_text
from ltsim.core.probability import TWO_SIDED_GLOBAL_TEST_LEVEL, p_value_text, two_sided_p_value
from ltsim.core.units import SI_PER_UNIT
from ltsim.recordings import Recording, Setup
from ltsim.recordings.result_file import require_same_recording
from ltsim.reports import figures
from ltsim.reports.document_model import (
    Block,
    BulletListBlock,
    KeyFigure,
    NoteBlock,
    Section,
    SectionContext,
    TableBlock,
    assessment_of,
    entries_table_blocks,
    picture_if_few_items,
    table_blocks,
)
from ltsim.reports.formatting import (
    CORRECTIONS_NOTE,
    capitalised_sentence,
    count_text,
    global_test_verdict,
    is_determined_by_readings,
    names_text,
)
from ltsim.reports.residuals import Residuals
from ltsim.reports.sections.network import (
    adjustments_without_and_with_parameters,
    coordinates_tables,
    determined_combination_tables,
    residual_figures,
    target_tables,
    target_uncertainty_sentence,
    truth_in_folder,
    undetermined_combination_tables,
    workshop_blocks,
)
from ltsim.simulation.truth import Truth

if TYPE_CHECKING:
    from ltsim.reports.workshop_scene import DrawnSights, WorkshopScene

MIN_REPORTED_CRITERION_CHANGE = 0.05
"""Smallest reported relative change [%] of the mean disagreement of stations: half of the last printed digit."""
STATUSES_WITHOUT_WARNING = ("", "converged", FitEntry().status)
"""Statuses of a fit for which the page has no warning."""


def calibration_section(content: Calibration, context: SectionContext) -> Section:
    """Section of a `calibration.json`; the recording adds the floor plan and the residuals before calibration.

    Raises
    ------
    RecordError
        When a file is malformed.
    """
    recording = context.recording
    require_same_recording(content, recording, context.folder or Path())
    agrees, agreement_words = global_test_verdict(content.fit.chi2, content.fit.dof, content.fit.p_value)
    if content.noise_estimated:
        agreement_words = "the noise was estimated from the same readings, so the global test does not apply"
    converged = content.fit.status in STATUSES_WITHOUT_WARNING
    targets, residuals = (context.companion_file(table.file, content) for table in (TARGETS_TABLE, RESIDUALS_TABLE))
    adjustments = (
        None if residuals is None or context.omits_residuals else adjustments_without_and_with_parameters(recording)
    )
    before = Residuals.from_adjustment(adjustments[0]) if adjustments else None
    after = Residuals.read(residuals).with_covariates(before) if residuals else None
    coordinate_table = target_tables(targets, note=f"Axes: {content.frame or 'those of the first station'}.")
    is_accepted = agrees and converged and all(outlier.excluded for outlier in content.outliers)
    agrees_with_constants = converged and _fits_with_estimated_constants(content)
    agreement_words = _global_tests_text(content) or agreement_words
    parameter_blocks = _parameter_blocks(content, truth_in_folder(context)) if content.parameters else []
    reference_value_tables = _reference_value_blocks(content)
    first_reference_tables = reference_value_tables if any(entry.excluded for entry in content.reference_values) else []
    blocks: list[Block] = [
        *_warning_blocks(content, has_converged=converged, agrees=agrees),
        *first_reference_tables,
        *parameter_blocks[:1],
        *_criteria_blocks(content),
    ]
    blocks += coordinate_table if is_accepted else []  # coordinates of a rejected fit are in the details
    n_open_blocks = len(blocks) + 1
    if targets is not None and content.stations:
        blocks += workshop_blocks(lambda: calibrated_workshop(content, recording, targets, after), context.hall_view)
    blocks += determined_combination_tables("Determined in combination", content.determined)
    blocks += [
        *([] if first_reference_tables else reference_value_tables),
        *parameter_blocks[1:],
        *([] if is_accepted else coordinate_table),
        *_station_blocks(content),
    ]
    if after is not None and not context.omits_residuals:
        blocks += residual_figures(after, before)
    if content.effects:
        blocks.append(
            BulletListBlock("Effects estimated with the calibration", [effect.sentence for effect in content.effects])
        )
    note = "Information: part of the prior variance that the recording removes; at 0 % it adds nothing."
    blocks += undetermined_combination_tables("Not determined by this recording", content.undetermined, note=note)
    kind = "Calibration" if content.parameters else "Network adjustment"
    recording_title = (recording.setup.title if recording else "") or (
        content.recording.title if content.recording else ""
    )
    assessment = "caution" if is_accepted and corrected_faults(content.tests) else assessment_of(is_accepted)
    return Section(
        title=f"{kind}: {recording_title}"
        if recording_title
        else f"{kind} of {count_text(len(content.stations), 'station')}",
        kind=kind,
        method=(content.method or "network") if content.parameters else "",
        summary=_summary_sentence(content, agreement_words, targets),
        assessment="plain" if agrees_with_constants else assessment,
        key_figures=_key_figures(content, has_agreement=agrees),
        blocks=blocks,
        next_actions=_next_actions(content, is_accepted=is_accepted),
        axes_text=content.frame,
        n_open_blocks=n_open_blocks,
    )


def _summary_sentence(content: Calibration, agreement_text: str, targets: Path | None) -> str:
    """Summary: determined parameters, verdict `agreement_text`, improvement of distances, outliers, uncertainty."""
    station_count = count_text(len(content.stations), "station")
    if not content.parameters:
        sentence = f"The network of {station_count} was adjusted without instrument parameters: {agreement_text}"
    else:
        determined = [p for p in content.parameters if is_determined_by_readings(p.sigma, p.prior_sigma)]
        sentence = (
            f"The instrument was calibrated from {station_count}: {len(determined)} of "
            f"{count_text(len(content.parameters), 'parameter')} are determined, and {agreement_text}"
        )
    distance = None if content.criteria is None else content.criteria.distance
    if distance is not None and distance.improvement_percent is not None:
        change = distance.improvement_percent
        word = "better" if change >= 0 else "worse"
        compared = f"{abs(change):.1f} % {word} than" if abs(change) >= MIN_REPORTED_CRITERION_CHANGE else "as well as"
        sentence += (
            f"; stations agree about distances {compared} before "
            f"({number_text(distance.before.mean_um)} to "
            f"{number_text(distance.after.mean_um if distance.after else None)} um)"
        )
        if shifts := modelled_shifts(content.tests):
            sentence += f", by the calibration and the correction of {count_text(len(shifts), 'error')}"
    if content.outliers:
        n_rejected = sum(outlier.excluded for outlier in content.outliers)
        sentence += f"; {count_text(len(content.outliers), 'reading')} did not fit"
        were = "was" if n_rejected == 1 else "were"
        sentence += (
            f" and {were} left out"
            if n_rejected == len(content.outliers)
            else f", {n_rejected} left out"
            if n_rejected
            else ""
        )
    unused_rows = [outlier.row for outlier in content.outliers if outlier.pointing_excluded]
    sentence += f". {corrections_sentence(content.tests, unused_rows)}".rstrip() + _larger_noise_sentence(content)
    accuracy = f" {target_uncertainty_sentence(read_targets(targets)[2])}" if targets is not None else ""
    return f"{sentence}{accuracy}".rstrip()


def _has_explaining_noise(content: Calibration) -> bool:
    """True if noise larger than declared is the only identified cause of the misfit of the readings."""
    return content.verdict.case == VerdictCase.LARGER_NOISE.value


def _larger_noise_sentence(content: Calibration) -> str:
    """Sentences on noise larger than declared; empty unless it is the only identified cause of the misfit."""
    if not _has_explaining_noise(content):
        return ""
    return "".join(f" {test.sentence}" for test in content.tests if test.kind == "noise-level" and test.is_fault)


def _fits_with_estimated_constants(content: Calibration) -> bool:
    """True if the readings scatter no more than declared in a fit that also estimates the instrument constants."""
    fit = content.fit_with_constants
    if fit is None:
        return False
    agrees = global_test_verdict(fit.chi2, fit.dof, fit.p_value)[0]
    return agrees or (fit.p_value is not None and fit.p_value > 0.5)


def _global_tests_text(content: Calibration) -> str:
    """Text on the global tests with and without estimated instrument constants; empty if the two were not compared."""
    fit = content.fit_with_constants
    if fit is None:
        return ""
    with_them, without = (global_test_verdict(f.chi2, f.dof, f.p_value)[1] for f in (fit, content.fit))
    if _fits_with_estimated_constants(content):
        return f"errors of the instrument are still in the coordinates; with its constants estimated, {with_them}"
    return f"{without}, nor with the instrument's constants estimated (chi2 {fit.chi2:.0f} for {fit.dof})"


def _key_figures(content: Calibration, *, has_agreement: bool) -> list[KeyFigure]:
    """Key figures of a calibration; `has_agreement` is the result of the global test."""
    fit, noise_estimated = content.fit, content.noise_estimated
    p = None if noise_estimated or fit.p_value is None else two_sided_p_value(fit.p_value)
    facts = [
        KeyFigure("sigma0", fixed_point_text(fit.sigma0, 3), assessment_of(has_agreement)),
        KeyFigure("two-sided p-value", p_value_text(p), "plain" if noise_estimated else assessment_of(has_agreement)),
        KeyFigure("degrees of freedom", str(fit.dof)),
        KeyFigure("outlying readings", str(len(content.outliers)), "bad" if content.outliers else "plain"),
    ]
    if has_agreement and content.correction is not None and content.correction.uncorrected_error_um > 0:
        expected = f"{number_text(content.correction.uncorrected_and_corrected_point_error_um[1], 3)} um"
        facts.append(KeyFigure("expected 3D error of a new point, corrected", expected))
    return facts


def _warning_blocks(content: Calibration, *, has_converged: bool, agrees: bool) -> list[Block]:
    """Blocks on the limitations of a calibration: convergence, verdict, uncertainty, outliers, estimated noise.

    `agrees` is the result of the global test; the benefit of the calibration is shown only if it is True.
    """
    blocks: list[Block] = []
    if not has_converged:
        blocks.append(NoteBlock("The adjustment did not converge", content.fit.sentence or content.fit.status, "bad"))
    verdict = content.verdict.sentence
    if content.noise_estimated:  # the global test does not apply to it, the causes do
        verdict = " ".join(test.sentence for test in content.tests if test.sentence and test.sentence in verdict)
    if verdict:
        blocks.append(NoteBlock("Verdict", verdict))
    lines = uncertainty_sentences(content)
    blocks += [BulletListBlock("Uncertainty", lines)] if lines else []
    if content.correction is not None and content.correction.uncorrected_error_um > 0:
        lines = [*([content.correction.point_error_text] if agrees else []), *content.correction.sentences]
        if lines:
            blocks.append(BulletListBlock("Benefit of the calibration", [capitalised_sentence(line) for line in lines]))
    if content.undetermined_targets:
        text = f"The used readings do not determine the coordinates of {', '.join(content.undetermined_targets)}."
        blocks.append(NoteBlock("Targets without coordinates", text, "bad"))
    blocks += table_blocks("Outlying readings", OUTLIERS_TABLE.with_rows(content.outliers))
    note = "Factor: estimated over declared standard deviation; typical sigma: median over the readings."
    return blocks + table_blocks("Noise estimated from the readings", NOISE_TABLE.with_rows(content.noise), note=note)


def _reference_value_blocks(content: Calibration) -> list[TableBlock]:
    """Blocks with the fit of the reference values (coordinates and lengths); empty without reference values."""
    note = "Residual: declared minus adjusted value. Error: estimate from all other observations, +- one sigma."
    if not content.constants_included and {"length", "point"} & {entry.kind for entry in content.reference_values}:
        note += " Reference values are tested in a fit that also estimates the instrument's constants."
    largest_w: dict[tuple[str, str], float] = {}
    for entry in content.reference_values:
        largest_w[entry.kind, entry.name] = max(largest_w.get((entry.kind, entry.name), 0.0), entry.w)
    sorted_values = sorted(content.reference_values, key=lambda e: (not e.excluded, -largest_w[e.kind, e.name]))
    fields = "kind name component residual error+-sigma_error minimal_detectable_error=detectable unit redundancy w"
    names = [*fields.split(), "excluded"]
    return entries_table_blocks("Fit of the reference values", sorted_values, *names, note=note)


def _next_actions(content: Calibration, *, is_accepted: bool) -> list[str]:
    """Next actions, the most urgent first; `is_accepted` is True if the calibration can be used."""
    actions = recommendations_for_causes(corrected_faults(content.tests))
    if remaining := [o for o in content.outliers if not o.excluded]:
        reading_names = names_text([f"{o.station} to {o.target} ({o.observable}, row {o.row})" for o in remaining], 3)
        actions.append(f"Measure again, or reject with {option_text('robust=True')}: {reading_names}.")
    if content.fit_with_constants is not None:
        actions.append("Estimate the instrument constants, and correct them, with ltsim calibrate.")
    p_value = content.fit.p_value
    if (
        p_value is not None
        and p_value < TWO_SIDED_GLOBAL_TEST_LEVEL / 2
        and not (content.noise_estimated or _fits_with_estimated_constants(content) or _has_explaining_noise(content))
    ):
        action = "Run ltsim diagnose to locate the disagreement of readings and model, and use its coordinates."
        actions.insert(0 if any(not t.is_in_model for t in corrected_faults(content.tests)) else len(actions), action)
    if content.verdict.is_sigma0_credible and not (content.noise or _fits_with_estimated_constants(content)):
        actions.append(f"If the noise is not known, estimate it from the data: {option_text('noise_from_data=True')}.")
    measurements = dict.fromkeys(e.measurement for e in content.undetermined if e.measurement)
    actions += [f"To determine further parameters: {measurement}." for measurement in list(measurements)[:3]]
    applied_values = (p.value if p.applied_value is None else p.applied_value for p in content.parameters)
    if is_accepted and not actions and any(applied_values):
        actions.append("Apply the calibration to further readings with ltsim correct.")
    return actions


def _parameter_blocks(content: Calibration, truth: Truth | None) -> list[Block]:
    """Blocks with the estimates of the instrument parameters, and their correlations; `truth` has their true values."""
    rows, true_values = content.parameters, {} if truth is None else truth.instrument_values
    names = [f"{p.name}@{p.instrument}" if p.instrument else p.name for p in rows]
    true_in_display_units = [
        true_values[n] / SI_PER_UNIT[truth.parameter_units[n]] if truth and n in true_values else None for n in names
    ]
    text = "Corrections (true value minus reading) with 95 % intervals, in units of the prior standard deviation."
    note = CORRECTIONS_NOTE
    if any(p.applied_value is not None for p in rows):
        rows = tuple(p.model_copy(update={"applied_value": p.value} if p.applied_value is None else {}) for p in rows)
        note += " Applied: correction with the prior scaled to the readings, and 0 for parameters that are not applied."
    undetermined = [
        n for n, p in zip(names, rows, strict=True) if not p.held and p.variance_reduction < MAX_UNINFORMATIVE_GAIN
    ]
    if undetermined:
        note += f" Not determined by the recording, so that the prior remains: {names_text(undetermined, 6)}."
    parameter_figure = partial(figures.parameters.parameter_estimates_figure, rows, true_in_display_units)
    blocks: list[Block] = [
        picture_if_few_items("Instrument parameters", parameter_figure, text, len(rows)),
        *table_blocks("Parameters in numbers", PARAMETERS_TABLE.with_rows(rows), note=note, is_foldable=False),
    ]
    if len(content.parameter_covariance) == len(rows) and len(rows) > 1:
        covariance = np.array(content.parameter_covariance)
        text = "Two parameters near +-100 % can hardly be separated with this network."
        figure = partial(figures.parameters.correlation_figure, rows, covariance)
        blocks.append(picture_if_few_items("Correlation of the parameters", figure, text, len(rows)))
    return blocks


def _criteria_blocks(content: Calibration) -> list[TableBlock]:
    """Blocks with the disagreement of the stations before and after the calibration; empty if it is unknown."""
    if content.criteria is None:
        return []
    text = "Disagreement of the stations in distances between reflectors and in their coordinates."
    if content.method == "adjustment" and modelled_shifts(content.tests):
        text += " The uncorrected readings, from which it is computed, contain the errors that the model corrects."
    table = content.criteria.criteria_table()
    is_compared = any("after" in heading for heading in table.headings)
    return table_blocks("Criteria before and after calibration" if is_compared else "Criteria", table, note=text)


def _station_blocks(content: Calibration) -> list[TableBlock]:
    """Blocks with positions and orientations of the stations."""
    entries = [(s.name, s.position_mm, s.sigma_position_mm or (None,) * 3) for s in content.stations]
    return coordinates_tables("Stations", entries, note=f"Axes: {content.frame or 'those of the first station'}.")


def calibrated_workshop(
    content: Calibration, recording: Recording | None, targets: Path, residuals: Residuals | None
) -> WorkshopScene:
    """Scene of a calibrated network; residuals, if given, determine the colours of the lines of sight."""
    from scipy.spatial.transform import Rotation

    from ltsim.reports.workshop_scene import WorkshopScene, workshop_with_surroundings

    names, points, sigma = read_targets(targets)
    stations = tuple(s.name for s in content.stations)
    setup = recording.setup if recording is not None else Setup()
    network = WorkshopScene(
        title=setup.title or "Calibrated network",
        stations=stations,
        station_positions=np.array([s.position for s in content.stations]),
        station_rotations=Rotation.from_quat([s.rotation_quaternion for s in content.stations]).as_matrix(),
        targets=names,
        target_points=np.nan_to_num(points),
        sights=_residual_sights(residuals, stations, names),
        target_covariances=np.einsum("ti,ij->tij", np.nan_to_num(sigma) ** 2, np.eye(3)),
    )
    return workshop_with_surroundings(network, setup)


def _residual_sights(
    residuals: Residuals | None, stations: Sequence[str], targets: Sequence[str]
) -> DrawnSights | None:
    """Lines of sight with the absolute normalised residual of each reading; None without residuals."""
    from ltsim.reports.workshop_scene import DrawnSights

    if residuals is None:
        return None
    station, target = (
        np.array([{name: i for i, name in enumerate(names)}.get(name, -1) for name in column.tolist()])
        for names, column in ((stations, residuals.station_names), (targets, residuals.target_names))
    )
    matched = (station >= 0) & (target >= 0)
    residual_sizes = np.abs(np.nan_to_num(residuals.normalised_residual[matched]))
    return (
        DrawnSights(station[matched], target[matched], residual_sizes, "largest normalised residual")
        if matched.any()
        else None
    )
