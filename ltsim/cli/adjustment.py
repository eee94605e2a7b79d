"""Estimates of network and instrument from recordings: `ltsim adjust`, `calibrate`, `diagnose` and so on."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.cli.options import CalibrationFile, FramedReading, OptionalCalibrationFile, ReadingOptions, Source
from ltsim.cli.places import RECORDING, Force
from ltsim.cli.terminal import ResultTerminal, Terminal
from ltsim.core.units import ARCSECOND, MICROMETRE

if TYPE_CHECKING:
    from collections.abc import Callable

    from ltsim.adjustment.evaluation import Criteria
    from ltsim.calibration.calibration import Calibration
    from ltsim.recordings import Recording

Corrected = Annotated[Path, typer.Option("--out", metavar="REC2", help="Folder of the corrected recording."), RECORDING]
Nominal = Annotated[
    Path, typer.Option("--nominal", metavar="FILE", help="Points of the targets: target,x_mm,y_mm,z_mm.")
]


def adjust(
    source: Source,
    *,
    reading: FramedReading,
    terminal: ResultTerminal,
    **options: Any,
) -> None:
    """Adjust the network of a recording without instrument parameters: targets, stations, outliers.

    Writes calibration.json, targets.csv, targets.covariance.csv (joint) and residuals.csv to --out.

    Example: ltsim adjust my-recording --robust --noise-from-data --out adjusted
    """
    _fitted(lt.adjust, source, reading, terminal, options)


def calibrate(
    source: Source,
    *,
    reading: FramedReading,
    terminal: ResultTerminal,
    **options: Any,
) -> None:
    """Find the instrument's parameters from a recording, with uncertainty, and say what it cannot tell.

    Writes calibration.json, targets.csv, targets.covariance.csv (joint) and residuals.csv to --out.

    Example: ltsim calibrate my-recording --out my-calibration
    """
    _fitted(lt.calibrate, source, reading, terminal, options)


def correct(
    source: Source,
    calibration: CalibrationFile,
    out: Corrected,
    *,
    reading: FramedReading,
    force: Force = False,
    terminal: Terminal,
) -> None:
    """Write the recording that an ideal tracker would have made, by a calibration of the instrument.

    Readings stay in the axes of each set-up; with --frame whatever is computed from them later is in those of FILE.

    Example: ltsim correct my-recording --calibration my-calibration --out corrected
    """
    import numpy as np

    from ltsim.geometry.polar import wrap

    recording = reading.of(source)
    terminal.notes(recording.notes)
    found = calibration_of(terminal, calibration)
    if not found.names:
        terminal.notes(["this calibration holds no instrument parameters; nothing changes"])
    if found.effects:
        beside = ", ".join(effect.effect for effect in found.effects)
        terminal.notes([f"estimated beside the calibration and not taken out of the readings: {beside}"])
    corrected = lt.correct(recording, found, again=force)
    lt.write(corrected, out)
    change = corrected.readings - recording.readings
    change[:, 1:] = wrap(change[:, 1:])
    largest = np.nanmax(np.abs(change), axis=0, initial=0.0) / [MICROMETRE, ARCSECOND, ARCSECOND]
    keys = ("distance_um", "azimuth_arcsec", "elevation_arcsec")
    terminal.answer({"pointings": len(recording), "largest_change": dict(zip(keys, largest.tolist(), strict=True))})
    terminal.say(
        f"{len(recording)} pointings corrected by up to {largest[0]:.1f} um in distance, "
        f"{largest[1]:.2f} arcsec in azimuth, {largest[2]:.2f} arcsec in elevation"
    )
    terminal.say(f"written to {out}")


def evaluate(
    source: Source,
    calibration: OptionalCalibrationFile = None,
    *,
    reading: ReadingOptions,
    terminal: ResultTerminal,
) -> None:
    """Disagreement of the stations in distances and coordinates, before and after a calibration.

    Writes criteria.json to --out. Without a calibration there is no "after".

    Example: ltsim evaluate my-recording --calibration my-calibration
    """
    from ltsim.adjustment.evaluation.criteria import CriteriaFile
    from ltsim.adjustment.snooping import screened

    terminal.claim(CriteriaFile)
    recording = reading.open(source, terminal)
    gross = screened(recording).gross
    if gross.any():
        rows = ", ".join(str(i + 1) for i in gross.nonzero()[0][:12])
        terminal.notes([f"{gross.sum()} pointings miss their target by far and are left out (rows {rows})"])
    found = None if calibration is None else calibration_of(terminal, calibration)
    _judged(terminal, lt.evaluate(recording, found), recording)


def verify(
    source: Source,
    nominal: Nominal,
    calibration: CalibrationFile,
    *,
    reading: ReadingOptions,
    terminal: ResultTerminal,
) -> None:
    """Apply a calibration to another recording and compare with nominal points, before and after (eq. 13, 14).

    Writes criteria.json to --out.

    Example: ltsim verify laboratory --nominal cmm.csv --calibration my-calibration
    """
    from ltsim.adjustment.evaluation.criteria import CriteriaFile

    terminal.claim(CriteriaFile)
    recording = reading.open(source, terminal)
    found = calibration_of(terminal, calibration)
    _judged(terminal, lt.verify(recording, nominal, found), recording)


def _fitted(
    verb: Callable[..., Calibration],
    source: Path,
    reading: FramedReading,
    terminal: ResultTerminal,
    options: dict[str, Any],
) -> None:
    """Fit, write, show; a calibration replaces a calibration alone, an adjustment an adjustment."""
    from ltsim.adjustment.joint import COVARIANCE
    from ltsim.calibration.files import calibration_file, write_calibration
    from ltsim.calibration.schema import RESIDUALS, TARGETS, CalibrationFile

    alone = verb is lt.adjust
    names = (TARGETS.file, COVARIANCE, RESIDUALS.file)
    terminal.claim(CalibrationFile, *names, own=lambda found: (found.method == "adjustment") == alone)
    recording = reading.open(source, terminal)
    with terminal.progress("adjusting" if alone else "calibrating"):
        found = verb(recording, **options)
    content = write_calibration(found, terminal.out) if terminal.out else calibration_file(found)
    terminal.result(content, notes=found.notes)


def _judged(terminal: ResultTerminal, criteria: Criteria, recording: Recording) -> None:
    from ltsim.adjustment.evaluation.criteria import CriteriaFile
    from ltsim.recordings.result_file import SourceEntry

    content = CriteriaFile.model_validate({"recording": SourceEntry.of(recording), **criteria.as_json()})
    terminal.kept(content)
    terminal.answer(content.content())
    terminal.say(criteria.table().text())
    if terminal.out is not None:
        terminal.say(f"\nwritten to {terminal.out}")


def calibration_of(terminal: Terminal, path: Path) -> Calibration:
    """A calibration that was written before, with what it lacks said; raises RecordError."""
    from ltsim.calibration.files import read_calibration

    found = read_calibration(path)
    terminal.notes(found.notes)
    return found


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

    Writes diagnosis.json, targets.csv (adjusted with the findings modelled), targets.covariance.csv (joint), residuals
    and the recording to --out.

    Example: ltsim diagnose my-recording --out my-diagnosis && ltsim report my-diagnosis
    """
    from ltsim.diagnosis.files import COMPANIONS, write_diagnosis
    from ltsim.diagnosis.schema import DiagnosisFile

    terminal.claim(DiagnosisFile, *COMPANIONS)
    recording = reading.open(source, terminal)
    with terminal.progress("diagnosing"):
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
    from ltsim.reports.sections import section_of

    terminal.claim(HistoryFile, "history.svg")
    opened: dict[str, Calibration | Recording] = {}
    for source in sources:
        opened |= _opened(terminal, source, reading, each_set_up=each_set_up)
    with terminal.progress("calibrating"):
        found = lt.history(opened, **options)
    content = history_file(found)

    def drawn() -> dict[str, str]:
        from ltsim.reports.figures.parameters import history_figure
        from ltsim.reports.style import svg

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
