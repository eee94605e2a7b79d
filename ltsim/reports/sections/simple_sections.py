"""Sections with a sentence, tables and at most one picture: checks, comparisons, acceptance, uncertainty, history."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, TypeVar

from ltsim.acceptance.files import AcceptanceFile, Judgement, combined_judgement
from ltsim.adjustment.fieldcheck.recommendations import recommendations_after_check
from ltsim.adjustment.fieldcheck.result import Check
from ltsim.adjustment.identification.recommendations import recommendations_for_causes
from ltsim.adjustment.significance import FAMILY_WISE_LEVEL
from ltsim.calibration.calibration_series import ChangeEntry
from ltsim.calibration.events import MIN_STEPS_FOR_EVENT_TEST, MIN_STEPS_TO_ESTIMATE_USUAL_CHANGES, EventEntry
from ltsim.calibration.history import History
from ltsim.core.errors import option_text
from ltsim.core.notation import number_text
from ltsim.core.probability import p_value_relation_text, p_value_text
from ltsim.measurands.comparison import DISPLACEMENTS_TABLE, Comparison
from ltsim.measurands.uncertainty import Uncertainty
from ltsim.physics.effects import effect_title, parameter_text
from ltsim.planning.proposals import PROPOSALS_TABLE, NextMeasurement
from ltsim.recordings.files import read_text
from ltsim.reports import figures
from ltsim.reports.document_model import (
    Assessment,
    Block,
    BulletListBlock,
    KeyFigure,
    NoteBlock,
    PictureBlock,
    Section,
    SectionContext,
    assessment_of,
    entries_table_blocks,
    picture_if_few_items,
    table_blocks,
)
from ltsim.reports.formatting import (
    capitalised_sentence,
    count_text,
    duration_text,
    labels_without_common_prefix,
    names_text,
    natural_sort_key,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EntryBetweenCalibrationsT = TypeVar("EntryBetweenCalibrationsT", ChangeEntry, EventEntry)
"""Type variable of an entry (change or event between two calibrations) of the history of an instrument."""
MIN_GOOD_PASS_PROBABILITY = 0.5
"""Smallest probability (0 to 1) to pass all tests of a prediction that is assessed as good; by convention one half."""
ASSESSMENT_BY_JUDGEMENT: dict[Judgement, Assessment] = {"accepted": "good", "rejected": "bad", "undecided": "caution"}
"""Assessment of measured errors by their judgement."""
MAX_NEGLIGIBLE_CONSTANT = 1e-6
"""Largest absolute value of an instrument constant, in its display unit, that is treated as zero and not printed."""
UNCERTAINTY_NOTE = (
    "U: expanded uncertainty; mc: limits of the Monte Carlo interval; they replace U if the two do not agree "
    "(JCGM 101, clause 8)."
)
"""Note below a table of expanded uncertainties, which explains the columns U and mc."""
UNDETECTABLE_NOTE = (
    "Each size is one standard deviation. Errors that leave no residuals are not included in U. "
    "Measure a known length or the temperature of the structure to exclude such errors."
)
"""Note below a table of undetectable errors."""
MAX_BUDGET_BARS = 40
"""Largest number of results in a figure of uncertainty budgets; only the first results are drawn."""
CORRECTED_P_VALUE_NOTE = (
    "p is the p-value of one test multiplied by the number of tests of this check, at most 1. It is therefore larger "
    "than the p-value of the same network in ltsim adjust, which makes one test."
)
"""Note below the table of passed tests of a field check."""
MAX_LISTED_TESTS = 200
"""Largest number of acceptance tests in a table; if there are more, the tests nearest to their limits are listed."""


def check_section(content: Check, context: SectionContext) -> Section:
    """Section of a field check: go or no-go, and every test."""
    file = context.companion_file("check.svg", content)
    caption = "Above: half two-face differences divided by their limits. Below: misfit of each pointing over time."
    if any(test.is_fault for test in content.tests):
        caption += " Rings: readings as measured, on which the failed causes were decided; dots: corrected for them."
    blocks: list[Block] = [] if file is None else [PictureBlock("All readings", lambda: read_text(file), caption)]
    fields = ("station", "kind=test", "sentence=result", "targets", "p_value")
    for title, passed, note in (("Tests failed", False, ""), ("Tests passed", True, CORRECTED_P_VALUE_NOTE)):
        shown_items = [i for i in content.items if i.passed is passed]
        has_p_values = any(i.p_value is not None for i in shown_items)
        note = note if has_p_values else ""
        blocks += entries_table_blocks(title, shown_items, *fields, note=note, is_foldable=False)
    failed = sum(not item.passed for item in content.items)
    facts = [KeyFigure("tests", str(len(content.items))), KeyFigure("failed", str(failed), assessment_of(not failed))]
    blocks = [*blocks[1:2], *blocks[:1], *blocks[2:]] if failed and file else blocks
    n_open_blocks = 2 if failed else 1
    recording_title = content.recording.title if content.recording else ""
    title = f"Check in the field: {recording_title}" if recording_title else "Check in the field"
    answer = capitalised_sentence(content.sentence)
    actions = recommendations_after_check(content)
    return Section(
        title,
        "Check",
        answer,
        assessment_of(content.passed),
        facts,
        blocks,
        n_open_blocks=n_open_blocks,
        next_actions=actions,
    )


def comparison_section(content: Comparison, _: SectionContext) -> Section:
    """Section of a comparison of epochs: displacements of the points."""
    points = sorted(content.displacements, key=lambda d: (not d.moved, natural_sort_key(d.target)))
    moved_targets, p_value = [d.target for d in points if d.moved], content.p_value
    caption = "Shift of each point, enlarged; circle: the largest semi-axis of its 95 % ellipsoid."
    note = (
        "dx, dy, dz: with one standard deviation; a: largest semi-axis of the 95 % confidence ellipsoid; detectable: "
        "the smallest motion that is detected with a probability of 80 %."
    )
    shown_table = DISPLACEMENTS_TABLE.with_rows(d.table_row for d in points).select_columns(
        "target moved dx_um dy_um dz_um a_um detectable_um p_value"
    )
    table = table_blocks(
        "Every point", shown_table, note=note, marked_rows=frozenset(range(len(moved_targets))), is_foldable=False
    )
    facts = [
        KeyFigure("points", str(len(points))),
        KeyFigure("moved", str(len(moved_targets)), assessment_of(not moved_targets)),
        KeyFigure(
            "p-value, if no point moved", p_value_text(p_value), assessment_of(p_value >= content.significance_level)
        ),
        *([] if content.scale_ppm is None else [KeyFigure("scale", f"{content.scale_ppm:+.2f} ppm")]),
    ]
    answer = " ".join(map(capitalised_sentence, (content.sentence, *content.notes)))
    figure = partial(figures.points.displacement_figure, content)
    picture = picture_if_few_items("Displacements", figure, caption, len(points))
    action = f"Inspect and re-measure these points before you use them as references: {names_text(moved_targets)}."
    if content.has_common_rigid_motion:
        action = f"If the lists are in different frames, compare them with {option_text('free=True')}."
    actions = [*([action] if moved_targets else []), *recommendations_for_causes(content.corrected_faults)]
    assessment = "caution" if content.corrected_faults and not moved_targets else assessment_of(not moved_targets)
    return Section(
        "Comparison of two epochs", "Comparison", answer, assessment, facts, [picture, *table],
        axes_text="those of the first epoch", next_actions=actions,
    )  # fmt: skip


def acceptance_section(content: AcceptanceFile, _: SectionContext) -> Section:
    """Section of acceptance tests: errors, limits and judgement."""
    predicted = content.error_origin == "predicted"
    assessment = (
        assessment_of(content.pass_probability >= MIN_GOOD_PASS_PROBABILITY)
        if content.pass_probability is not None
        else ASSESSMENT_BY_JUDGEMENT[content.judgement or "undecided"]
    )
    caption = "Error of each test divided by its limit, with its expanded uncertainty; the limit is at +-1. "
    caption += "Crosses are beyond it" + ("." if predicted else ", open circles are undecided.")
    note = f"Assumed: {content.sigma_assumption}." if content.sigma_assumption else ""
    hardest_tests = sorted(content.tests, key=lambda t: t.hardest_first_sort_key)[:MAX_LISTED_TESTS]
    last_column = "pass_probability" if predicted else "judgement"
    blocks: list[Block] = [
        picture_if_few_items(
            "Errors over limits", lambda: figures.points.error_to_limit_figure(content), caption, len(content.groups)
        ),
        *table_blocks("Groups", content.table("groups"), note=note),
        *entries_table_blocks(
            "Tests nearest to the limits", hardest_tests, "name=test", "error_um", "expanded_uncertainty_um=U (k = 2)",
            "limit_um", last_column, is_marked=lambda t: t.judgement == "rejected",
        ),
        *entries_table_blocks(
            "Sensitivity of the tests to single constants", content.sensitivities, "name=constant",
            "prior_sigma=usual size", "smallest_failing_value=detected from", "unit", "failing_test=first failed test",
        ),
    ]  # fmt: skip
    blocks += [NoteBlock("Decision rule", content.decision_rule)] if content.decision_rule else []
    worst_test = content.worst_passing_instrument
    if worst_test is not None:
        constants = ", ".join(
            f"{name} {number_text(value, 2)}"
            for name, value in worst_test.constants.items()
            if abs(value) > MAX_NEGLIGIBLE_CONSTANT
        )
        undetected_constants = [s.name for s in content.sensitivities if s.smallest_failing_value is None]
        text = f"No test detects {', '.join(undetected_constants)}. " if undetected_constants else ""
        text += (
            f"An instrument with {constants} passes every test, although points at 1.5 to 9 m have errors of "
            f"{worst_test.rms_point_error_um:.0f} um (rms; {worst_test.largest_point_error_um:.0f} um at most)."
        )
        blocks.append(NoteBlock("Undetected instrument errors", text))
    facts = [
        KeyFigure("tests", str(len(content.tests))),
        KeyFigure("judgement", content.judgement, assessment)
        if content.judgement
        else KeyFigure("probability to pass", f"{100 * (content.pass_probability or 0.0):.1f} %", assessment),
        KeyFigure("plan", content.plan_name),
        *([KeyFigure("limits", content.specification.name)] if content.specification.name else []),
    ]
    title = content.title or "Acceptance tests of a tracker"
    kind, specification_name = "Prediction" if predicted else "Acceptance", content.specification.name or ""
    return Section(
        title,
        kind,
        capitalised_sentence(content.sentence),
        assessment,
        facts,
        blocks,
        instrument_text=specification_name,
        next_actions=content.next_actions,
    )


def uncertainty_section(content: Uncertainty, _: SectionContext) -> Section:
    """Section of the uncertainties of tasks (measurands): values, expanded uncertainties and budgets."""
    judged_results = [r for r in content.results if r.conformity is not None]
    results = content.table("results").select_columns(
        "task result unit value U mc_low mc_high agrees judgement largest_source"
    )
    blocks: list[Block] = [*table_blocks("Results", results, note=UNCERTAINTY_NOTE, is_foldable=False)]
    blocks += table_blocks("Conformity (JCGM 106)", content.table("conformity"))
    caption = "Contributions to the variance of each result; improve the source with the widest bar."
    blocks.append(
        picture_if_few_items("Budget", lambda: uncertainty_budget_figure(content), caption, len(content.results))
    )
    blocks += table_blocks("Undetectable errors", content.table("hidden"), note=UNDETECTABLE_NOTE)
    warnings: list[Block] = [BulletListBlock("Warnings", content.warnings)] if content.warnings else []
    blocks = [*warnings, *blocks] if content.has_faults_or_misfit else [*blocks, *warnings]
    fields = ("source", "evaluation_type=type", "standard_uncertainty=sigma", "variance_fraction=variance fraction")
    for r in content.results:
        head = f"Budget of {r.task}, {r.name}" + (f" [{r.unit}]" if r.unit else "")
        blocks += entries_table_blocks(head, [part for part in r.budget if part.variance_fraction > 1e-3], *fields)
    result_texts_by_judgement = {w: [r.text for r in judged_results if r.conformity and r.conformity.judgement == w]
               for w in ("accepted", "rejected", "undecided")}  # fmt: skip
    answers = [f"{word}: {names_text(names, 3)}" for word, names in result_texts_by_judgement.items() if names]
    answer = "; ".join(answers) or content.results[0].text
    coverage = f"{100 * content.coverage_probability:g} %"
    facts = [KeyFigure("results", str(len(content.results))), KeyFigure("coverage probability", coverage)]
    facts += [] if content.sigma0 is None else [KeyFigure("sigma0 of the adjustment", number_text(content.sigma0))]
    judgements = [r.conformity.judgement for r in judged_results if r.conformity]
    assessment = ASSESSMENT_BY_JUDGEMENT[combined_judgement(judgements)]
    return Section(
        content.title or "Uncertainty of tasks",
        "Uncertainty",
        f"{capitalised_sentence(answer)} {content.corrections_text}".rstrip(),
        "caution" if content.has_faults_or_misfit and assessment == "good" else assessment,
        facts,
        blocks,
        axes_text=content.frame,
        next_actions=recommendations_for_causes(content.tests),
    )


def uncertainty_budget_figure(content: Uncertainty) -> Figure:
    """Figure of the uncertainty budgets of the first `MAX_BUDGET_BARS` results."""
    listed_results = content.results[:MAX_BUDGET_BARS]
    sources = dict.fromkeys(part.source for r in listed_results for part in r.budget)
    fractions = [{p.source: p.variance_fraction for p in r.budget} for r in listed_results]
    fractions_by_source = {name: [fraction.get(name, 0.0) for fraction in fractions] for name in sources}
    return figures.parameters.variance_budget_figure(
        [f"{r.task}, {r.name}" for r in listed_results], fractions_by_source
    )


def _hall_rules_sentence(content: NextMeasurement) -> str:
    """Sentence on the plan of the hall whose rules the proposed stations meet; a warning if no plan was given."""
    has_station = any(proposal.kind == "station" for proposal in content.proposals)
    if content.site:
        result = "New stations meet" if has_station else "No new station meets"
        return f"{result} the rules of {content.site} for floor, bodies and lines of sight."
    if not has_station:
        return ""
    sentence = (
        "A recording contains no floor, bodies or blocked lines of sight: check each proposed station against the "
    )
    return f"{sentence}hall, or name its plan with {option_text('site')}."


def next_measurement_section(content: NextMeasurement, _: SectionContext) -> Section:
    """Section of proposed further measurements."""
    best_proposal = content.proposals[0]
    assessment = assessment_of(best_proposal.separates_all_effects) if content.compared_effects else "plain"
    fractions = best_proposal.remaining_sigma_fraction, best_proposal.most_improved_sigma_fraction
    reductions = [100 * (1 - fraction) for fraction in fractions]
    answer = f"Measure next: {best_proposal.action} ({duration_text(60 * best_proposal.minutes)}); "
    answer += (
        f"the standard deviations of the instrument's parameters fall by {reductions[0]:.0f} % on average, "
        f"of the {parameter_text(best_proposal.most_improved_parameter)} by {reductions[1]:.0f} %."
    )
    answer = capitalised_sentence(content.advice) if content.compared_effects and content.advice else answer
    answer = " ".join([answer, *content.cause_sentences])
    assessment = "caution" if content.urgent_actions else assessment
    note = "Factors: standard deviation of a parameter after divided by before the measurement; mean and smallest."
    in_words = [
        entry.with_values(most_improved_parameter=parameter_text(entry.most_improved_parameter))
        for entry in content.proposals
    ]
    proposals = PROPOSALS_TABLE.with_rows(in_words).select_columns(
        "action minutes remaining_sigma_fraction most_improved_parameter most_improved_sigma_fraction"
    )
    note = f"{note} {_hall_rules_sentence(content)}".rstrip()
    blocks: list[Block] = [*table_blocks("Further measurements, the best first", proposals, note=note)]
    if content.compared_effects:
        effect = effect_title(content.compared_effects[0])
        explanation = f"The larger the chi2, the more reliably {effect} is separated from the alternative."
        blocks += table_blocks("Separation of the alternatives", content.table("separation"), note=explanation)
    blocks += [NoteBlock("Diagnosis of the recording", content.diagnosis)] if content.diagnosis else []
    facts = [
        KeyFigure("time for this measurement", duration_text(60 * best_proposal.minutes)),
        KeyFigure("mean decrease of sigma", f"{reductions[0]:.0f} %"),
    ]
    actions = [*content.urgent_actions, capitalised_sentence(best_proposal.action)]
    return Section("What to measure next", "Next measurement", answer, assessment, facts, blocks, next_actions=actions)


def history_section(content: History, _: SectionContext) -> Section:
    """Section of the history of an instrument: its calibrations and their changes."""
    labels = content.labels
    content = _with_short_labels(content)
    since, knows_usual_changes = content.change_since_first, len(labels) > MIN_STEPS_TO_ESTIMATE_USUAL_CHANGES
    has_changed = bool(content.events) if knows_usual_changes else since.p_value < FAMILY_WISE_LEVEL
    text = "Estimates with 95 % intervals; the band is the mean +- the spread of the true values between calibrations."
    figure = partial(figures.parameters.parameter_history_figure, labels, content.determined_parameters)
    n_estimates = len(labels) * len(content.determined_parameters)
    course = [picture_if_few_items("Course of the parameters", figure, text, n_estimates)] if n_estimates else []
    limitation = (
        "no event can be detected" if len(labels) <= MIN_STEPS_FOR_EVENT_TEST else "only a gross event can be detected"
    )
    few_calibrations_sentence = (
        f" {len(labels)} calibrations are too few to estimate the usual changes of the instrument: {limitation}."
    )
    note = (
        "Marked: without a change, such differences occur with a probability below 1 %."
        + few_calibrations_sentence * (not knows_usual_changes)
    )
    fits_note = "Where sigma0 is significantly above 1, the sigmas of that calibration are multiplied by it."
    change_table = content.table("changes")
    significant_rows = frozenset(i for i, p in enumerate(change_table.column("p_value")) if p < FAMILY_WISE_LEVEL)
    blocks: list[Block] = [
        *table_blocks("Changes between calibrations", change_table, note=note, marked_rows=significant_rows),
        *course,
        *table_blocks("Events: unusual steps", content.table("events")),
        *table_blocks("Parameters", content.table("parameters")),
        *table_blocks("Fits of the calibrations", content.table("fits"), note=fits_note),
    ]
    facts = [
        KeyFigure("calibrations", str(len(labels))),
        KeyFigure("events", str(len(content.events)), assessment_of(not content.events)),
        KeyFigure(
            "p-value, if nothing changed since the first", p_value_text(since.p_value), assessment_of(not has_changed)
        ),
    ]
    answer = f"Over {count_text(len(labels), 'calibration')} from {since.from_} to {since.to} the instrument "
    answer += _change_summary_sentence(content, knows_usual_changes)
    return Section("History of an instrument", "History", answer, assessment_of(not has_changed), facts, blocks)


def _with_short_labels(content: History) -> History:
    """History whose calibrations have shortened, but still distinct labels."""
    short = dict(zip(content.labels, labels_without_common_prefix(content.labels), strict=True))

    def with_short_label(entry: EntryBetweenCalibrationsT) -> EntryBetweenCalibrationsT:
        """Copy of an entry with the shortened labels of its calibrations."""
        ends = {"from_": short.get(entry.from_, entry.from_), "to": short.get(entry.to, entry.to)}
        return entry.model_copy(update=ends)

    return content.model_copy(
        update={
            "calibrations": tuple(c.model_copy(update={"label": short[c.label]}) for c in content.calibrations),
            "changes": tuple(map(with_short_label, content.changes)),
            "events": tuple(map(with_short_label, content.events)),
            "change_since_first": with_short_label(content.change_since_first),
        }
    )


def _change_summary_sentence(content: History, knows_usual_changes: bool) -> str:
    """Last part of the summary sentence of a history: events, or changes since the first calibration.

    `knows_usual_changes` is True if there are enough calibrations to compare with the usual changes of the instrument.
    """
    since, events = content.change_since_first, content.events
    tested = f"(chi2 {since.chi2:.0f} for {since.dof}, {p_value_relation_text(since.p_value)})"
    if events:
        steps = names_text(list(dict.fromkeys(f"between {e.from_} and {e.to}" for e in events)))
        names = names_text(list(dict.fromkeys(e.name for e in events)))
        return f"had an event (such as a service or a blow) {steps}, in {names}."
    if since.p_value >= FAMILY_WISE_LEVEL:
        between = [f"{c.from_} and {c.to}" for c in content.changes if c.p_value < FAMILY_WISE_LEVEL]
        exception = f", though it did between {names_text(between)}" if between else ""
        return f"shows no change since the first {tested}{exception}."
    if knows_usual_changes:
        return f"changed no more than it usually does between calibrations {tested}."
    names = names_text(since.changed_parameters)
    phrase = f"mainly in {names}" if names else "in no single parameter significantly"
    return f"has changed since the first, {phrase} {tested}."
