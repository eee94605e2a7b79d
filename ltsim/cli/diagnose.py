"""`ltsim diagnose`, `history`: the physics that was left out; one instrument over many calibrations."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.cli.adjustment import calibration_of
from ltsim.cli.options import FramedReading, ReadingOptions, Source
from ltsim.cli.terminal import ResultTerminal, Terminal

if TYPE_CHECKING:
    from ltsim.calibration.calibration import Calibration
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
    held_out: HeldOut = None,
    fail_on_mismatch: FailOnMismatch = False,
    *,
    reading: FramedReading,
    terminal: ResultTerminal,
    **options: Any,
) -> int:
    """Say whether recording and model agree; where not: where, why, how sure, and what to measure next.

    Writes diagnosis.json, targets.csv (adjusted with the findings modelled), residuals and the recording to --out.

    Example: ltsim diagnose my-recording --out my-diagnosis && ltsim report my-diagnosis
    """
    from ltsim.diagnosis.files import COMPANIONS, write_diagnosis
    from ltsim.diagnosis.schema import DiagnosisFile

    terminal.claim(DiagnosisFile, *COMPANIONS)
    recording = reading.open(source, terminal)
    with terminal.busy("diagnosing"):
        found = lt.diagnose(recording, held_out=held_out, **options)
    content = write_diagnosis(found, terminal.out, recording) if terminal.out else found.file(recording)
    terminal.result(content)
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


def history(
    sources: Sources,
    each_set_up: EachSetUp = False,
    fail_on_change: FailOnChange = False,
    *,
    reading: ReadingOptions,
    terminal: ResultTerminal,
    **options: Annotated[Any, "history", "adjust robust noise_from_data"],
) -> int:
    """Follow an instrument's parameters over calibrations: course, uncertainty, and whether it has changed since.

    Writes history.json and history.svg to --out.

    Example: ltsim history january.json may.json september-recording --out my-history
    """
    from ltsim.calibration.history_file import history_file
    from ltsim.calibration.history_schema import HistoryFile
    from ltsim.pages.sections import section_of

    terminal.claim(HistoryFile, "history.svg")
    opened: dict[str, Calibration | Recording] = {}
    for source in sources:
        opened |= _opened(terminal, source, reading, each_set_up=each_set_up)
    with terminal.busy("calibrating"):
        found = lt.history(opened, **options)
    content = history_file(found)

    def drawn() -> dict[str, str]:
        from ltsim.pages.figures.parameters import history_figure
        from ltsim.pages.style import svg

        known = [course for course in content.parameters if course.constant.dof]
        return {"history.svg": svg(history_figure(found.labels, known))}

    written = terminal.kept(content, drawn)
    terminal.result(written)
    return 1 if fail_on_change and section_of(content).mood == "bad" else 0


def _opened(
    terminal: Terminal, source: Path, reading: ReadingOptions, *, each_set_up: bool
) -> dict[str, Calibration | Recording]:
    """A calibration that was written before, or a recording, or each of its set-ups, by what it is called."""
    from ltsim.calibration.schema import CalibrationFile

    file = CalibrationFile.FILE
    if source.name == file or (source / file).is_file() or source.suffix == ".json":
        label = source.parent.name if source.name == file else source.stem
        return {label or source.stem: calibration_of(terminal, source)}
    recording = reading.of(source)
    terminal.notes(recording.notes)
    label = source.stem if source.is_file() else source.name
    if not each_set_up:
        return {label: recording}
    return {f"{label} {name}": recording.select(recording.station == i) for i, name in enumerate(recording.stations)}
