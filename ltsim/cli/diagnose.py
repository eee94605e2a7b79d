"""`ltsim diagnose`, `history`: the physics that was left out; one instrument over many calibrations."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.cli.adjustment import calibration_of
from ltsim.cli.options import FramedReading, Out, Reading, Source
from ltsim.cli.places import Force, claim
from ltsim.cli.terminal import Terminal
from ltsim.errors import LtsimError, RecordError

if TYPE_CHECKING:
    from ltsim.calibration import Calibration
    from ltsim.calibration.history import History
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
    terminal.result(content, out)
    return 1 if fail_on_mismatch and found.verdict == "mismatch" else 0


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
        from ltsim.pages.style import svg
        from ltsim.recording.result_file import write_result

        content = write_result(out, content, {"history.svg": svg(found.plot())})
    terminal.result(content, out)
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
