"""`ltsim demo`: the main job end to end on the paper's workshop, step by step."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

import ltsim as lt
from ltsim.campaigns import require_packages
from ltsim.cli.places import Force, claim_empty
from ltsim.cli.terminal import Terminal
from ltsim.recording.files import write_texts

Folder = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for everything.")]

HIDDEN: tuple[dict[str, Any], ...] = tuple(
    {"name": "station-weather", "stations": [station], "values": {"station-weather": size}}
    for station, size in (("S2", 6.0), ("S3", -5.0), ("S4", 7.0), ("S5", -6.0))
)
"""What the demonstration may conceal: a thermometer some kelvin off; where is drawn by the seed and told to nobody."""

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


@dataclass(frozen=True)
class Step:
    """A part of the demonstration: what is done, and the function that does it and says what came out."""

    title: str
    run: Callable[[Path, int], str]


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

    claim_empty(out, force=force)
    said = []
    if not compiled_before():
        terminal.note("compiling the solver on the way, which takes half a minute: the first demo does")
    for number, step in enumerate(STEPS, start=1):
        began = time.perf_counter()
        with terminal.busy(step.title):
            outcome = step.run(out, options["seed"])
        spent = time.perf_counter() - began
        terminal.say(f"{number}. {step.title} ({spent:.1f} s)\n   {outcome}")
        said.append({"step": step.title, "outcome": outcome, "seconds": round(spent, 2)})
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
    recording, _ = lt.simulate("paper-workshop", seed=seed)
    found = lt.calibrate(recording)
    lt.write(found, out / "workshop")
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
    from ltsim.randomness import stream

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
    write_texts(out, {"campaign.toml": CAMPAIGN.format(seed=seed)})
    from ltsim.campaigns.statistics import summary_csv

    results = lt.campaign(out / "campaign.toml", force=True)
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
    return f"open {lt.report(out, title=TITLE, about={'instrument': 'simulated'})}"


STEPS: tuple[Step, ...] = (
    Step("simulate the paper's workshop", simulated),
    Step("calibrate it", calibrated),
    Step("repeat that on 500 drawn instruments, two methods side by side", repeated),
    Step("hide an effect in another recording, and diagnose it", diagnosed),
    Step("write one page about it", reported),
)
"""What the demonstration does, in order; a step is one function and one line here."""
