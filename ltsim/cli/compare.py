"""`ltsim compare`: which points moved between two recordings, and which motion could not have been seen."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ltsim.chances import p_is, p_text
from ltsim.cli.options import Out, Reading, Robust, Source, names_of
from ltsim.cli.places import Force, claim
from ltsim.cli.terminal import Terminal, table

if TYPE_CHECKING:
    from ltsim.adjust import Adjustment
    from ltsim.uncertainty.comparison import ComparisonFile

Second = Annotated[Path, typer.Argument(metavar="REC2", help="The later recording, of the same points.")]
Stable = Annotated[
    str | None, typer.Option("--stable", metavar="T01,T02,...", help="Points known not to have moved: the datum.")
]
Scaled = Annotated[bool, typer.Option("--scale", help="Let the second recording have a scale of its own.")]
SameInstrument = Annotated[
    bool, typer.Option("--same-instrument", help="One tracker with the same errors measured both.")
]
Calibrated = Annotated[
    bool, typer.Option("--calibrate/--no-calibrate", help="Estimate the instrument's constants in each recording.")
]
Level = Annotated[float, typer.Option("--level", min=1e-6, max=0.5, help="Chance of any false alarm over all points.")]


def compare(
    source: Source,
    second: Second,
    stable: Stable = None,
    scale: Scaled = False,
    same_instrument: SameInstrument = False,
    calibrate: Calibrated = True,
    level: Level = 0.05,
    robust: Robust = False,
    out: Out = None,
    *,
    reading: Reading,
    force: Force = False,
    terminal: Terminal,
) -> int:
    """Say which points moved between two recordings, by how much, and which motion could not have been seen.

    Writes comparison.json and displacements.csv to --out. Exit status 1 when a point moved.

    Example: ltsim compare january march --stable P1,P2,P3 --out my-comparison
    """
    from ltsim.adjust import adjust
    from ltsim.model.construction import ideal, stated_construction
    from ltsim.uncertainty.comparison import DISPLACEMENTS, ComparisonFile, comparison_file, write_comparison
    from ltsim.uncertainty.epochs import compare as compared

    claim(out, ComparisonFile, (DISPLACEMENTS.file,), force=force)
    epochs: list[Adjustment] = []
    for path in (source, second):
        recording = reading.open(path, terminal)
        epochs.append(adjust(recording, stated_construction(recording) if calibrate else ideal(), robust=robust))
        epochs[-1].solution.require_success()
    first, later = epochs
    found = compared(first, later, stable=names_of(stable), scaled=scale, same_instrument=same_instrument, level=level)
    at = [first.recording.targets.index(d.target) for d in found.displacements]
    content = comparison_file(found, first.recording, later.recording, first.state.points[at])
    if out is not None:
        content = write_comparison(content, out)
    terminal.answer(content.content())
    show(terminal, content)
    terminal.written(out)
    return int(bool(found.moved))


def show(terminal: Terminal, content: ComparisonFile) -> None:
    """The verdict, then a line a point."""
    terminal.say("\n" + content.sentence)
    terminal.say(
        f"no motion at all has {p_is(content.p_value)} (chi-square {content.statistic:.1f}, {content.dof} degrees of "
        f"freedom); without the points that moved {p_is(content.p_value_after)}"
    )
    rows = [
        [
            d.target,
            "moved" if d.moved else "",
            *(f"{v:.1f}" for v in d.shift_um),
            *(f"{v:.1f}" for v in d.sigma_um),
            f"{d.visible_um[1]:.0f}",
            p_text(d.p_value),
        ]
        for d in content.displacements
    ]
    header = ["target", "", "dx [um]", "dy [um]", "dz [um]", "sigma x", "sigma y", "sigma z", "visible [um]", "p"]
    terminal.say(table(header, rows, left=2))
    terminal.say("visible: the smallest motion that is found in 4 of 5 cases, whatever its direction")
