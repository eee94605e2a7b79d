"""`ltsim demo`: the main job end to end on the paper's workshop, step by step."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from ltsim.calibrate import calibrate_network, write_calibration
from ltsim.campaign.campaign import Workers, run_campaign
from ltsim.campaign.statistics import Results, summary_csv
from ltsim.cli.options import Json, Quiet, Seed
from ltsim.cli.places import Force, claim_empty
from ltsim.cli.terminal import Terminal
from ltsim.diagnose import diagnose
from ltsim.diagnose.files import write_diagnosis
from ltsim.randomness import stream
from ltsim.recording import write
from ltsim.recording.files import write_texts
from ltsim.simulate.scenario import load_scenario
from ltsim.simulate.sections import EffectEntry
from ltsim.simulate.simulator import simulate
from ltsim.simulate.truth import write_truth

Folder = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for everything.")]

HIDDEN: tuple[EffectEntry, ...] = (
    EffectEntry(name="station-settling", stations=("S3",), values={"tilt-x": 25.0, "tilt-y": -18.0}),
    EffectEntry(name="station-weather", stations=("S2",), values={"station-weather": 6.0}),
    EffectEntry(name="range-cyclic", values={"cyclic-cos": 8.0}),
)
"""What the demonstration may conceal; which one is drawn by the seed and not told to the diagnosis."""

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


@dataclass(frozen=True)
class Step:
    """A part of the demonstration: what is done, and the function that does it and says what came out."""

    title: str
    run: Callable[[Path, int], str]


def demo(
    out: Folder = Path("ltsim-demo"),
    seed: Seed = 0,
    force: Force = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Simulate, calibrate, repeat, hide an effect and diagnose it, and leave one page to open.

    Example: ltsim demo --out ltsim-demo
    """
    terminal = Terminal(quiet, as_json)
    claim_empty(out, force=force)
    said = []
    for number, step in enumerate(STEPS, start=1):
        began = time.perf_counter()
        with terminal.busy(step.title):
            outcome = step.run(out, seed)
        spent = time.perf_counter() - began
        terminal.say(f"{number}. {step.title} ({spent:.1f} s)\n   {outcome}")
        said.append({"step": step.title, "outcome": outcome, "seconds": round(spent, 2)})
    terminal.answer({"folder": str(out), "steps": said})


def simulated(out: Path, seed: int) -> str:
    """Measure the paper's workshop with a drawn instrument."""
    recording, truth = simulate(load_scenario("paper-workshop"), seed)
    write(recording, out / "workshop" / "recording")
    write_truth(truth, out / "workshop" / "truth.json")
    return (
        f"{len(recording.stations)} stations, {len(recording.targets)} reflectors, {len(recording)} pointings; "
        "the instrument's errors are drawn from its maker's limits"
    )


def calibrated(out: Path, seed: int) -> str:
    """Calibrate that recording."""
    recording, _ = simulate(load_scenario("paper-workshop"), seed)
    found = calibrate_network(recording)
    write_calibration(found, out / "workshop")
    if found.criteria is None:
        return f"{len(found.names)} parameters"
    distance, coordinate = found.criteria.distance, found.criteria.coordinate
    return (
        f"{len(found.names)} parameters; the distance criterion improves by {distance.improvement_percent:.0f} %, the "
        f"coordinate criterion by {coordinate.improvement_percent:.0f} % (the paper: 40 % and 14 %); "
        f"{len(found.undetermined)} combinations are not determined in one face, and a cure is named for each"
    )


def diagnosed(out: Path, seed: int) -> str:
    """Hide an effect in another recording and let the diagnosis find it."""
    entry = HIDDEN[int(stream(seed, "demo", "hidden").integers(len(HIDDEN)))]
    scenario = load_scenario("paper-workshop-two-face").model_copy(update={"effects": (entry,)})
    recording, truth = simulate(scenario, seed)
    folder = out / "concealed"
    found = diagnose(recording, seed=seed)
    write_diagnosis(found, folder, recording)
    write_truth(truth, folder / "truth.json")
    place = ", ".join(entry.stations + entry.targets) or "everywhere"
    return f"hidden was {entry.name} ({place}); the diagnosis, which was not told, says: {found.summary}"


def repeated(out: Path, seed: int) -> str:
    """Repeat the calibration on many drawn instruments, by the network and by the paper's distances."""
    write_texts(out, {"campaign.toml": CAMPAIGN.format(seed=seed)})
    run_campaign(out / "campaign.toml", out / "campaign", workers=Workers(), force=True)
    results = Results(out / "campaign")
    write_texts(out / "campaign", {"summary.csv": summary_csv(results.summary())})
    parts = []
    for column, title in (
        ("distance_improvement_percent", "distance"),
        ("coordinate_improvement_percent", "coordinate"),
    ):
        spreads = {spread.method: spread for spread in results.spread(column)}
        figures = ", ".join(
            f"{method} {spread.quantiles[3]:.0f} % ({spread.quantiles[1]:.0f} to {spread.quantiles[5]:.0f})"
            for method, spread in spreads.items()
        )
        parts.append(f"{title} criterion: {figures}")
    return "improvement over the trials, median and 90 % of them; " + "; ".join(parts)


def reported(out: Path, seed: int) -> str:
    """Put everything on one page."""
    from ltsim.report.page import report  # matplotlib and vtk take seconds to load

    return f"open {report(out)}"


STEPS: tuple[Step, ...] = (
    Step("simulate the paper's workshop", simulated),
    Step("calibrate it", calibrated),
    Step("repeat that on 500 drawn instruments, two methods side by side", repeated),
    Step("hide an effect in another recording, and diagnose it", diagnosed),
    Step("write one page about it", reported),
)
"""What the demonstration does, in order; a step is one function and one line here."""
