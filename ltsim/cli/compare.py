"""`ltsim compare`: which points moved between two recordings, and which motion could not have been seen."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ltsim.chances import p_is, p_text
from ltsim.cli.options import Out, Reading, Robust, Source, names_of
from ltsim.cli.places import Force, claim
from ltsim.cli.terminal import Terminal, table
from ltsim.errors import SetupError

if TYPE_CHECKING:
    from ltsim.adjustment import Adjustment
    from ltsim.recording.recording import Recording
    from ltsim.tasks.comparison import ComparisonFile
    from ltsim.tasks.congruence import Congruence

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


Free = Annotated[
    bool, typer.Option("--free", help="Lists of coordinates whose frames differ: the second may move as a whole.")
]


def compare(
    source: Source,
    second: Second,
    stable: Stable = None,
    scale: Scaled = False,
    free: Free = False,
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

    Two lists of coordinates with covariance are compared too: adjustment results of gama-local, or CSV tables with
    NAME.covariance.csv beside them.

    Writes comparison.json and displacements.csv to --out. Exit status 1 when a point moved.

    Example: ltsim compare january march --stable P1,P2,P3 --out my-comparison
    """
    from ltsim.recording.coordinates import holds_coordinates
    from ltsim.tasks.comparison import DISPLACEMENTS, ComparisonFile, write_comparison

    claim(out, ComparisonFile, (DISPLACEMENTS.file,), force=force)
    named = names_of(stable)
    if holds_coordinates(source) or holds_coordinates(second):
        if same_instrument or robust or not calibrate:
            raise SetupError(
                "lists of coordinates hold no readings: --same-instrument, --robust and --no-calibrate say nothing"
            )
        found, content = _lists((source, second), terminal, named, free, scale, level)
    else:
        if free:
            raise SetupError("--free is for lists of coordinates: what a recording leaves open of its frame is known")
        epochs: list[Adjustment] = []
        for path in (source, second):
            recording = reading.open(path, terminal)
            epochs.append(_adjusted(recording, calibrate, robust))
        found, content = _recordings(epochs, named, scale, same_instrument, level)
    if out is not None:
        content = write_comparison(content, out)
    terminal.answer(content.content())
    show(terminal, content)
    terminal.written(out)
    return int(bool(found.moved))


def _adjusted(recording: Recording, calibrate: bool, robust: bool) -> Adjustment:
    from ltsim.adjustment import adjust
    from ltsim.model.construction import ideal, stated_construction

    made = adjust(recording, stated_construction(recording) if calibrate else ideal(), robust=robust)
    made.solution.require_success()
    return made


def _recordings(
    epochs: list[Adjustment], stable: tuple[str, ...] | None, scaled: bool, same_instrument: bool, level: float
) -> tuple[Congruence, ComparisonFile]:
    from ltsim.recording.result_file import SourceEntry
    from ltsim.tasks.comparison import comparison_file
    from ltsim.tasks.epochs import compare as compared

    first, later = epochs
    found = compared(first, later, stable=stable, scaled=scaled, same_instrument=same_instrument, level=level)
    at = [first.recording.targets.index(d.target) for d in found.displacements]
    one, other = (SourceEntry.of(epoch.recording) for epoch in epochs)
    return found, comparison_file(found, one, other, first.state.points[at])


def _lists(
    paths: tuple[Path, Path], terminal: Terminal, stable: tuple[str, ...] | None, free: bool, scaled: bool, level: float
) -> tuple[Congruence, ComparisonFile]:
    from ltsim.recording.coordinates import read_coordinates
    from ltsim.recording.result_file import SourceEntry
    from ltsim.tasks.comparison import comparison_file
    from ltsim.tasks.epochs import compare_coordinates

    first, later = (read_coordinates(path) for path in paths)
    for one in (first, later):
        terminal.notes(one.notes)
        terminal.say(f"{one.title}: {len(one.names)} points along {', '.join(one.axes)}")
    found = compare_coordinates(first, later, stable=stable, free=free, scaled=scaled, level=level)
    at = [first.names.index(d.target) for d in found.displacements]
    return found, comparison_file(found, SourceEntry.listed(first), SourceEntry.listed(later), first.points[at])


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
