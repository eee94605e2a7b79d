"""`ltsim calibrate`: instrument parameters from a recording."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.cli.options import (
    ColumnMap,
    Datum,
    FormatName,
    FrameFile,
    HintList,
    Json,
    NoiseFromData,
    Out,
    PointsFile,
    Quiet,
    Robust,
    Source,
    names_of,
    recording_of,
)
from ltsim.cli.places import Force, claim, claim_file
from ltsim.cli.summary import recording_line, show_calibration, show_notes
from ltsim.cli.terminal import Terminal
from ltsim.errors import SetupError

if TYPE_CHECKING:
    from ltsim.calibrate import Calibration


class Method(StrEnum):
    """Which estimator."""

    NETWORK = "network"
    DISTANCE = "distance"
    DISTANCE_L1 = "distance-l1"


class ConstructionName(StrEnum):
    """Which model of the tracker."""

    MISALIGNMENT = "misalignment"
    DH = "dh"
    STEERING_MIRROR = "steering-mirror"


MethodOption = Annotated[
    Method, typer.Option(help="Rigorous network adjustment, or the paper's distance objective (least squares or l1).")
]
ConstructionOption = Annotated[
    ConstructionName | None,
    typer.Option(
        help="Misalignments of a source in the head (16), of a steering mirror (21), or the paper's D-H chain (78); "
        "default: what the set-up states."
    ),
]


def calibrate(
    source: Source,
    method: MethodOption = Method.NETWORK,
    construction: ConstructionOption = None,
    robust: Robust = False,
    noise_from_data: NoiseFromData = False,
    datum: Datum = None,
    out: Out = None,
    points: PointsFile = None,
    format_name: FormatName = None,
    hint: HintList = None,
    columns: ColumnMap = None,
    force: Force = False,
    frame: FrameFile = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Find the instrument's parameters from a recording, with uncertainty, and say what it cannot tell.

    Writes calibration.json, targets.csv and residuals.csv to --out.

    Example: ltsim calibrate my-recording --out my-calibration
    """
    terminal = Terminal(quiet, as_json)
    options: dict[str, Any] = {"robust": robust, "noise_from_data": noise_from_data, "datum": names_of(datum)}
    if method is not Method.NETWORK and any(options.values()):
        raise SetupError(f"--robust, --noise-from-data and --datum go with --method network, not {method.value}")
    claim_results(out, points, adjusted=False, force=force)
    recording = recording_of(source, format_name, hint, columns, frame)
    show_notes(terminal, recording)
    terminal.say(recording_line(recording))
    built = construction.value if construction else None
    with terminal.busy("calibrating"):
        found = lt.calibrate(recording, method=method.value, construction=built, **options)
    finish(terminal, found, out, points)


def claim_results(out: Path | None, points: Path | None, *, adjusted: bool, force: bool) -> None:
    """Make sure that a calibration, or a network `adjusted` without parameters, replaces nothing else."""
    from ltsim.calibrate.schema import RESIDUALS, TARGETS, CalibrationFile

    names = (TARGETS.file, RESIDUALS.file)
    claim(out, CalibrationFile, names, force=force, own=lambda found: (found.method == "adjustment") == adjusted)
    claim_file(points, force=force)


def finish(terminal: Terminal, calibration: Calibration, out: Path | None, points: Path | None = None) -> None:
    """Write, then show."""
    from ltsim.calibrate.files import calibration_file, write_calibration

    if points is not None:
        from ltsim.report.points import write_points  # most runs need no export

        write_points(calibration, points)
    content = calibration_file(calibration) if out is None else write_calibration(calibration, out)
    terminal.answer(content.content())
    show_calibration(terminal, calibration)
    for note in calibration.notes:
        terminal.note(f"note: {note}")
    if out is not None:
        terminal.say(f"\nwritten to {out}; for a page with pictures: ltsim report {out}")
