"""`ltsim bench`: the reflector's bench test evaluated."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ltsim.cli.options import Out
from ltsim.cli.places import Force, claim
from ltsim.cli.terminal import Terminal
from ltsim.notation import with_sigma

if TYPE_CHECKING:
    from ltsim.evaluation.schema import BenchFile, EstimateEntry

BenchTable = Annotated[Path, typer.Argument(metavar="FILE", help="A table angle_deg,length_um,probe_um.")]
ProbeDirection = Annotated[
    float, typer.Option("--probe-direction", metavar="DEG", help="Where the probe stands, from the interferometer.")
]
LengthSigma = Annotated[
    float, typer.Option("--length-sigma", metavar="UM", min=1e-6, help="Standard deviation of the interferometer.")
]


def bench(
    file: BenchTable,
    probe_direction: ProbeDirection = 90.0,
    length_sigma: LengthSigma = 0.1,
    out: Out = None,
    *,
    force: Force = False,
    terminal: Terminal,
) -> None:
    """Find a reflector's range error against incidence from its bench test, with uncertainty.

    The table turns the reflector; the probe's first harmonic is the eccentricity, which is taken off the lengths.
    Writes bench.json to --out.

    Example: ltsim bench my-reflector.csv --out my-reflector
    """
    import ltsim as lt
    from ltsim.evaluation.schema import BenchFile
    from ltsim.recording.result_file import write_result

    claim(out, BenchFile, force=force)
    content = lt.bench(file, probe_direction=probe_direction, length_sigma=length_sigma)
    if out is not None:
        content = write_result(out, content, {})
    terminal.answer(content.content())
    show(terminal, content)
    terminal.written(out)


def show(terminal: Terminal, found: BenchFile) -> None:
    """The table, what explains it, and the line for a scenario."""
    from ltsim.effects.smr_incidence import TABLE_ANGLES
    from ltsim.units import DEGREE

    off = f"{words(found.eccentricity_forward)} forward, {words(found.eccentricity_side)} to the side"
    terminal.say(f"sphere off the table's axis: {off}; run-out {found.run_out_um:.1f} um\n")
    terminal.say(found.table().text())
    vertex = f"{words(found.vertex_axial)} axial, {words(found.vertex_side)} to the side"
    terminal.say(f"\nas a vertex off the centre (smr-centring): {vertex}")
    terminal.say(f"what no offset explains (smr-incidence): {found.remainder_um:.2f} um rms")
    if [round(r.angle_deg, 3) for r in found.angles] == [round(float(a) / DEGREE, 3) for a in TABLE_ANGLES]:
        values = ", ".join(f"{r.error_um:.2f}" for r in found.angles)
        terminal.say(f"\nfor a scenario: [smr] incidence_error = true, table_um = [{values}]")


def words(entry: EstimateEntry) -> str:
    """A length with its standard deviation."""
    return with_sigma(entry.value_um, entry.sigma_um, "um")
