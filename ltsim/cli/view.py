"""`ltsim view`: the workshop in 3D."""

from __future__ import annotations

import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from ltsim.cli.options import ColumnMap, FormatName, FrameFile, HintList, Quiet, recording_of
from ltsim.cli.places import Force, claim_file
from ltsim.cli.terminal import Terminal
from ltsim.errors import RecordError
from ltsim.recording.files import write_text
from ltsim.report.workshop import Workshop


class Colour(StrEnum):
    """What colours the lines of sight."""

    INCIDENCE = "incidence"
    RESIDUAL = "residual"


class CadUnit(StrEnum):
    """Unit of the coordinates in a CAD file."""

    MM = "mm"
    M = "m"


Place = Annotated[
    str, typer.Argument(metavar="SCENARIO-or-REC", help="A built-in scenario, a scenario file, or a recording.")
]
Png = Annotated[Path | None, typer.Option("--png", metavar="FILE", help="Write a picture instead of a window.")]
Html = Annotated[
    Path | None, typer.Option("--html", metavar="FILE", help="Write one page to turn in a browser, offline.")
]
Cad = Annotated[Path | None, typer.Option("--cad", metavar="FILE", help="STL, OBJ, PLY or GLB to stand in the room.")]
Unit = Annotated[CadUnit, typer.Option(help="Unit of the coordinates in --cad.")]
By = Annotated[Colour, typer.Option("--colour", help="What colours the lines of sight of a recording.")]


def view(
    place: Place,
    png: Png = None,
    html: Html = None,
    cad: Cad = None,
    cad_unit: Unit = CadUnit.MM,
    colour: By = Colour.INCIDENCE,
    format_name: FormatName = None,
    hint: HintList = None,
    columns: ColumnMap = None,
    force: Force = False,
    frame: FrameFile = None,
    quiet: Quiet = False,
) -> None:
    """Show the workshop in 3D: stations, shadow cones, targets, lines of sight, uncertainty, corrections.

    Opens a window, unless --png or --html name a file. A recording is adjusted first; ellipsoids and arrows are
    enlarged as the picture says.

    Example: ltsim view paper-workshop --html workshop.html
    """
    from ltsim.report import scene3d  # pyvista and vtk take a second to load
    from ltsim.report.planned import with_cad
    from ltsim.report.scene_page import scene_page

    terminal = Terminal(quiet)
    if png is None and html is None and not _has_screen():
        raise RecordError("there is no screen for a window; write a picture with --png FILE or a page with --html FILE")
    for file in (png, html):
        claim_file(file, force=force)
    with terminal.busy("looking at the workshop"):
        shown = workshop_of(place, format_name, hint, columns, frame).coloured(colour.value)
        shown = shown if cad is None else with_cad(shown, cad, cad_unit.value)
        if png is not None:
            write_text(png, scene3d.picture(shown))
        if html is not None:
            write_text(html, scene_page(shown))
    for file in (png, html):
        if file is not None:
            terminal.say(f"written to {file}")
    if png is None and html is None:
        scene3d.show(shown)


def workshop_of(
    place: str,
    format_name: str | None = None,
    hints: list[str] | None = None,
    columns: str | None = None,
    frame: Path | None = None,
) -> Workshop:
    """The workshop of a scenario by name or file, or of a recording.

    Raises
    ------
    RecordError, SetupError, NetworkError
        When it is neither, is malformed, or cannot be adjusted.
    """
    from ltsim.report.planned import from_scenario
    from ltsim.report.workshop import from_recording
    from ltsim.simulate.scenario import builtin_names, load_scenario

    path = Path(place)
    if place in builtin_names() or (path.suffix == ".toml" and path.is_file()) or not path.exists():
        return from_scenario(load_scenario(place))
    return from_recording(recording_of(path, format_name, hints, columns, frame))


def _has_screen() -> bool:
    """Whether a window can open."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
