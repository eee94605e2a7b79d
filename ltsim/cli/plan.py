"""Command `plan`: layouts of stations and reflectors, and the next measurement."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.cli.options import Jobs, ReadingOptions
from ltsim.cli.places import FOLDER, Force, check_overwrite
from ltsim.cli.terminal import Terminal
from ltsim.core.errors import RecordError, SetupError

if TYPE_CHECKING:
    from ltsim.physics.effects.signature import Signature
    from ltsim.planning.result import Plan
    from ltsim.planning.survey import PlannedSurvey
    from ltsim.planning.verbs import StationAlternative
    from ltsim.recordings import Recording

PlanSource = Annotated[
    str | None,
    typer.Argument(metavar="FILE", help="A plan file, a scenario file, or the name of a built-in one."),
]
PlanOut = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Folder to write to; default plan-NAME, none with --json."),
    FOLDER,
]
Show = Annotated[bool, typer.Option("--show", help="Print a built-in plan as a file to edit, and stop.")]
After = Annotated[
    Path | None, typer.Option("--after", metavar="REC", help="Rank further measurements after this recording.")
]
Between = Annotated[
    str | None,
    typer.Option(
        "--between", metavar="A,B", help="With --after: effects to discriminate; default from a diagnosis of REC."
    ),
]
Without = Annotated[
    str | None,
    typer.Option(
        "--without", metavar="STATION", help="List other places for a station, with the other stations fixed."
    ),
]
SO_FAR = "best-so-far.toml"
FLOOR = "floor.png"
TRADE_OFF = "tradeoff.png"
PAGE = "work-order.html"


def plan(
    source: PlanSource = None,
    out: PlanOut = None,
    jobs: Jobs = 2,
    show: Show = False,
    after: After = None,
    between: Between = None,
    without: Without = None,
    *,
    reading: ReadingOptions,
    force: Force = False,
    terminal: Terminal,
    **options: Any,
) -> None:
    """Find a layout of stations and reflectors, with reasons; or, with --after, the next measurement.

    Writes plan.json, stations.csv (places of the tripod), reflectors.csv, tradeoff.csv, scenario.toml for
    `ltsim simulate`, work-order.html for the shop floor, nominals.csv and work-order.csv for the tracker's software,
    and the pictures floor.png and tradeoff.png. Ctrl-C ends the search with the best layout so far; during the search
    that layout is in best-so-far.toml. FILE may be the folder of a plan: --without and --move evaluate its layout with
    one station elsewhere.

    Example: ltsim plan paper-workshop --out my-plan
    """
    from ltsim.planning.loading import plan_names, plan_text
    from ltsim.planning.proposals import PROPOSALS_TABLE, NextMeasurement
    from ltsim.planning.result import Plan
    from ltsim.planning.tables import PLAN_TABLES

    if after is not None:
        if source is not None:
            raise SetupError("ltsim plan needs either FILE or --after REC, not both")
        check_overwrite(out, NextMeasurement, (PROPOSALS_TABLE.file,), force=force)
        return _after(terminal, reading.of(after), _explanations(between), out)
    if between is not None:
        raise SetupError("--between needs --after REC, the recording that has several explanations")
    if source is None:
        raise SetupError(f"ltsim plan needs FILE, a plan file or a built-in plan ({', '.join(plan_names())})")
    if show:
        terminal.show(plan_text(source))
        return None
    changes = options.pop("move")
    if without is not None and (changes or out is not None):
        raise SetupError(
            "--without lists places for a station and takes neither --move nor --out; use --move to evaluate a place"
        )
    if without is not None:
        return _show_places(terminal, source, lt.station_alternatives(source, without))
    nowhere = terminal.as_json or bool(changes)
    folder = out if out is not None or nowhere else Path(f"plan-{Path(source).stem}")
    check_overwrite(
        folder, Plan, (*(table.file for table in PLAN_TABLES), "scenario.toml", FLOOR, TRADE_OFF, PAGE), force=force
    )
    if changes:
        with terminal.progress("judging the layout"):
            made = lt.plan(source, move=changes)
    else:
        made = _searched(terminal, source, folder, {"jobs": jobs, **options})
    return _write(terminal, made, folder)


def _show_places(terminal: Terminal, source: str, alternatives: Sequence[StationAlternative]) -> None:
    terminal.answer(
        [
            {
                "what": alternative.position_text,
                "verdict": alternative.verdict,
                "good": alternative.meets_goal,
                "move": alternative.move_option,
            }
            for alternative in alternatives
        ]
    )
    for alternative in alternatives:
        terminal.say(f"- {alternative.position_text}: {alternative.verdict}.")
    places = [alternative for alternative in alternatives if alternative.move_option]
    if not places:
        terminal.say(
            "No other place is allowed for this station; enlarge the floor area, or search with one station less."
        )
        return
    out = Path(f"{Path(source).stem}-moved")
    command = shlex.join(["ltsim", "plan", source, "--move", places[0].move_option, "--out", str(out)])
    terminal.say(f"To take the best of these places: {command}")


def _searched(terminal: Terminal, source: str, folder: Path | None, how: dict[str, Any]) -> Plan:
    """The plan of a search; the best layout so far is printed and written during the search."""
    from ltsim.planning.layout_scenario import copy_cad_files, with_layout
    from ltsim.planning.making import SearchCallbacks
    from ltsim.planning.result import load_plan_and_scenario
    from ltsim.recordings.files import write_texts
    from ltsim.simulation.scenario import scenario_to_toml
    from ltsim.simulation.workshop import placed_obstacles

    _, scenario = load_plan_and_scenario(source)
    for body in placed_obstacles(scenario):
        terminal.say(body.description)

    def keep(survey: PlannedSurvey) -> None:
        if folder is not None:
            stored, cad = copy_cad_files(with_layout(scenario, survey))
            try:
                write_texts(folder, {**cad, SO_FAR: scenario_to_toml(stored)})
            except RecordError as problem:
                terminal.note(f"the best layout so far was not written: {problem}")

    with terminal.progress("searching layouts", 100) as advance:
        made = lt.plan(source, **how, callbacks=SearchCallbacks(_percent(advance), terminal.print_now, keep))
    if folder is not None:
        (folder / SO_FAR).unlink(missing_ok=True)
    return made


def _write(terminal: Terminal, made: Plan, folder: Path | None) -> None:
    from ltsim.planning.result import write_plan

    with terminal.progress("writing tables, pictures and the work order"):
        content = write_plan(made, folder, {} if folder is None else _drawn(made))
    terminal.result(content)
    if folder is not None:
        terminal.say(f"\nwritten to {folder}; {PAGE} is for the shop floor, nominals.csv for the tracker's software")
        terminal.say(f"for a page with pictures: ltsim report {folder}; in 3D: ltsim view {folder / 'scenario.toml'}")


def _drawn(made: Plan) -> dict[str, bytes]:
    """Contents of the files with pictures: work order, floor plan, trade-off of time and quality."""
    from ltsim.reports.figures.parameters import trade_off
    from ltsim.reports.style import png
    from ltsim.reports.work_order import work_order_page

    drawn = {PAGE: work_order_page(made).encode(), FLOOR: png(made.plot())}
    return drawn | ({TRADE_OFF: png(trade_off(made, next(iter(made.quality))))} if made.tradeoff else {})


def _percent(advance: Any) -> Any:
    """Progress callback that converts fractions into steps of a bar of 100."""
    done = 0

    def report(_task: str, fraction: float) -> None:
        nonlocal done
        advance(int(100 * fraction) - done)
        done = int(100 * fraction)

    return report


def _explanations(between: str | None) -> tuple[str, ...]:
    if between is None:
        return ()
    names = tuple(name.strip() for name in between.split(","))
    if len(names) < 2 or not all(names) or len(set(names)) < len(names):
        raise SetupError(
            f"--between is {between}, expected two or more different effects, such as range-step,station-weather"
        )
    return names


def _after(terminal: Terminal, recording: Recording, between: tuple[str, ...], out: Path | None) -> None:
    from ltsim.diagnosis.detectability import open_question
    from ltsim.recordings.result_file import write_result

    terminal.say(recording.headline)
    summary = ""
    modelled: tuple[Signature, ...] = ()
    if not between:
        with terminal.progress("diagnosing"):
            diagnosis = lt.diagnose(recording)
        summary = diagnosis.summary
        terminal.say(summary)
        between, modelled = open_question(diagnosis)
    with terminal.progress("trying further measurements", 200) as advance:
        reports: dict[str, Any] = {}
        content = lt.next_measurement(
            recording,
            between=between,
            with_effects=modelled,
            progress=lambda task, fraction: reports.setdefault(task, _percent(advance))(task, fraction),
        )
    content = content.model_copy(update={"diagnosis": summary})
    if out is not None:
        table = content.table()
        content = write_result(out, content, {table.file: table.csv()})
    terminal.result(content, out)
