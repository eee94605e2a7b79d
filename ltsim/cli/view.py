"""`ltsim view`, `report`: the workshop in 3D, and the page a person reads."""

import os
import sys
import webbrowser
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError

import ltsim as lt
from ltsim.cli import streams
from ltsim.cli.options import FramedReading
from ltsim.cli.places import FILE, FOLDER, Force, OutputPlace, claim_file
from ltsim.cli.terminal import Quiet, Terminal
from ltsim.core.errors import RecordError, SetupError, require
from ltsim.recordings.settings import sentence
from ltsim.recordings.setup import About


def claim_page(folder: Path, force: bool) -> None:
    """Make sure that the page of a folder replaces no page but its own; raises RecordError."""
    from ltsim.reports.page import NAME  # what draws takes its time to load

    claim_file(folder / NAME, force)


Place = Annotated[
    str | None, typer.Argument(metavar="SCENARIO-or-REC", help="A built-in scenario, a scenario file, or a recording.")
]
Plan = Annotated[
    str | None,
    typer.Option(
        "--plan", metavar="FILE", help="Move the stations of a plan file, or of a plan's folder, in the browser."
    ),
]
Out = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="With --plan: folder that its page saves to; NAME-moved."),
    FOLDER,
]
Port = Annotated[int, typer.Option("--port", min=0, max=65535, help="With --plan: of the page's address; 0: any free.")]
Png = Annotated[Path | None, typer.Option("--png", metavar="FILE", help="Write a picture instead of a window."), FILE]
Html = Annotated[
    Path | None, typer.Option("--html", metavar="FILE", help="Write one page to turn in a browser, offline."), FILE
]
Folder = Annotated[
    Path,
    typer.Argument(metavar="DIR", help="A folder that another verb wrote, or one of such folders."),
    OutputPlace(claim_page),
]
Line = Annotated[str | None, typer.Option(metavar="TEXT", help="For the head; default from [report] of setup.toml.")]
Day = Annotated[str | None, typer.Option("--date", metavar="YYYY-MM-DD", help="Day of the measurement.")]


def view(
    place: Place = None,
    plan: Plan = None,
    png: Png = None,
    html: Html = None,
    *,
    reading: FramedReading,
    force: Force = False,
    out: Out = None,
    port: Port = 0,
    quiet: Quiet = False,
    **options: Any,
) -> None:
    """Show the workshop in 3D: stations, shadow cones, targets, lines of sight, uncertainty, corrections.

    With --plan, a page in the browser where stations are moved by hand and the accuracy of every point follows; it
    answers this machine alone, until Ctrl-C.

    Opens a window, unless --png or --html name a file. A recording is adjusted first; ellipsoids and arrows are
    enlarged as the picture says.

    Example: ltsim view paper-workshop --html workshop.html
    """
    require(("pyvista", "trame_vtk"), "3D views", "view")
    terminal = Terminal(quiet)
    if plan is not None and place is None:
        _by_hand(terminal, plan, out or Path(f"{Path(plan).stem}-moved"), port, force=force)
        return
    if place is None or plan is not None:
        raise SetupError("ltsim view takes either a scenario or a recording, or --plan FILE")
    if png is None and html is None and not _has_screen():
        raise RecordError("there is no screen for a window; write a picture with --png FILE or a page with --html FILE")
    with terminal.progress("looking at the workshop"):
        source = place if reading == FramedReading() else reading.of(Path(place))
        shown = lt.view(source, **options)
        if png is not None:
            shown.png(png)
        if html is not None:
            shown.html(html)
    for file in (png, html):
        if file is not None:
            terminal.say(f"written to {file}")
    if png is None and html is None:
        shown.show()


def _by_hand(terminal: Terminal, plan: str, out: Path, port: int, *, force: bool) -> None:
    from ltsim.planning.files import PLAN, SCENARIO
    from ltsim.reports.board.board import Board
    from ltsim.reports.board.server import BoardAccess, serve

    for name in (SCENARIO, PLAN):
        claim_file(out / name, force)
    with terminal.progress("reading the plan"):
        access = BoardAccess(Board.of(plan), out)

    def tell(address: str) -> None:
        terminal.show(address)
        streams.flush()
        terminal.say("drag the stations there; Ctrl-C here ends it")
        if _has_screen():
            webbrowser.open(address)

    serve(access, tell, port)


def _has_screen() -> bool:
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def report(
    folder: Folder,
    instrument: Line = None,
    date: Day = None,
    operator: Line = None,
    customer: Line = None,
    force: Force = False,
    quiet: Quiet = False,
    **options: Any,
) -> None:
    """Write report.html into DIR: one page that opens offline, the answer first, then tables, figures and the 3D view.

    DIR may hold a recording, a calibration, a diagnosis, a campaign, a plan, or folders of them. The head names
    instrument, date, operator and customer from the table [report] of setup.toml, or from the options; without a word
    there, the instruments by their model and serial.

    Coordinates stand in the axes in which they were computed: --frame belongs to adjust, calibrate, diagnose, convert.

    Example: ltsim report my-calibration --customer "Hall 3" --instrument "AT960, 751234"
    """
    terminal = Terminal(quiet)
    about = _about(instrument=instrument, date=date, operator=operator, customer=customer)
    with terminal.progress("drawing the report"):
        page = lt.report(folder, about=about, tell=terminal.note, **options)
    terminal.say(f"written to {page}")


def _about(**given: str | None) -> About:
    """The options as a table of the set-up; raises SetupError."""
    try:
        return About.model_validate(given)
    except ValidationError as problem:
        raise SetupError(f"--{sentence(problem.errors()[0], About)}") from None
