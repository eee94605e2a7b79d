"""`ltsim simulate`, `inject`: a recording from a scenario, and a cause put into a recording."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.cli.options import FramedReading, Source
from ltsim.cli.places import Force, claim_file, claim_recording
from ltsim.cli.terminal import Terminal
from ltsim.errors import ModelError, SetupError
from ltsim.recording.files import write_text
from ltsim.simulation.builtin import builtin_names, builtin_text

if TYPE_CHECKING:
    from ltsim.recording import Recording

ScenarioName = Annotated[
    str, typer.Argument(metavar="SCENARIO", help=f"A scenario file, or one of: {', '.join(builtin_names())}.")
]
Destination = Annotated[Path | None, typer.Option("--out", metavar="REC", help="Folder of the recording.")]
TruthFile = Annotated[
    Path | None, typer.Option("--truth", metavar="FILE", help="File for the truth; no calibrator opens it.")
]
NominalFile = Annotated[
    Path | None,
    typer.Option("--nominal", metavar="FILE", help="File for the points of the measuring machine, for verify."),
]
OwnPlaces = Annotated[
    bool, typer.Option("--per-trial", help="As in a campaign whose trials have places of their own (geometry).")
]
Show = Annotated[bool, typer.Option("--show", help="Print the scenario as a file to edit, and stop.")]
Causes = Annotated[
    list[str],
    typer.Argument(
        metavar="EFFECT...",
        help="Effects of the catalogue, or laws as 'CARRIER ~ DRIVER', each with :STATION,TARGET,CONSTANT=VALUE,"
        "PARAMETER=VALUE behind it; what is not said is drawn.",
    ),
]
Injected = Annotated[
    Path | None, typer.Option("--out", metavar="REC2", help="Folder of the recording, or of the curve.")
]
PutIn = Annotated[
    Path | None, typer.Option("--truth", metavar="FILE", help="File for what was put in; no diagnosis opens it.")
]
Curve = Annotated[
    bool, typer.Option("--curve", help="Inject it at six strengths and tell the share found, placed and named.")
]


def simulate(
    scenario: ScenarioName,
    out: Destination = None,
    truth: TruthFile = None,
    nominal: NominalFile = None,
    per_trial: OwnPlaces = False,
    show: Show = False,
    force: Force = False,
    *,
    terminal: Terminal,
    **options: Annotated[Any, "simulate seed trial"],
) -> None:
    """Measure a virtual workshop once.

    Example: ltsim simulate paper-workshop --out my-recording --truth truth.json --seed 7
    """
    if show:
        print(builtin_text(scenario) if scenario in builtin_names() else _spelled_out(scenario), end="")
        return
    if out is None:
        raise SetupError("give a folder for the recording with --out REC, or print the scenario with --show")
    claim_recording(out, force=force)
    for file in (truth, nominal):
        claim_file(file, force=force)
    from ltsim.simulation.truth import nominal_csv

    recording, true = lt.simulate(scenario, **options, geometry="per-trial" if per_trial else "shared")
    table = nominal_csv(true) if nominal is not None else ""
    lt.write(recording, out)
    if truth is not None:
        lt.write(true, truth)
    if nominal is not None:
        write_text(nominal, table)
    terminal.notes(recording.notes)
    terminal.answer({"pointings": len(recording), "stations": len(recording.stations), **options})
    terminal.say(recording.headline)
    terminal.say(f"written to {out}" + (f", its truth to {truth}" if truth else ""))


def _spelled_out(scenario: str) -> str:
    """The scenario of a file, every setting spelled out."""
    from ltsim.simulation.scenario import load_scenario, scenario_to_toml

    return scenario_to_toml(load_scenario(scenario))


def inject(
    source: Source,
    causes: Causes,
    out: Injected = None,
    truth: PutIn = None,
    curve: Curve = False,
    *,
    reading: FramedReading,
    force: Force = False,
    terminal: Terminal,
    **options: Annotated[Any, "inject", "injection_curve injections"],
) -> None:
    """Put causes into the readings of a recording through the exact model; nothing else is changed.

    Example: ltsim inject my-recording range-step:S3 --noncentrality 100 --out injected --truth injected.json
    """
    if curve and len(causes) != 1:
        raise ModelError(f"a curve is of one cause, not of {len(causes)}")
    if curve:
        file = None if out is None else out / "curve.csv"
        claim_file(file, force=force)
        del options["noncentrality"]
        return _curve(terminal, reading.open(source, terminal), causes, file, options)
    if out is None:
        raise ModelError("give a folder for the recording with --out REC2, or ask for the --curve")
    claim_recording(out, force=force)
    claim_file(truth, force=force)
    recording = reading.open(source, terminal)
    del options["injections"]
    made, told = lt.inject(recording, *causes, **options)
    lt.write(made, out)
    if truth is not None:
        write_text(truth, json.dumps(told.to_json(), indent=1, allow_nan=False) + "\n")
    terminal.answer({"pointings": len(made), "injected": len(told.causes), "seed": options["seed"]})
    if truth is None:
        terminal.say(repr(told))
    terminal.say(f"written to {out}" + (f", what was put in to {truth}" if truth else ""))
    return None


def _curve(
    terminal: Terminal, recording: Recording, causes: list[str], file: Path | None, options: dict[str, Any]
) -> None:
    """The share found, placed and named over strengths."""
    with terminal.busy("injecting and diagnosing"):
        found = lt.injection_curve(recording, causes[0], **options)
    table = found.table()
    terminal.answer({"background": list(found.background), "curve": table.json()})
    terminal.say(found._lines()[0])
    terminal.say(table.text())
    if file is not None:
        write_text(file, table.csv())
        terminal.say(f"written to {file}")
