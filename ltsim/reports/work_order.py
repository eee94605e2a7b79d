"""Work order, a page for the shop floor: places of the tripods by tape, order of the measurements, checks."""

from ltsim.core.units import MILLIMETRE
from ltsim.planning.plan import Plan
from ltsim.planning.work_order import checks, settings_of
from ltsim.reports.document import Block, Document, Grid, Note, Notes, Picture, Section
from ltsim.reports.page import render, versions
from ltsim.reports.words import duration


def work_order_page(plan: Plan) -> str:
    """HTML page of the work order of a plan."""
    survey = plan.chosen.survey
    title = f"Work order: {plan.file.title or plan.scenario.title or 'the plan'}"
    section = Section(title=title, kind="Work order", answer=f"{survey.words}.", blocks=_blocks(plan))
    return render(Document(title, section.answer, "plain", [section], versions()))


def _blocks(plan: Plan) -> list[Block]:
    stations = settings_of(plan)
    survey = plan.chosen.survey
    rows = [
        [s.name, f"{s.height:.2f}", *(f"{t.metres:.2f} m to {t.to}{'' if t.floor else ' (straight)'}" for t in s.tapes),
         *[""] * (3 - len(s.tapes)), s.towards]
        for s in stations
    ]  # fmt: skip
    header = ["station", "head over floor [m]", "tape 1", "tape 2", "tape 3", "azimuth zero looks"]
    note = (
        "Distances are on the floor, from the mark under the tracker head to the floor under the point; straight ones "
        "are from the centre of the head to the reflector. Two distances set the place, the third checks it."
    )
    note = " ".join([note, *(f"{s.name}: {s.lacking}" for s in stations if s.lacking)])
    blocks: list[Block] = [
        Grid("Places of the tripods", header, rows, 6, note),
        Picture(
            "Floor plan",
            plan.plot,
            "Seen from above; x and y in metres. The elevation limit hides the floor inside the circles.",
        ),
        Notes("Checks", checks(plan)),
    ]
    faces = "in both faces" if len(survey.faces) == 2 else f"in face {survey.faces[0]}"
    rounds = "once" if survey.repeats == 1 else f"{survey.repeats} rounds"
    for s in stations:
        again = ", ".join(f"{name} within {limit / MILLIMETRE:.3f} mm" for name, limit in s.again.items())
        head = f"{len(s.order)} points {faces}, {rounds}, {duration(60 * s.minutes)}"
        text = f"{head}: {', '.join(s.order)}. Again: {again}."
        blocks.append(Note(f"{s.name}: order of work", text))
    blocks += _before(plan)
    text = (
        "nominals.csv has the points for the tracker's software, work-order.csv every pointing with its expected "
        "readings, scenario.toml the same work for a simulation. "
    )
    blocks.append(Note("Files", f"{text}A move of the tripod is assumed to take {duration(survey.seconds_per_move)}."))
    return blocks


def _before(plan: Plan) -> list[Block]:
    """Proposals to move or add a reflector before the work."""
    worth = [change for change in plan.changes.reported if change.do != "remove"]
    if not worth:
        return []
    lines = [f"{c.deed}: the other points improve by {c.gain_um:.2f} µm, most of all {c.serves}" for c in worth]
    return [Notes("Possible improvements: one of these (z from the floor), then plan again", lines)]
