"""`ltsim adjust`: targets and stations from a recording, taking the instrument as it is."""

from __future__ import annotations

import ltsim as lt
from ltsim.cli.calibrate import claim_results, finish
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
from ltsim.cli.places import Force
from ltsim.cli.summary import recording_line, show_notes
from ltsim.cli.terminal import Terminal


def adjust(
    source: Source,
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
    """Adjust the network of a recording without instrument parameters: targets, stations, outliers.

    Writes calibration.json, targets.csv and residuals.csv to --out.

    Example: ltsim adjust my-recording --robust --noise-from-data --out adjusted
    """
    terminal = Terminal(quiet, as_json)
    claim_results(out, points, adjusted=True, force=force)
    recording = recording_of(source, format_name, hint, columns, frame)
    show_notes(terminal, recording)
    terminal.say(recording_line(recording))
    with terminal.busy("adjusting"):
        found = lt.adjust(recording, robust=robust, noise_from_data=noise_from_data, datum=names_of(datum))
    finish(terminal, found, out, points)
