"""Commands `view` and `report`: the hall in 3D, and a page about results."""

import os
import sys
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError

import ltsim as lt
from ltsim.cli.options import FunctionOptions, ReadingOptionsWithFrame, choice_option
from ltsim.cli.output_checks import NEW_FILE_OUTPUT, RESULT_FOLDER_OUTPUT, ForceOption, OutputKind, check_new_file
from ltsim.cli.terminal import QuietOption, Terminal, flush_streams
from ltsim.core.errors import InputError, RecordError, require_extra
from ltsim.recordings.settings import validation_sentence
from ltsim.recordings.setup import ReportHeader


def check_page_folder(folder: Path, force: bool) -> None:
    """Check that the report page of a folder replaces no file other than a page of ltsim; raises RecordError."""
    from ltsim.reports.page import REPORT_PAGE_FILE_NAME  # slow to import

    check_new_file(folder / REPORT_PAGE_FILE_NAME, force)


ViewSourceArgument = Annotated[
    str | None, typer.Argument(metavar="SCENARIO-or-REC", help="A built-in scenario, a scenario file, or a recording.")
]
PlanToMoveOption = Annotated[
    str | None,
    typer.Option(
        "--plan", metavar="FILE", help="Move the stations of a plan file, or of a plan's folder, in the browser."
    ),
]
MovedPlanFolderOption = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="With --plan: folder to save to; default NAME-moved."),
    RESULT_FOLDER_OUTPUT,
]
PortOption = Annotated[
    int, typer.Option("--port", min=0, max=65535, help="With --plan: port of the page; 0 for any free port.")
]
PictureFileOption = Annotated[
    Path | None, typer.Option("--png", metavar="FILE", help="Write a picture; no window is opened."), NEW_FILE_OUTPUT
]
PageFileOption = Annotated[
    Path | None,
    typer.Option("--html", metavar="FILE", help="Write an interactive page for a browser, which works offline."),
    NEW_FILE_OUTPUT,
]
ReportFolderArgument = Annotated[
    Path,
    typer.Argument(metavar="DIR", help="A folder of results, or a folder of such folders."),
    OutputKind(check_page_folder),
]
ReportHeaderTextOption = Annotated[
    str | None,
    typer.Option(
        metavar="TEXT", help="Text of the header line with this name; default from the table [report] of setup.toml."
    ),
]
DateOption = Annotated[str | None, typer.Option("--date", metavar="YYYY-MM-DD", help="Day of the measurement.")]


@dataclass(frozen=True)
class ViewOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.view`."""

    cad: Annotated[
        str | None,
        typer.Option(
            "--cad", metavar="FILE", help="CAD file (STL, OBJ, PLY, GLB, STEP or IGES) that is shown in the hall."
        ),
    ] = None
    cad_unit: Annotated[
        str | None,
        choice_option(
            "cad_unit",
            ("mm", "m", "in"),
            "Unit of the coordinates in the CAD file; default by its format (glTF: metres; STEP: declared in the "
            "file; others: millimetres).",
        ),
    ] = None
    cad_up: Annotated[
        str | None,
        choice_option("cad_up", ("y", "z"), "Axis of the CAD file that points up; default by its format (glTF: y)."),
    ] = None
    colour: Annotated[
        str,
        choice_option(
            "colour", ("incidence", "residual"), "Quantity shown by the colour of the lines of sight of a recording."
        ),
    ] = "incidence"


def view(
    place: ViewSourceArgument = None,
    plan: PlanToMoveOption = None,
    png: PictureFileOption = None,
    html: PageFileOption = None,
    *,
    options: ViewOptions,
    reading_options: ReadingOptionsWithFrame,
    force: ForceOption = False,
    out: MovedPlanFolderOption = None,
    port: PortOption = 0,
    quiet: QuietOption = False,
) -> None:
    """Show the hall in 3D: stations, shadow cones, targets, lines of sight, uncertainty, corrections.

    With --plan, you move the stations on a page in the browser, which shows the accuracy of every point; the page is
    available only on this computer, until Ctrl-C.

    Opens a window, unless --png or --html names a file. A recording is adjusted first; the legend gives the
    magnification of ellipsoids and arrows.

    Example: ltsim view paper-workshop --html workshop.html
    """
    require_extra(("pyvista", "trame_vtk"), "3D views", "view")
    terminal = Terminal(quiet)
    if plan is not None and place is None:
        _serve_planner(terminal, plan, out or Path(f"{Path(plan).stem}-moved"), port, force=force)
        return
    if place is None or plan is not None:
        raise InputError("ltsim view needs a scenario, a recording, or --plan FILE, and only one of them")
    if png is None and html is None and not _has_display():
        raise RecordError(
            "no display is available for a window; use --png FILE for a picture or --html FILE for a page"
        )
    with terminal.show_progress("drawing the hall"):
        source = place if reading_options == ReadingOptionsWithFrame() else reading_options.read(Path(place))
        scene_view = lt.view(source, **options.arguments())
        if png is not None:
            scene_view.write_png(png)
        if html is not None:
            scene_view.write_html(html)
    for file in (png, html):
        if file is not None:
            terminal.print_text(f"written to {file}")
    if png is None and html is None:
        scene_view.show()


def _serve_planner(terminal: Terminal, plan: str, result_folder: Path, port: int, *, force: bool) -> None:
    """Server of the page on which the user moves the stations of a plan, until Ctrl-C."""
    from ltsim.planning.result import PLAN_FILE_NAME, SCENARIO_FILE_NAME, with_cad_file_copies
    from ltsim.reports.board.board import MovableLayout
    from ltsim.reports.board.server import PlannerRequests, serve_planner

    for name in (SCENARIO_FILE_NAME, PLAN_FILE_NAME):
        check_new_file(result_folder / name, force)
    with terminal.show_progress("reading the plan"):
        requests = PlannerRequests(MovableLayout.from_plan(plan), result_folder)
        for name in with_cad_file_copies(requests.layout.scenario)[1]:
            check_new_file(result_folder / name, force)

    def announce(address: str) -> None:
        terminal.print_always(address)
        flush_streams()
        terminal.print_text("open this address to move the stations; Ctrl-C ends the server")
        if _has_display():
            webbrowser.open(address)

    serve_planner(requests, announce, port)


def _has_display() -> bool:
    """True if a window can be opened on this computer."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@dataclass(frozen=True)
class ReportOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.report`."""

    recording: Annotated[
        str | None,
        typer.Option(
            "--recording",
            metavar="FILE",
            help="Recording from which a calibration or diagnosis was computed, if it is not in the folder.",
        ),
    ] = None
    title: Annotated[str | None, typer.Option("--title", metavar="NAME", help="Title of the page.")] = None


def report(
    folder: ReportFolderArgument,
    instrument: ReportHeaderTextOption = None,
    date: DateOption = None,
    operator: ReportHeaderTextOption = None,
    customer: ReportHeaderTextOption = None,
    force: ForceOption = False,
    quiet: QuietOption = False,
    *,
    options: ReportOptions,
) -> None:
    """Write report.html into DIR: one page that works offline, with the verdict, tables, figures and the 3D view.

    DIR may hold a recording, a calibration, a diagnosis, a campaign, a plan, or folders of them. The header of the page
    contains instrument, date, operator and customer, from the options or from the table [report] of setup.toml; the
    default text for the instrument is its model and serial number.

    Coordinates are in the frame in which they were computed; --frame of adjust, calibrate and diagnose sets this frame.

    Example: ltsim report my-calibration --customer "Hall 3" --instrument "AT960, 751234"
    """
    terminal = Terminal(quiet)
    about = _page_header(instrument=instrument, date=date, operator=operator, customer=customer)
    with terminal.show_progress("drawing the report"):
        page = lt.report(folder, about=about, print_message=terminal.print_note, **options.arguments())
    terminal.print_text(f"written to {page}")


def _page_header(**header_values: str | None) -> ReportHeader:
    """Header of the report page from the values of the options; raises InputError for an invalid value."""
    try:
        return ReportHeader.model_validate(header_values)
    except ValidationError as problem:
        raise InputError(f"--{validation_sentence(problem.errors()[0], ReportHeader)}") from None
