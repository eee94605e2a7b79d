"""`ltsim simulate`, `inject`, `demo`: a recording from a scenario, a cause put into one, the main job end to end."""

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
from ltsim.cli.places import EMPTY, FILE, FOLDER, RECORDING, Force, claim_file, claim_recording
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
    Path | None, typer.Option("--truth", metavar="FILE", help="File for the truth; no calibrator opens it."), FILE
]
NominalFile = Annotated[
    Path | None,
    typer.Option("--nominal", metavar="FILE", help="File for the points of the measuring machine, for verify."),
    FILE,
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
    Path | None, typer.Option("--out", metavar="REC2", help="Folder of the recording, or of the curve."), FOLDER
]
PutIn = Annotated[
    Path | None, typer.Option("--truth", metavar="FILE", help="File for what was put in; no diagnosis opens it."), FILE
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
        terminal.show(_whole(scenario))
        return
    if out is None:
        raise SetupError("give a folder for the recording with --out REC, or print the scenario with --show")
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
    """A scenario as a file that says all there is to edit: a commented one as it stands, any other spelled out."""
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
    """Put causes into the readings of a recording through the exact model; nothing else is changed.

    Example: ltsim inject my-recording range-step:S3 --noncentrality 100 --out injected --truth injected.json
    """
    if curve and len(causes) != 1:
        raise ModelError(f"a curve is of one cause, not of {len(causes)}")
    if curve:
        file = None if out is None else out / "curve.csv"
        if file is not None:
            claim_file(file, force)
        del options["noncentrality"]
        return _curve(terminal, reading.open(source, terminal), causes, file, options)
    if out is None:
        raise ModelError("give a folder for the recording with --out REC2, or ask for the --curve")
    claim_recording(out, force)
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
    with terminal.progress("injecting and diagnosing"):
        found = lt.injection_curve(recording, causes[0], **options)
    table = found.table()
    terminal.answer({"background": list(found.background), "curve": table.json()})
    terminal.say(found._lines()[0])
    terminal.say(table.text())
    if file is not None:
        write_text(file, table.csv())
        terminal.say(f"written to {file}")


Folder = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for everything."), EMPTY]

HIDDEN: tuple[dict[str, Any], ...] = tuple(
    {"name": "smr-offset", "stations": [station], "values": {"radius-difference": size}}
    for station, size in (("S2", 0.2), ("S3", -0.25), ("S4", 0.25), ("S5", -0.2))
)
"""Effects that the demonstration may conceal: an SMR of another radius, at a station drawn by the seed."""

TITLE = "Demonstration: a fault is hidden in a simulated workshop, and found"
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
    """Simulate, calibrate, repeat, hide an effect and diagnose it, and leave one page to open.

    Example: ltsim demo --out ltsim-demo
    """
    require_packages()
    from ltsim.campaigns.kernels import compiled_before  # the compiler takes a second to load

    for name, place in WRITTEN.items():
        place.rule(out / name, True)
    said = []
    if not compiled_before():
        terminal.note("compiling the solver on the way, which takes half a minute: the first demo does")
    for number, (title, step) in enumerate(STEPS.items(), start=1):
        began = time.perf_counter()
        with terminal.progress(title):
            outcome = step(out, options["seed"])
        spent = time.perf_counter() - began
        terminal.say(f"{number}. {title} ({spent:.1f} s)\n   {outcome}")
        said.append({"step": title, "outcome": outcome, "seconds": round(spent, 2)})
    terminal.answer({"folder": str(out), "steps": said})


def simulated(out: Path, seed: int) -> str:
    """Measure the paper's workshop with a drawn instrument."""
    recording, truth = lt.simulate("paper-workshop", seed=seed)
    lt.write(recording, out / "workshop" / "recording")
    lt.write(truth, out / "workshop" / "truth.json")
    return (
        f"{len(recording.stations)} stations, {len(recording.targets)} reflectors, {len(recording)} pointings; "
        "the instrument's errors are drawn from its maker's limits"
    )


def calibrated(out: Path, seed: int) -> str:
    """Calibrate that recording."""
    from ltsim.calibration.files import calibration_file
    from ltsim.reports.sections import section_of

    recording, _ = lt.simulate("paper-workshop", seed=seed)
    found = lt.calibrate(recording)
    lt.write(found, out / "workshop")
    return section_of(calibration_file(found)).answer


def diagnosed(out: Path, seed: int) -> str:
    """Hide an effect in another recording and let the diagnosis find it."""
    from ltsim.core.randomness import stream

    entry = HIDDEN[int(stream(seed, "demo", "hidden").integers(len(HIDDEN)))]
    recording, truth = lt.simulate("paper-workshop-two-face", seed=seed, changes={"effects": [entry]})
    folder = out / "concealed"
    found = lt.diagnose(recording, seed=seed, held_out=True)
    lt.write(found, folder, recording=recording)
    lt.write(truth, folder / "truth.json")
    return (
        f"hidden was {entry['name']} ({entry['stations'][0]}); the diagnosis, which was not told, says: {found.summary}"
    )


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
    "hide an effect in another recording, and diagnose it": diagnosed,
    "write one page about it": reported,
}
"""Steps of the demonstration in order; a step is one line here, and one function, which says what came out."""
WRITTEN = {
    "workshop/recording": RECORDING,
    "workshop/truth.json": FILE,
    "concealed": FOLDER,
    "concealed/truth.json": FILE,
    "campaign.toml": FILE,
    "campaign": FOLDER,
    "report.html": FILE,
}
"""Places that the steps write to, checked before the first of them."""
