"""Page of the work order of a plan: positions of the tripods, order of the points, checks."""

from ltsim.core.units import MILLIMETRE
from ltsim.planning.result import Plan
from ltsim.planning.tables import TAPE_DISTANCES_TABLE
from ltsim.planning.work_order import operator_check_sentences, station_instructions
from ltsim.reports.document_model import (
    Block,
    BulletListBlock,
    Document,
    NoteBlock,
    PictureBlock,
    Section,
    table_blocks,
)
from ltsim.reports.formatting import duration_text
from ltsim.reports.page import package_versions, page_html


def work_order_page(plan: Plan) -> str:
    """HTML page of the work order of a plan."""
    survey = plan.network.layout.survey
    title = f"Work order: {plan.title or 'the plan'}"
    is_rejected = plan.goal_reached is False or bool(plan.broken_rules)
    section = Section(
        title=title,
        kind="Work order",
        summary=f"Do not measure this layout: {plan.summary}" if is_rejected else f"{survey.extent_text}.",
        assessment="bad" if is_rejected else "plain",
        blocks=_work_order_blocks(plan),
    )
    return page_html(Document(title, section.summary, section.assessment, [section], package_versions()))


def _work_order_blocks(plan: Plan) -> list[Block]:
    """Blocks of a work order: positions of the tripods, floor plan, and order of the points at each station."""
    network = plan.network
    stations, survey = station_instructions(network), network.layout.survey
    places = TAPE_DISTANCES_TABLE.with_rows(
        [
            s.name,
            *(tape.text for tape in s.tape_distances),
            *[""] * (3 - len(s.tape_distances)),
            s.zero_direction_text,
            s.head_height,
        ]
        for s in stations
    )
    note = (
        "Distances are on the floor, from the mark under the tracker head to the floor under the point; straight "
        "distances are from the centre of the head to the reflector. Two distances define the position of the tripod, "
        "the third one checks it."
    )
    note = " ".join([note, *(f"{s.name}: {s.deficiency_sentence}" for s in stations if s.deficiency_sentence)])
    blocks: list[Block] = [
        *table_blocks("Positions of the tripods", places, note=note),
        PictureBlock(
            "Floor plan",
            plan.plot,
            "Seen from above; x and y in metres. The tracker does not see the floor inside the circles.",
        ),
        BulletListBlock("Checks", operator_check_sentences(network)),
    ]
    faces = "in both faces" if len(survey.faces) == 2 else f"in face {survey.faces[0]}"
    rounds = "once" if survey.repeats == 1 else f"{survey.repeats} rounds"
    for s in stations:
        repetition_text = ", ".join(
            f"{name} within {limit / MILLIMETRE:.3f} mm"
            for name, limit in s.permitted_difference_by_repeated_target.items()
        )
        work_text = f"{len(s.target_order)} points {faces}, {rounds}, {duration_text(60 * s.minutes)}"
        text = f"{work_text}: {', '.join(s.target_order)}. Again: {repetition_text}."
        blocks.append(NoteBlock(f"{s.name}: order of work", text))
    blocks += _reflector_proposals_block(plan)
    text = (
        "nominals.csv contains the points for the tracker's software, work-order.csv every pointing with its expected "
        "readings, and scenario.toml the same measurement for a simulation. "
    )
    blocks.append(
        NoteBlock("Files", f"{text}A move of the tripod is assumed to take {duration_text(survey.seconds_per_move)}.")
    )
    return blocks


def _reflector_proposals_block(plan: Plan) -> list[Block]:
    """List with a block of proposals to move or add a reflector before the work; empty without proposals."""
    moves_and_additions = [change for change in plan.reflector_changes if change.kind != "remove"]
    if not moves_and_additions:
        return []
    lines = [
        f"{c.action_text}: the errors of the other points decrease by {c.target_rms_decrease_um:.2f} µm. "
        f"The parameter that improves most is {c.most_affected_parameter}."
        for c in moves_and_additions
    ]
    return [BulletListBlock("Possible improvements: one of these (z from the floor), then plan again", lines)]
