"""`ltsim simulate`: a recording from a scenario, and apart from it the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import ltsim as lt
from ltsim.cli.options import Seed
from ltsim.cli.places import Force, claim_file, claim_recording
from ltsim.cli.terminal import Terminal
from ltsim.errors import SetupError
from ltsim.recording.files import write_text
from ltsim.simulation.builtin import builtin_names, builtin_text

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
Trial = Annotated[int, typer.Option(min=0, help="Which trial of a campaign with this scenario and seed.")]
OwnPlaces = Annotated[
    bool, typer.Option("--per-trial", help="As in a campaign whose trials have places of their own (geometry).")
]
Show = Annotated[bool, typer.Option("--show", help="Print the scenario as a file to edit, and stop.")]


def simulate(
    scenario: ScenarioName,
    out: Destination = None,
    truth: TruthFile = None,
    nominal: NominalFile = None,
    seed: Seed = 0,
    trial: Trial = 0,
    per_trial: OwnPlaces = False,
    show: Show = False,
    force: Force = False,
    *,
    terminal: Terminal,
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

    recording, true = lt.simulate(scenario, seed=seed, trial=trial, geometry="per-trial" if per_trial else "shared")
    table = nominal_csv(true) if nominal is not None else ""
    lt.write(recording, out)
    if truth is not None:
        lt.write(true, truth)
    if nominal is not None:
        write_text(nominal, table)
    terminal.notes(recording.notes)
    terminal.answer({"pointings": len(recording), "stations": len(recording.stations), "seed": seed, "trial": trial})
    terminal.say(recording.headline)
    terminal.say(f"written to {out}" + (f", its truth to {truth}" if truth else ""))


def _spelled_out(scenario: str) -> str:
    """The scenario of a file, every setting spelled out."""
    from ltsim.simulation.scenario import load_scenario, scenario_to_toml

    return scenario_to_toml(load_scenario(scenario))
