"""`ltsim diagnose`: from a recording to the physics that was left out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.chances import p_text
from ltsim.cli.options import FramedReading, Out, Source
from ltsim.cli.places import Force, claim
from ltsim.cli.terminal import Terminal, table

if TYPE_CHECKING:
    from ltsim.diagnosis import Diagnosis

FailOnMismatch = Annotated[
    bool, typer.Option("--fail-on-mismatch", help="Exit with status 1 when recording and model differ (for CI).")
]
HeldOut = Annotated[
    bool | None,
    typer.Option(
        "--held-out/--no-held-out",
        help="Repeat the search without each of five parts of the readings and predict them; default: small networks.",
    ),
]


def diagnose(
    source: Source,
    out: Out = None,
    held_out: HeldOut = None,
    fail_on_mismatch: FailOnMismatch = False,
    *,
    reading: FramedReading,
    force: Force = False,
    terminal: Terminal,
    **options: Any,
) -> int:
    """Say whether recording and model agree; where not: where, why, how sure, and what to measure next.

    Writes diagnosis.json, targets.csv (adjusted with the findings modelled), residuals and the recording to --out.

    Example: ltsim diagnose my-recording --out my-diagnosis && ltsim report my-diagnosis
    """
    from ltsim.diagnosis.files import COMPANIONS, write_diagnosis
    from ltsim.diagnosis.schema import DiagnosisFile

    claim(out, DiagnosisFile, COMPANIONS, force=force)
    recording = reading.open(source, terminal)
    with terminal.busy("diagnosing"):
        found = lt.diagnose(recording, held_out=held_out, **options)
    content = found.file(recording) if out is None else write_diagnosis(found, out, recording)
    terminal.answer(content.content())
    show(terminal, found)
    terminal.written(out)
    return 1 if fail_on_mismatch and found.verdict == "mismatch" else 0


def show(terminal: Terminal, diagnosis: Diagnosis) -> None:
    """One sentence first, evidence below."""
    from ltsim.diagnosis.words import percent, place

    terminal.say("\n" + diagnosis.summary)
    for number, finding in enumerate(diagnosis.findings, start=1):
        terminal.say(f"\n{number}. {finding.effect} {place(finding.where)}")
        rows = [[p.name, _shown(p.value, 3), _shown(p.sigma, 2), p.unit] for p in finding.parameters]
        terminal.say(table(["parameter", "value", "sigma", "unit"], rows))
        evidence = finding.evidence
        said = [
            f"chi-square falls by {evidence.chi2_drop:.0f} for {evidence.parameters} parameters",
            f"probability of this name {percent(evidence.probability)}",
        ]
        if evidence.p_value is not None:
            said.append(f"chance of as much in a clean recording at most {p_text(evidence.p_value)}")
        terminal.say("; ".join(said))
        for other in finding.equivalents:
            terminal.say(f"not excluded: {other.effect} ({percent(other.probability)})")
        if finding.separate_by:
            terminal.say(f"to decide: {finding.separate_by}")
    blind = [u for u in diagnosis.undetectable if u.hides_um and u.hides_um >= 1.0]
    if blind:
        terminal.say("\nNot to be seen in this recording without a measurement of the cause itself, worst first:")
        rows = [[u.effect, f"{u.hides_um:.0f}", f"{u.shows_at:.0f}" if u.shows_at else "never"] for u in blind]
        terminal.say(table(["effect", "hides [um] of the targets at a bad size", "shows at times that size"], rows))


NOTHING = 1e-7
"""Below what any unit of a finding can show: what a computation leaves of 0."""


def _shown(value: float, digits: int) -> str:
    return "0" if abs(value) < NOTHING else f"{value:.{digits}g}"
