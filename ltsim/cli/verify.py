"""`ltsim verify`: the paper's laboratory verification against nominal points."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import ltsim as lt
from ltsim.cli.evaluate import show
from ltsim.cli.options import CalibrationFile, ColumnMap, FormatName, HintList, Json, Out, Quiet, Source, recording_of
from ltsim.cli.places import Force, claim
from ltsim.cli.summary import calibration_of, recording_line, show_notes
from ltsim.cli.terminal import Terminal

Nominal = Annotated[
    Path, typer.Option("--nominal", metavar="FILE", help="Points of the targets: target,x_mm,y_mm,z_mm.")
]


def verify(
    source: Source,
    nominal: Nominal,
    calibration: CalibrationFile,
    out: Out = None,
    format_name: FormatName = None,
    hint: HintList = None,
    columns: ColumnMap = None,
    force: Force = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Apply a calibration to another recording and compare with nominal points, before and after (eq. 13, 14).

    Writes criteria.json to --out.

    Example: ltsim verify laboratory --nominal cmm.csv --calibration my-calibration
    """
    from ltsim.evaluate.schema import CriteriaFile

    terminal = Terminal(quiet, as_json)
    claim(out, CriteriaFile, force=force)
    recording = recording_of(source, format_name, hint, columns)
    show_notes(terminal, recording)
    terminal.say(recording_line(recording))
    found = calibration_of(terminal, calibration)
    show(terminal, lt.verify(recording, nominal, found), recording, out)
