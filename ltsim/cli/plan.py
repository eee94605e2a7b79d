"""Command `plan`: search for layouts of stations and reflectors, and proposals for the next measurement."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.cli.options import FunctionOptions, JobsOption, PairParser, ReadingOptions, bounded_option
from ltsim.cli.output_checks import RESULT_FOLDER_OUTPUT, ForceOption, check_overwrite
from ltsim.cli.terminal import Terminal
from ltsim.core.errors import InputError, RecordError

if TYPE_CHECKING:
    from ltsim.physics.effects.linear_effect import LinearEffect
    from ltsim.planning.result import Plan
    from ltsim.planning.survey import PlannedSurvey
    from ltsim.planning.verbs import StationAlternative
    from ltsim.recordings import Recording
    from ltsim.simulation.scenario import Scenario

PlanSourceArgument = Annotated[
    str | None,
    typer.Argument(metavar="FILE", help="A plan file, a scenario file, or the name of a built-in one."),
]
PlanFolderOption = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Folder to write to; default plan-NAME, none with --json or --move."),
    RESULT_FOLDER_OUTPUT,
]
ShowPlanOption = Annotated[bool, typer.Option("--show", help="Print a built-in plan as a file to edit, and stop.")]
RecordingToExtendOption = Annotated[
    Path | None, typer.Option("--after", metavar="REC", help="Rank additional measurements after this recording.")
]
ComparedEffectsOption = Annotated[
    str | None,
    typer.Option(
        "--between",
        metavar="A,B",
        help="With --after: effects to distinguish; default: those that a diagnosis of REC cannot distinguish.",
    ),
]
SitePlanOption = Annotated[
    str | None,
    typer.Option(
        "--site",
        metavar="PLAN",
        help="With --after: plan, its folder, or scenario of the hall; its floor and obstacles restrict new stations.",
    ),
]
BlockedStationOption = Annotated[
    str | None,
    typer.Option(
        "--without", metavar="STATION", help="List other positions for a station, with the other stations fixed."
    ),
]
BEST_LAYOUT_SO_FAR_FILE = "best-so-far.toml"
"""Name of the scenario file with the best layout so far, which exists only while a search runs."""


@dataclass(frozen=True)
class PlanOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.plan`."""

    starts: Annotated[
        int | None, bounded_option("starts", "Number of independent searches; default from the plan file.")
    ] = None
    seed: Annotated[
        int | None, bounded_option("seed", "Seed of the random draws of the search; default from the plan file.")
    ] = None
    move: Annotated[
        list[str] | None,
        typer.Option(
            "--move",
            metavar="STATION=X,Y[,Z[,YAW]]",
            help="Positions of stations, x, y, z in mm and yaw in degrees; yaw, or z and yaw, can be omitted. The "
            "layout with these positions is evaluated, without a search.",
        ),
        PairParser("move", lambda text: text.split(",")),
    ] = None


def plan(
    source: PlanSourceArgument = None,
    *,
    options: PlanOptions,
    out: PlanFolderOption = None,
    jobs: JobsOption = 2,
    show: ShowPlanOption = False,
    after: RecordingToExtendOption = None,
    between: ComparedEffectsOption = None,
    site: SitePlanOption = None,
    without: BlockedStationOption = None,
    reading_options: ReadingOptions,
    force: ForceOption = False,
    terminal: Terminal,
) -> None:
    """Find a layout of stations and reflectors, with reasons; or, with --after, the next measurement.

    Writes plan.json, stations.csv (positions of the tripod), reflectors.csv, tradeoff.csv, scenario.toml for `ltsim
    simulate`, work-order.html for the shop floor, nominals.csv and work-order.csv for the tracker's software, and the
    pictures floor.png and tradeoff.png. Ctrl-C ends the search with the best layout so far; during the search that
    layout is in best-so-far.toml. FILE may be the folder of a plan: --without and --move evaluate its layout with one
    station at another position.

    Example: ltsim plan paper-workshop --out my-plan
    """
    from ltsim.planning.loading import builtin_plan_names, builtin_plan_text
    from ltsim.planning.proposals import NextMeasurement
    from ltsim.planning.result import Plan

    if after is not None:
        if source is not None:
            raise InputError("ltsim plan needs either FILE or --after REC, not both")
        check_overwrite(out, NextMeasurement, force=force)
        return _propose_next_measurement(terminal, reading_options.read(after), _parse_effect_names(between), site, out)
    if between is not None:
        raise InputError("--between needs --after REC, the recording that several effects explain")
    if site is not None:
        raise InputError("--site needs --after REC, the recording to which a station is added")
    if source is None:
        raise InputError(f"ltsim plan needs FILE, a plan file or a built-in plan ({', '.join(builtin_plan_names())})")
    if show:
        terminal.print_always(builtin_plan_text(source))
        return None
    arguments = options.arguments()
    moved_stations = arguments.pop("move", None)
    if without is not None and (moved_stations or out is not None):
        raise InputError(
            "--without lists positions for a station and cannot be used with --move or --out; evaluate one with --move"
        )
    if without is not None:
        return _print_station_alternatives(terminal, source, lt.station_alternatives(source, without))
    writes_no_files = terminal.as_json or bool(moved_stations)
    folder = out if out is not None or writes_no_files else Path(f"plan-{Path(source).stem}")
    check_overwrite(folder, Plan, force=force)
    if moved_stations:
        with terminal.show_progress("evaluating the layout"):
            plan_result = lt.plan(source, move=moved_stations)
    else:
        plan_result = _search_plan(terminal, source, folder, {"jobs": jobs, **arguments})
    return _write_and_print_plan(terminal, plan_result, folder)


def _print_station_alternatives(terminal: Terminal, source: str, alternatives: Sequence[StationAlternative]) -> None:
    """Output of alternative positions for a station, and of the command that moves it to the best position.

    `source` is the plan of which the station is a part.
    """
    terminal.print_json(
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
        terminal.print_text(f"- {alternative.position_text}: {alternative.verdict}.")
    places = [alternative for alternative in alternatives if alternative.move_option]
    if not places:
        terminal.print_text(
            "No other position is permitted for this station; enlarge the floor, or search with one station less."
        )
        return
    out = Path(f"{Path(source).stem}-moved")
    command = shlex.join(["ltsim", "plan", source, "--move", places[0].move_option, "--out", str(out)])
    terminal.print_text(f"To plan with the best of these positions: {command}")


def _search_plan(terminal: Terminal, source: str, folder: Path | None, search_options: dict[str, Any]) -> Plan:
    """Plan from a search for a layout; during the search each better layout is printed and written to `folder`.

    `search_options` are keyword arguments of `lt.plan`.
    """
    from ltsim.planning.plan_search import SearchCallbacks
    from ltsim.planning.result import scenario_with_layout, with_cad_file_copies
    from ltsim.recordings.files import write_texts
    from ltsim.simulation.scenario import scenario_to_toml
    from ltsim.simulation.workshop import placed_obstacles

    scenarios: list[Scenario] = []

    def describe_obstacles(scenario: Scenario) -> None:
        scenarios.append(scenario)
        for body in placed_obstacles(scenario):
            terminal.print_unbuffered(body.description)

    def write_best_layout(survey: PlannedSurvey) -> None:
        if folder is not None:
            (scenario,) = scenarios
            stored_scenario, cad_files = with_cad_file_copies(scenario_with_layout(scenario, survey))
            try:
                write_texts(folder, {**cad_files, BEST_LAYOUT_SO_FAR_FILE: scenario_to_toml(stored_scenario)})
            except RecordError as problem:
                terminal.print_note(f"the best layout so far was not written: {problem}")

    with terminal.show_progress("searching layouts", 100) as advance:
        plan_result = lt.plan(
            source,
            **search_options,
            callbacks=SearchCallbacks(
                _progress_bar_callback(advance), terminal.print_unbuffered, describe_obstacles, write_best_layout
            ),
        )
    if folder is not None:
        (folder / BEST_LAYOUT_SO_FAR_FILE).unlink(missing_ok=True)
    return plan_result


def _write_and_print_plan(terminal: Terminal, plan_result: Plan, folder: Path | None) -> None:
    """Output of a plan on the terminal and, if a folder is given, as files with tables, pictures and work order."""
    from ltsim.planning.result import WORK_ORDER_FILE, write_plan

    with terminal.show_progress("writing tables, pictures and the work order"):
        content = write_plan(plan_result, folder, {} if folder is None else _work_order_and_picture_files(plan_result))
    terminal.print_result(content)
    if folder is not None:
        terminal.print_text(
            f"\nwritten to {folder}; {WORK_ORDER_FILE} is for the shop floor, nominals.csv for the tracker's software"
        )
        terminal.print_text(
            f"for a page with pictures: ltsim report {folder}; in 3D: ltsim view {folder / 'scenario.toml'}"
        )
    else:
        terminal.print_text("\nNo file was written; --out DIR writes this plan.")


def _work_order_and_picture_files(plan_result: Plan) -> dict[str, bytes]:
    """Contents of the work order page and of the pictures (floor plan, trade-off curve), by file name."""
    from ltsim.planning.result import FLOOR_PLAN_FILE, TRADE_OFF_FILE, WORK_ORDER_FILE
    from ltsim.reports.figures.parameters import trade_off_figure
    from ltsim.reports.style import png_bytes
    from ltsim.reports.work_order_page import work_order_page

    content_by_name = {
        WORK_ORDER_FILE: work_order_page(plan_result).encode(),
        FLOOR_PLAN_FILE: png_bytes(plan_result.plot()),
    }
    return content_by_name | (
        {TRADE_OFF_FILE: png_bytes(trade_off_figure(plan_result, next(iter(plan_result.qualities))))}
        if plan_result.tradeoff_points
        else {}
    )


def _progress_bar_callback(advance_bar: Callable[[int], None]) -> Callable[[str, float], None]:
    """Callback (task, fraction) that advances a progress bar of 100 steps to the finished fraction (0 to 1).

    `advance_bar` advances the bar by a number of steps.
    """
    done_percent = 0

    def advance_to(_task: str, fraction: float) -> None:
        nonlocal done_percent
        advance_bar(int(100 * fraction) - done_percent)
        done_percent = int(100 * fraction)

    return advance_to


def _parse_effect_names(effect_list: str | None) -> tuple[str, ...]:
    """Names of effects from a comma-separated list; raises InputError for fewer than two or repeated names."""
    if effect_list is None:
        return ()
    names = tuple(name.strip() for name in effect_list.split(","))
    if len(names) < 2 or not all(names) or len(set(names)) < len(names):
        raise InputError(
            f"--between is {effect_list}, expected two or more different effects, such as range-step,station-weather"
        )
    return names


def _propose_next_measurement(
    terminal: Terminal,
    recording: Recording,
    effect_names: tuple[str, ...],
    site: str | None,
    result_folder: Path | None,
) -> None:
    """Output of measurements that distinguish the named effects, or else those that a diagnosis cannot distinguish."""
    from ltsim.diagnosis.detectability import explanations_of_ambiguous_finding
    from ltsim.recordings.result_file import write_result

    terminal.print_text(recording.headline)
    summary = ""
    modelled_effects: tuple[LinearEffect, ...] = ()
    if not effect_names:
        with terminal.show_progress("diagnosing"):
            diagnosis = lt.diagnose(recording, held_out=False)
        summary = diagnosis.summary
        terminal.print_text(summary)
        effect_names, modelled_effects = explanations_of_ambiguous_finding(diagnosis)
    with terminal.show_progress("evaluating additional measurements", 200) as advance:
        callback_by_task: dict[str, Any] = {}
        content = lt.next_measurement(
            recording,
            between=effect_names,
            with_effects=modelled_effects,
            site=site,
            progress=lambda task, fraction: callback_by_task.setdefault(task, _progress_bar_callback(advance))(
                task, fraction
            ),
        )
    content = content.model_copy(update={"diagnosis": summary})
    if result_folder is not None:
        content = write_result(result_folder, content)
    terminal.print_result(content, result_folder)
