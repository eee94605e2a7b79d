"""Section of a plan: positions of the tripods, quality, duration, and undetectable effects."""

from functools import partial

import numpy as np

from ltsim.core.notation import names_text, number_text
from ltsim.core.units import MILLIMETRE
from ltsim.planning.plan_entries import PlannedLayoutEntry
from ltsim.planning.result import Plan
from ltsim.reports import figures
from ltsim.reports.document_model import (
    Block,
    BulletListBlock,
    CodeBlock,
    KeyFigure,
    NoteBlock,
    PictureBlock,
    Section,
    SectionContext,
    assessment_of,
    picture_if_few_items,
    table_blocks,
)
from ltsim.reports.formatting import QUALITY_MEASURE_BY_GOAL, duration_text, tracker_preset_names_text
from ltsim.reports.sections.network import scene_block, undetermined_combination_tables
from ltsim.simulation.scenario import Scenario, load_scenario

UNDETECTABLE_EFFECTS_TEXT = (
    "These effects change no residual of this layout, or depend on data that the plan does not contain, such as a "
    "reference length. Blunders (exchanged names, wrong units, confused faces) have no smallest size: check, adjust, "
    "calibrate and diagnose identify them by separate tests."
)
"""Explanation of the list of undetectable effects of a plan."""


def plan_section(content: Plan, context: SectionContext) -> Section:
    """Section of a `plan.json`, with pictures from the `scenario.toml` in its folder.

    Raises
    ------
    RecordError, InputError
        When a file is malformed.
    """
    frame = f"{content.frame[:1].upper()}{content.frame[1:]}." if content.frame else ""
    blocks: list[Block] = [*table_blocks("Positions of the tripod", content.table("stations"), note=frame)]
    scenario_file = context.companion_file("scenario.toml", content)
    scenario = None if scenario_file is None else load_scenario(scenario_file)
    layout_pictures, change_pictures = _layout_pictures(content, scenario, has_3d_view=context.hall_view == "3d")
    blocks += layout_pictures
    if content.blocked_sights:
        blocks.append(BulletListBlock("Blocked lines of sight", content.blocked_sights))
    if content.reasons:
        blocks.append(BulletListBlock("Reasons for this plan", content.reasons))
    blocks += _tolerance_tables(content) + _reflector_changes_blocks(content) + change_pictures
    blocks += _trade_off_blocks(content) + _predicted_sigma_blocks(content)
    blocks += table_blocks("Expected disagreement of the stations", content.table("expected"))
    blocks += undetermined_combination_tables("Not determined by this layout", content.undetermined)
    blocks += _detectability_blocks(content)
    note = "U: expanded uncertainty, k = 2, in the frame that all points define together."
    points = content.table("reflectors").select_columns("target x_mm y_mm z_mm U_x_um U_y_um U_z_um visible_from")
    blocks += table_blocks("Points", points, note=note)
    if content.obstacle_sentences:
        blocks.append(BulletListBlock("Bodies in the hall", content.obstacle_sentences))
    blocks.append(CodeBlock("Settings of the plan", content.settings.model_dump_json(indent=1)))
    assessment = assessment_of(not content.broken_rules and content.goal_reached is not False)
    return Section(
        title=content.title or "Plan of a network", kind="Plan", summary=content.summary, assessment=assessment,
        key_figures=_key_figures(content), blocks=blocks, seed_text="" if content.seed is None else str(content.seed),
        instrument_text=tracker_preset_names_text([scenario]) if scenario else "", measurement_date="planned",
        axes_text="those of the hall",
    )  # fmt: skip


def _tolerance_tables(content: Plan) -> list[Block]:
    """Tables of the points with their tolerances: for the plan, and after the loss of a station or line of sight."""
    tolerance_table = content.table("tolerances")
    if not tolerance_table.rows:
        return []
    level = content.settings.goal.confidence_level_pct
    missed_rows = frozenset(i for i, is_met in enumerate(tolerance_table.column("tolerance_met")) if not is_met)
    blocks: list[Block] = [
        *table_blocks(f"Points against their tolerances, at {level:g} %", tolerance_table, marked_rows=missed_rows)
    ]
    return [*blocks, *table_blocks("Loss of a station or a sight", content.table("losses"))]


def _reflector_changes_blocks(content: Plan) -> list[Block]:
    """Table of the reflectors to move, to add or to omit; a note if no such change improves the plan."""
    title, changes = "Reflectors to move, to add or to omit", content.table("changes")
    if not changes.rows:
        return [NoteBlock(title, content.reflector_changes_sentence)] if content.reflector_changes_sentence else []
    return [*table_blocks(title, changes, note=content.reflector_changes_sentence)]


def _key_figures(content: Plan) -> list[KeyFigure]:
    """Key figures of a plan: quality, duration, tolerances and broken rules."""
    facts = [
        KeyFigure("stations", str(len(content.stations))),
        KeyFigure("pointings", str(content.pointings)),
        KeyFigure("work", duration_text(3600.0 * content.hours)),
    ]
    if content.goal_reached is not None:
        facts.insert(
            0,
            KeyFigure(
                "goal", "reached" if content.goal_reached else "not reached", assessment_of(content.goal_reached)
            ),
        )
    facts += [KeyFigure("broken rule", rule, "bad") for rule in content.broken_rules]
    reference_measures = {} if content.reference_layout is None else _quality_measures(content.reference_layout)
    for label, value in _quality_measures(content).items():
        reference_value = reference_measures.get(label)
        assessment = "plain" if reference_value is None else assessment_of(value <= reference_value)
        text = number_text(value) + (f" (was {number_text(reference_value)})" if reference_value else "")
        facts.append(KeyFigure(label, text, assessment))
    return facts


def _quality_measures(layout: PlannedLayoutEntry) -> dict[str, float]:
    """Quality measures of a layout in display units, by label: rms sigma of all points, measures of the goal."""
    measures = {name: value for name, value in layout.qualities.items() if value is not None}
    labels = {name: QUALITY_MEASURE_BY_GOAL.get(name, (name, 1.0)) for name in measures}
    rms = {} if layout.rms_sigma_um is None else {"all points: rms sigma [um]": layout.rms_sigma_um}
    return rms | {label: factor * measures[name] for name, (label, factor) in labels.items()}


def _layout_pictures(content: Plan, scenario: Scenario | None, *, has_3d_view: bool) -> tuple[list[Block], list[Block]]:
    """Two lists of blocks: floor plan and 3D view of a plan, and floor plan with the proposed changes of reflectors.

    Both lists are empty without a scenario.
    """
    if scenario is None:
        return [], []
    from ltsim.reports.workshop_scene import workshop_from_scenario

    workshop = workshop_from_scenario(scenario)
    reference = content.reference_layout.stations if content.reference_layout else ()
    reference_positions = np.array([s.position_mm for s in reference], dtype=np.float64).reshape(-1, 3) * MILLIMETRE
    text = "Seen from above; x and y in metres. The tracker does not see the floor inside the circles." + (
        " Hollow: the stations of the reference layout." if len(reference_positions) else ""
    )
    floor_areas = content.settings.floor
    n_areas = 0 if floor_areas is None else len(floor_areas.areas + floor_areas.keep_outs + floor_areas.doors)
    floor = figures.floor_plan
    pictures: list[Block] = [
        picture_if_few_items(
            "Floor plan",
            lambda: floor.floor_plan(workshop, reference=reference_positions, floor=floor_areas),
            text,
            len(workshop.stations) + len(reference_positions) + n_areas,
        )
    ]
    pictures += [scene_block(workshop)] if has_3d_view else []
    text = "The numbers refer to the table; an arrow starts at the present position of a reflector."
    changes = partial(
        figures.marked_floor_plans.reflector_changes_floor_plan, workshop, content.reflector_changes, floor_areas
    )
    n_changes = len(content.reflector_changes)
    return pictures, [
        picture_if_few_items("Positions of these reflectors", changes, text, n_changes)
    ] if n_changes else []


def _trade_off_blocks(content: Plan) -> list[Block]:
    """Figures of quality over duration, and table of the alternative layouts that the search compared."""
    text = "Each dot is the best layout for one combination of the numbers of stations, faces and rounds."
    blocks: list[Block] = [
        PictureBlock(f"Time against quality: {name}", partial(figures.parameters.trade_off_figure, content, name), text)
        for name, value in content.qualities.items()
        if value is not None and sum(option.qualities.get(name) is not None for option in content.tradeoff_points) > 1
    ]
    alternatives = content.table("tradeoff")
    objective = "point_error_um" if any(alternatives.column("point_error_um")) else "objective_value"
    shown_columns = alternatives.select_columns(f"station_count faces repeats pointings hours {objective} is_efficient")
    note = f"A smaller {'weighted point error' if objective == 'point_error_um' else 'objective'} is better."
    return [*blocks, *table_blocks("Alternatives: stations, faces and rounds", shown_columns, note=note)]


def _predicted_sigma_blocks(content: Plan) -> list[Block]:
    """List with the figure of the predicted sigmas of the instrument's parameters; empty without parameters."""
    reference_sigmas = (
        {p.name: p.sigma for p in content.reference_layout.parameters} if content.reference_layout else {}
    )
    estimated_parameters = [p for p in content.parameters if p.prior_sigma and p.sigma > 0]
    text = "Prediction; on the dashed line the recording would add no information."
    figure = partial(figures.parameters.predicted_sigmas_figure, estimated_parameters, reference_sigmas)
    return (
        [
            picture_if_few_items(
                "Predicted sigma of the instrument's parameters", figure, text, len(estimated_parameters)
            )
        ]
        if estimated_parameters
        else []
    )


def _detectability_blocks(content: Plan) -> list[Block]:
    """Blocks on effects: smallest detectable sizes, pairs that are hard to separate, undetectable effects."""
    note = "Size that is detected in 80 % of the recordings of this layout: most and least favourable location."
    blocks: list[Block] = [*table_blocks("Smallest detectable effects", content.table("effects"), note=note)]
    note = "Fraction of the residuals from the first effect that the second effect explains."
    blocks += table_blocks("Effects that are hard to separate", content.table("confusable"), note=note)
    if content.undetectable_effects:
        effect_names = names_text(content.undetectable_effects, len(content.undetectable_effects))
        blocks.append(NoteBlock("Undetectable effects", f"{effect_names}. {UNDETECTABLE_EFFECTS_TEXT}"))
    return blocks
