"""`ltsim diagnose`, `history`: the physics that was left out; one instrument over many calibrations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.chances import p_is, p_text
from ltsim.cli.adjustment import calibration_of
from ltsim.cli.options import FramedReading, Out, Reading, Source
from ltsim.cli.places import Force, claim
from ltsim.cli.terminal import Terminal, table
from ltsim.errors import LtsimError, RecordError
from ltsim.notation import with_sigma

if TYPE_CHECKING:
    from ltsim.calibration import Calibration
    from ltsim.calibration.events import Event
    from ltsim.calibration.history import Change, History
    from ltsim.diagnosis import Diagnosis
    from ltsim.recording import Recording


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
    show_diagnosis(terminal, found)
    terminal.written(out)
    return 1 if fail_on_mismatch and found.verdict == "mismatch" else 0


def show_diagnosis(terminal: Terminal, diagnosis: Diagnosis) -> None:
    """One sentence first, evidence below."""
    from ltsim.diagnosis.words import clear_constants, percent, place

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
    if constants := clear_constants(diagnosis.instruments):
        terminal.say("\nConstants of the instruments, estimated with the findings, the clearest:")
        terminal.say("\n".join(constants))
    blind = [u for u in diagnosis.undetectable if u.hides_um and u.hides_um >= 1.0]
    if blind:
        terminal.say("\nNot to be seen in this recording without a measurement of the cause itself, worst first:")
        rows = [[u.effect, f"{u.hides_um:.0f}", f"{u.shows_at:.0f}" if u.shows_at else "never"] for u in blind]
        terminal.say(table(["effect", "hides [um] of the targets at a bad size", "shows at times that size"], rows))


NOTHING = 1e-7
"""Below what any unit of a finding can show: what a computation leaves of 0."""


def _shown(value: float, digits: int) -> str:
    return "0" if abs(value) < NOTHING else f"{value:.{digits}g}"


Sources = Annotated[
    list[Path],
    typer.Argument(
        metavar="REC_OR_CALIBRATION...",
        help="In the order of time: recordings, calibration.json files, or folders that hold either.",
    ),
]
EachSetUp = Annotated[bool, typer.Option("--each-set-up", help="Calibrate every set-up of a recording by itself.")]
FailOnChange = Annotated[
    bool,
    typer.Option(
        "--fail-on-change",
        help="Exit with status 1 when an event stands out of the day-to-day changes or, with few calibrations, the "
        "last differs from the first (for CI).",
    ),
]
LEVEL = 0.01


def history(
    sources: Sources,
    out: Out = None,
    each_set_up: EachSetUp = False,
    fail_on_change: FailOnChange = False,
    *,
    reading: Reading,
    force: Force = False,
    terminal: Terminal,
    **options: Annotated[Any, "history", "adjust robust noise_from_data"],
) -> int:
    """Follow an instrument's parameters over calibrations: course, uncertainty, and whether it has changed since.

    Writes history.json and history.svg to --out.

    Example: ltsim history january.json may.json september-recording --out my-history
    """
    from ltsim.calibration.files import history_file
    from ltsim.calibration.history import History
    from ltsim.calibration.history_schema import HistoryFile

    claim(out, HistoryFile, ("history.svg",), force=force)
    named: list[tuple[str, Calibration]] = []
    instrument, dates = options.pop("instrument"), options.pop("dates")
    with terminal.progress("calibrating", len(sources)) as done:
        for source in sources:
            named += _calibrations(terminal, source, reading, options, each_set_up=each_set_up)
            done(1)
    found = History.of(named, instrument, dates)
    content = history_file(found)
    if out is not None:
        from ltsim.pages.figures.parameters import history_figure
        from ltsim.pages.style import svg
        from ltsim.recording.result_file import write_result

        known = [course for course in content.parameters if course.constant.dof]
        content = write_result(out, content, {"history.svg": svg(history_figure(found.labels, known))})
    terminal.answer(content.content())
    show_history(terminal, found)
    if out is not None:
        terminal.say(f"\nwritten to {out}")
    return 1 if fail_on_change and _has_changed(found) else 0


def _has_changed(found: History) -> bool:
    """An event where there are calibrations enough to tell one, otherwise any change from the first to the last."""
    from ltsim.calibration.events import events, knows_usual

    return bool(events(found)) if knows_usual(found) else found.change(0, len(found) - 1).joint.p_value < LEVEL


def _calibrations(
    terminal: Terminal, source: Path, reading: Reading, treated: dict[str, Any], *, each_set_up: bool
) -> list[tuple[str, Calibration]]:
    """One calibration of a file, or one a set-up of a recording."""
    from ltsim.calibration.schema import CalibrationFile

    file = CalibrationFile.FILE
    if source.name == file or (source / file).is_file() or source.suffix == ".json":
        label = source.parent.name if source.name == file else source.stem
        return [(label or source.stem, calibration_of(terminal, source))]
    recording = reading.of(source)
    terminal.notes(recording.notes)
    label = source.stem if source.is_file() else source.name
    if not each_set_up:
        return [(label, _calibrated(recording, label, treated))]
    parts = [(f"{label} {name}", recording.select(recording.station == i)) for i, name in enumerate(recording.stations)]
    return [(name, _calibrated(part, name, treated)) for name, part in parts]


def _calibrated(recording: Recording, label: str, treated: dict[str, Any]) -> Calibration:
    try:
        return lt.calibrate(recording, advise=False, **treated)
    except LtsimError as problem:
        raise RecordError(f"{label} cannot be calibrated: {problem}") from None


def show_history(terminal: Terminal, found: History) -> None:
    """The course of each parameter, then what changed from one calibration to the next."""
    from ltsim.calibration.events import events, knows_usual

    rows = []
    silent = []
    for k, parameter in enumerate(found.construction.parameters):
        test = found.constancy(k)
        if not test.dof:
            silent.append(parameter.name)
            continue
        last = with_sigma(found.values[-1, k] / parameter.factor, found.sigma[-1, k] / parameter.factor)
        mean, spread = found.population.mean[k] / parameter.factor, found.population.spread[k] / parameter.factor
        rows.append([parameter.name, parameter.unit, last, f"{mean:.2f}", f"{spread:.2f}", p_text(test.p_value)])
    header = ("parameter", "unit", "last", "mean", "spread", "p constant")
    terminal.say(f"{len(found)} calibrations, {found.labels[0]} to {found.labels[-1]}\n")
    terminal.say(table(header, rows, left=2))
    if silent:
        terminal.say(f"\nnothing is known of {', '.join(silent)}")
    terminal.say()
    found_events = events(found)
    for i, change in enumerate(found.changes()):
        terminal.say(_sentence(found, change, [event for event in found_events if event.step == i]))
    terminal.say("since the first: " + _sentence(found, found.change(0, len(found) - 1), found_events))
    if not knows_usual(found):
        few = "no event can be told" if len(found) < 4 else "only a gross event stands out"
        terminal.say(f"{len(found)} calibrations hardly tell how the instrument moves from one to the next: {few}")


def _sentence(found: History, change: Change, stood_out: Sequence[Event]) -> str:
    """From one calibration to another, with the events between them."""
    test = change.joint
    said = _events(found, stood_out) if stood_out else _verdict(found, change)
    return f"{change.first} to {change.second}: chi2 {test.chi2:.1f}/{test.dof}, {p_is(test.p_value)}: {said}"


def _verdict(found: History, change: Change) -> str:
    from ltsim.calibration.events import knows_usual

    if change.joint.p_value >= LEVEL:
        return "no change seen"
    if knows_usual(found):
        return "no more than it moves from one calibration to the next"
    names = [found.construction.names[k] for k in change.changed()]
    return "changed" + (f", above all {', '.join(names)}" if names else ", in no single parameter for certain")


def _events(found: History, stood_out: Sequence[Event]) -> str:
    """What stands out of the day-to-day changes, each parameter with its unit."""
    parts = []
    for event in stood_out:
        parameter = found.construction.parameters[event.parameter]
        step = with_sigma(event.difference / parameter.factor, event.sigma / parameter.factor, parameter.unit)
        usual = f"{event.usual / parameter.factor:.2g} {parameter.unit}"
        parts.append(f"{parameter.name} by {step} (its usual step: {usual})")
    return f"an event (a service, a blow): {'; '.join(parts)}"
