"""Commands `simulate`, `inject` and `demo`: a simulated recording, an injected effect, the main job end to end."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.campaigns import require_packages
from ltsim.cli.options import FramedReading, Source
from ltsim.cli.places import EMPTY, FILE, FOLDER, RECORDING, Force, check_file, check_recording
from ltsim.cli.terminal import Terminal
from ltsim.core.errors import ModelError, SetupError
from ltsim.recordings.files import write_text, write_texts
from ltsim.simulation.builtin import builtin_names, builtin_text

if TYPE_CHECKING:
    from ltsim.recordings import Recording


ScenarioName = Annotated[
    str, typer.Argument(metavar="SCENARIO", help=f"A scenario file, or one of: {', '.join(builtin_names())}.")
]
Destination = Annotated[Path | None, typer.Option("--out", metavar="REC", help="Folder of the recording."), RECORDING]
TruthFile = Annotated[
    Path | None, typer.Option("--truth", metavar="FILE", help="File for the truth, which no calibrator reads."), FILE
]
NominalFile = Annotated[
    Path | None,
    typer.Option("--nominal", metavar="FILE", help="File for the nominal points, for ltsim verify."),
    FILE,
]
PerTrial = Annotated[
    bool, typer.Option("--per-trial", help="Draw new stations and targets, as in a campaign with geometry per trial.")
]
Show = Annotated[bool, typer.Option("--show", help="Print the scenario as a file to edit, and stop.")]
Causes = Annotated[
    list[str],
    typer.Argument(
        metavar="EFFECT...",
        help="Effects of the catalogue, or laws as 'RESPONSE ~ REGRESSOR', each with :STATION,TARGET,CONSTANT=VALUE,"
        "PARAMETER=VALUE; values that are not given are drawn.",
    ),
]
Injected = Annotated[
    Path | None, typer.Option("--out", metavar="REC2", help="Folder of the recording, or of the curve."), FOLDER
]
PutIn = Annotated[
    Path | None,
    typer.Option("--truth", metavar="FILE", help="File for the injected values, which no diagnosis reads."),
    FILE,
]
Curve = Annotated[
    bool, typer.Option("--curve", help="Inject it at six strengths; report the fractions detected, located and named.")
]


def simulate(
    scenario: ScenarioName,
    out: Destination = None,
    truth: TruthFile = None,
    nominal: NominalFile = None,
    per_trial: PerTrial = False,
    show: Show = False,
    force: Force = False,
    *,
    terminal: Terminal,
    **options: Annotated[Any, "simulate seed trial"],
) -> None:
    """Simulate one recording of a virtual workshop.

    Example: ltsim simulate paper-workshop --out my-recording --truth truth.json --seed 7
    """
    if show:
        terminal.show(_whole(scenario))
        return
    if out is None:
        raise SetupError("ltsim simulate needs --out REC, the folder of the recording; --show prints the scenario")
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


def _whole(scenario: str) -> str:
    """Text of a scenario with all keys: a commented file unchanged, any other completed."""
    text = builtin_text(scenario) if scenario in builtin_names() else ""
    if text and "\nbase = " not in text:
        return text
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
    """Add the effects of faults to the readings of a recording, by the exact model; nothing else changes.

    Example: ltsim inject my-recording range-step:S3 --noncentrality 100 --out injected --truth injected.json
    """
    if curve and len(causes) != 1:
        raise ModelError(f"--curve needs one EFFECT, {len(causes)} are given")
    if curve:
        file = None if out is None else out / "curve.csv"
        if file is not None:
            check_file(file, force)
        del options["noncentrality"]
        return _curve(terminal, reading.open(source, terminal), causes, file, options)
    if out is None:
        raise ModelError("ltsim inject needs --out REC2, the folder of the recording, or --curve")
    check_recording(out, force)
    recording = reading.open(source, terminal)
    del options["injections"]
    made, injected = lt.inject(recording, *causes, **options)
    lt.write(made, out)
    if truth is not None:
        write_text(truth, json.dumps(injected.to_json(), indent=1, allow_nan=False) + "\n")
    terminal.answer({"pointings": len(made), "injected": len(injected.injected_effects), "seed": options["seed"]})
    if truth is None:
        terminal.say(repr(injected))
    terminal.say(f"written to {out}" + (f", injected values to {truth}" if truth else ""))
    return None


def _curve(
    terminal: Terminal, recording: Recording, causes: list[str], file: Path | None, options: dict[str, Any]
) -> None:
    with terminal.progress("injecting and diagnosing"):
        power = lt.injection_curve(recording, causes[0], **options)
    table = power.table()
    terminal.answer({"background": list(power.background_effects), "curve": table.json()})
    terminal.say(power._lines()[0])
    terminal.say(table.text())
    if file is not None:
        write_text(file, table.csv())
        terminal.say(f"written to {file}")


Folder = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for everything."), EMPTY]

DEMO_EFFECTS: tuple[dict[str, Any], ...] = tuple(
    {"name": "smr-offset", "stations": [station], "values": {"radius-difference": size}}
    for station, size in (("S2", 0.2), ("S3", -0.25), ("S4", 0.25), ("S5", -0.2))
)
"""Effects that the demonstration may inject: an SMR of another radius, at a station drawn by the seed."""

TITLE = "Demonstration: a fault is injected into a simulated workshop, and diagnosed"
CAMPAIGN = """format = "ltsim-campaign/1"
title = "Calibrations of drawn instruments in the paper's workshop"
scenario = "paper-workshop"
seed = {seed}
trials = 500

[[methods]]
name = "network"

[[methods]]
name = "distance"
method = "distance"
"""


def demo(
    out: Folder = Path("ltsim-demo"),
    force: Force = False,
    *,
    terminal: Terminal,
    **options: Annotated[Any, "simulate seed"],
) -> None:
    """Simulate, calibrate, repeat on many instruments, inject a fault, diagnose it, and write one page.

    Example: ltsim demo --out ltsim-demo
    """
    require_packages()
    from ltsim.campaigns.kernels import is_compiled  # slow to import

    for name, place in WRITTEN.items():
        place.rule(out / name, True)
    outcomes = []
    if not is_compiled():
        terminal.note("First run: compiling the solver takes about 30 s.")
    for number, (title, step) in enumerate(STEPS.items(), start=1):
        began = time.perf_counter()
        with terminal.progress(title):
            outcome = step(out, options["seed"])
        spent = time.perf_counter() - began
        terminal.say(f"{number}. {title} ({spent:.1f} s)\n   {outcome}")
        outcomes.append({"step": title, "outcome": outcome, "seconds": round(spent, 2)})
    terminal.answer({"folder": str(out), "steps": outcomes})


def simulated(out: Path, seed: int) -> str:
    """Measure the paper's workshop with a drawn instrument."""
    recording, truth = lt.simulate("paper-workshop", seed=seed)
    lt.write(recording, out / "workshop" / "recording")
    lt.write(truth, out / "workshop" / "truth.json")
    return (
        f"{len(recording.stations)} stations, {len(recording.targets)} reflectors, {len(recording)} pointings; "
        "the instrument's errors are drawn from its specification"
    )


def calibrated(out: Path, seed: int) -> str:
    """Calibrate that recording."""
    from ltsim.reports.sections import section_of

    recording, _ = lt.simulate("paper-workshop", seed=seed)
    calibration = lt.calibrate(recording)
    lt.write(calibration, out / "workshop")
    return section_of(calibration).answer


def diagnosed(out: Path, seed: int) -> str:
    """Inject an effect into another recording and diagnose it."""
    from ltsim.core.randomness import stream
    from ltsim.physics.effects import title_of

    entry = DEMO_EFFECTS[int(stream(seed, "demo", "hidden").integers(len(DEMO_EFFECTS)))]
    recording, truth = lt.simulate("paper-workshop-two-face", seed=seed, changes={"effects": [entry]})
    folder = out / "concealed"
    diagnosis = lt.diagnose(recording, seed=seed, held_out=True)
    lt.write(diagnosis, folder, recording=recording)
    lt.write(truth, folder / "truth.json")
    return f"injected: {title_of(entry['name'])} ({entry['stations'][0]}); blind diagnosis: {diagnosis.summary}"


def repeated(out: Path, seed: int) -> str:
    """Repeat the calibration on many drawn instruments, by the network and by the paper's distances."""
    from ltsim.reports.sections.campaign import campaign_section

    write_texts(out, {"campaign.toml": CAMPAIGN.format(seed=seed)})
    results = lt.campaign(out / "campaign.toml", force=True)
    write_texts(out / "campaign", {"summary.csv": results.table("summary").csv()})
    return campaign_section(out / "campaign").answer


def reported(out: Path, seed: int) -> str:
    """Put everything on one page."""
    return f"open {lt.report(out, title=TITLE, about={'instrument': 'simulated'})}"


STEPS: dict[str, Callable[[Path, int], str]] = {
    "simulate the paper's workshop": simulated,
    "calibrate it": calibrated,
    "repeat that on 500 drawn instruments, two methods side by side": repeated,
    "inject a fault into another recording, and diagnose it": diagnosed,
    "write one page about it": reported,
}
"""Steps of the demonstration in order: title and function, which returns the outcome in words."""
WRITTEN = {
    "workshop/recording": RECORDING,
    "workshop/truth.json": FILE,
    "concealed": FOLDER,
    "concealed/truth.json": FILE,
    "campaign.toml": FILE,
    "campaign": FOLDER,
    "report.html": FILE,
}
"""Outputs of the steps, checked before the first step."""
