"""`ltsim compare`: which points moved between two recordings, and which motion could not have been seen."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.chances import p_is
from ltsim.cli.options import Out, Reading, Robust, Source, names_of
from ltsim.cli.places import Force, claim
from ltsim.cli.terminal import Terminal

if TYPE_CHECKING:
    from ltsim.recording.coordinates import Coordinates
    from ltsim.tasks.comparison import Comparison

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
    from ltsim.recording.result_file import write_result
    from ltsim.tasks.comparison import DISPLACEMENTS, Comparison

    claim(out, Comparison, (DISPLACEMENTS.file,), force=force)
    lists = holds_coordinates(source) or holds_coordinates(second)
    one, other = (_listed(p, terminal) if lists else reading.open(p, terminal) for p in (source, second))
    how: dict[str, Any] = {"free": free, "same_instrument": same_instrument, "calibrate": calibrate, "robust": robust}
    with terminal.busy("comparing"):
        found = lt.compare(one, other, stable=names_of(stable), scaled=scale, level=level, **how)
    if out is not None:
        found = write_result(out, found, {DISPLACEMENTS.file: found.table().csv()})
    terminal.answer(found.content())
    show(terminal, found)
    terminal.written(out)
    return int(bool(found.moved))


def _listed(path: Path, terminal: Terminal) -> Coordinates | Path:
    """A list of coordinates, with what its reader decided and its size said."""
    from ltsim.recording.coordinates import holds_coordinates, read_coordinates

    if not holds_coordinates(path):
        return path
    found = read_coordinates(path)
    terminal.notes(found.notes)
    terminal.say(f"{found.title}: {len(found.names)} points along {', '.join(found.axes)}")
    return found


def show(terminal: Terminal, found: Comparison) -> None:
    """The verdict, then a line a point."""
    terminal.say("\n" + found.sentence)
    terminal.say(
        f"no motion at all has {p_is(found.p_value)} (chi-square {found.statistic:.1f}, {found.dof} degrees of "
        f"freedom); without the points that moved {p_is(found.p_value_after)}"
    )
    table = found.table().only("target moved dx_um dy_um dz_um visible_um p_value")
    terminal.say(table.text())
    terminal.say("a +- b: one standard deviation; visible: the smallest motion that is found in 4 of 5 cases")
