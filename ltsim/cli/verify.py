"""`ltsim verify`: the paper's laboratory verification against nominal points."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import ltsim as lt
from ltsim.cli.evaluate import show
from ltsim.cli.options import CalibrationFile, Out, Reading, Source
from ltsim.cli.places import Force, claim
from ltsim.cli.summary import calibration_of
from ltsim.cli.terminal import Terminal

Nominal = Annotated[
    Path, typer.Option("--nominal", metavar="FILE", help="Points of the targets: target,x_mm,y_mm,z_mm.")
]


def verify(
    source: Source,
    nominal: Nominal,
    calibration: CalibrationFile,
    out: Out = None,
    *,
    reading: Reading,
    force: Force = False,
    terminal: Terminal,
) -> None:
    """Apply a calibration to another recording and compare with nominal points, before and after (eq. 13, 14).

    Writes criteria.json to --out.

    Example: ltsim verify laboratory --nominal cmm.csv --calibration my-calibration
    """
    from ltsim.evaluation.criteria import CriteriaFile

    claim(out, CriteriaFile, force=force)
    recording = reading.open(source, terminal)
    found = calibration_of(terminal, calibration)
    show(terminal, lt.verify(recording, nominal, found), recording, out)
