"""`ltsim inject`: a cause put into a recording, or how strong it must be to be seen there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

import ltsim as lt
from ltsim.cli.options import FramedReading, Seed, Source
from ltsim.cli.places import Force, claim_file, claim_recording
from ltsim.cli.terminal import Terminal
from ltsim.errors import ModelError
from ltsim.recording.files import write_text

Causes = Annotated[
    list[str],
    typer.Argument(
        metavar="EFFECT...",
        help="Effects of the catalogue, or laws as 'CARRIER ~ DRIVER', each with :STATION,TARGET,CONSTANT=VALUE,"
        "PARAMETER=VALUE behind it; what is not said is drawn.",
    ),
]
Destination = Annotated[
    Path | None, typer.Option("--out", metavar="REC2", help="Folder of the recording, or of the curve.")
]
TruthFile = Annotated[
    Path | None, typer.Option("--truth", metavar="FILE", help="File for what was put in; no diagnosis opens it.")
]
Noncentrality = Annotated[
    float | None,
    typer.Option("--noncentrality", min=1e-3, help="Scale each cause to what the adjustment leaves of it."),
]
Curve = Annotated[
    bool, typer.Option("--curve", help="Inject it at six strengths and tell the share found, placed and named.")
]
Injections = Annotated[int, typer.Option("--injections", min=1, help="Diagnoses at each strength of a curve.")]


def inject(
    source: Source,
    causes: Causes,
    out: Destination = None,
    truth: TruthFile = None,
    noncentrality: Noncentrality = None,
    curve: Curve = False,
    injections: Injections = 5,
    seed: Seed = 0,
    *,
    reading: FramedReading,
    force: Force = False,
    terminal: Terminal,
) -> None:
    """Put causes into the readings of a recording through the exact model; nothing else is changed.

    Example: ltsim inject my-recording range-step:S3 --noncentrality 100 --out injected --truth injected.json
    """
    if curve:
        return _curve(reading, source, causes, out, injections, seed, force, terminal)
    if out is None:
        raise ModelError("give a folder for the recording with --out REC2, or ask for the --curve")
    claim_recording(out, force=force)
    claim_file(truth, force=force)
    recording = reading.open(source, terminal)
    made, told = lt.inject(recording, *causes, noncentrality=noncentrality, seed=seed)
    lt.write(made, out)
    if truth is not None:
        write_text(truth, json.dumps(told.to_json(), indent=1, allow_nan=False) + "\n")
    terminal.answer({"pointings": len(made), "injected": len(told.causes), "seed": seed})
    if truth is None:
        terminal.say(repr(told))
    terminal.say(f"written to {out}" + (f", what was put in to {truth}" if truth else ""))
    return None


def _curve(
    reading: FramedReading, source: Path, causes: list[str], out: Path | None, injections: int, seed: int, force: bool,
    terminal: Terminal,
) -> None:  # fmt: skip
    if len(causes) != 1:
        raise ModelError(f"a curve is of one cause, not of {len(causes)}")
    file = None if out is None else out / "curve.csv"
    claim_file(file, force=force)
    recording = reading.open(source, terminal)
    with terminal.busy("injecting and diagnosing"):
        found = lt.injection_curve(recording, causes[0], injections=injections, seed=seed)
    table = found.table()
    terminal.answer({"background": list(found.background), "curve": table.json()})
    terminal.say(found._lines()[0])
    terminal.say(table.text())
    if file is not None:
        write_text(file, table.csv())
        terminal.say(f"written to {file}")
