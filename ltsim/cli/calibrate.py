"""`ltsim calibrate`: instrument parameters from a recording."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from ltsim.calibrate import Calibration, calibrate_distance, calibrate_network, write_calibration
from ltsim.calibrate.files import calibration_json
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
from ltsim.cli.summary import recording_line, show_calibration, show_notes
from ltsim.cli.terminal import Terminal
from ltsim.errors import SetupError
from ltsim.model.construction import construction as construction_called
from ltsim.recording import Recording


class Method(StrEnum):
    """Which estimator."""

    NETWORK = "network"
    DISTANCE = "distance"
    DISTANCE_L1 = "distance-l1"


class ConstructionName(StrEnum):
    """Which model of the tracker."""

    MISALIGNMENT = "misalignment"
    DH = "dh"


MethodOption = Annotated[
    Method, typer.Option(help="Rigorous network adjustment, or the paper's distance objective (least squares or l1).")
]
ConstructionOption = Annotated[
    ConstructionName, typer.Option(help="Geometric misalignments (16 parameters), or the paper's D-H chain (78).")
]


def calibrate(
    source: Source,
    method: MethodOption = Method.NETWORK,
    construction: ConstructionOption = ConstructionName.MISALIGNMENT,
    robust: Robust = False,
    noise_from_data: NoiseFromData = False,
    datum: Datum = None,
    out: Out = None,
    points: PointsFile = None,
    format_name: FormatName = None,
    hint: HintList = None,
    columns: ColumnMap = None,
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
    recording = recording_of(source, format_name, hint, columns, frame)
    show_notes(terminal, recording)
    terminal.say(recording_line(recording))
    with terminal.busy("calibrating"):
        if method is Method.NETWORK:
            found = calibrate_network(recording, construction_called(construction.value), **options)
        else:
            found = calibrated(recording, method.value, construction.value)
    finish(terminal, found, out, points)


def calibrated(recording: Recording, method: str, construction_name: str, *, advise: bool = True) -> Calibration:
    """Calibrate by the names of a method and a construction."""
    built = construction_called(construction_name)
    if method == Method.NETWORK.value:
        return calibrate_network(recording, built, advise=advise)
    return calibrate_distance(recording, built, method=method, advise=advise)


def finish(terminal: Terminal, calibration: Calibration, out: Path | None, points: Path | None = None) -> None:
    """Write, then show."""
    if points is not None:
        from ltsim.report.points import write_points  # most runs need no export

        write_points(calibration, points)
    if out is not None:
        write_calibration(calibration, out)
    terminal.answer(calibration_json(calibration))
    show_calibration(terminal, calibration)
    if out is not None:
        terminal.say(f"\nwritten to {out}; for a page with pictures: ltsim report {out}")
