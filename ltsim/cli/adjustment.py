"""Commands for networks of stations: `adjust`, `calibrate`, `correct`, `evaluate`, `verify`, `diagnose`, `history`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.cli.estimation_options import AdjustOptions, CalibrateOptions, DiagnoseOptions, HistoryOptions
from ltsim.cli.options import (
    CalibrationFileOption,
    OptionalCalibrationFileOption,
    ReadingOptions,
    ReadingOptionsWithFrame,
    RecordingArgument,
)
from ltsim.cli.output_checks import RECORDING_OUTPUT, ForceOption, write_outputs
from ltsim.cli.terminal import ResultFolderTerminal, Terminal
from ltsim.core.units import ARCSECOND, MICROMETRE

if TYPE_CHECKING:
    from collections.abc import Callable

    from ltsim.adjustment.evaluation import Criteria
    from ltsim.calibration.calibration import Calibration
    from ltsim.recordings import Recording

MIN_REPORTED_READING_CHANGE = 0.005
"""Smallest change of the readings [um for distances, arcsec for angles] that `correct` reports as a correction. It is
half of the last digit that is printed for an angle. After a smaller change, the command states that the readings do not
change."""
CorrectedRecordingOption = Annotated[
    Path, typer.Option("--out", metavar="REC2", help="Folder of the corrected recording."), RECORDING_OUTPUT
]
WithStationsOption = Annotated[
    bool,
    typer.Option(
        "--with-stations",
        help="Also write points.csv and points.covariance.csv to --out: targets and stations with their joint "
        "covariance, as input of ltsim uncertainty and ltsim compare.",
    ),
]
AllowRejectedOption = Annotated[
    bool, typer.Option("--allow-rejected", help="Also use a calibration whose readings contradict its model.")
]
NominalPointsOption = Annotated[
    Path, typer.Option("--nominal", metavar="FILE", help="Nominal points of the targets: table target,x_mm,y_mm,z_mm.")
]


def adjust(
    source: RecordingArgument,
    with_stations: WithStationsOption = False,
    *,
    options: AdjustOptions,
    reading_options: ReadingOptionsWithFrame,
    terminal: ResultFolderTerminal,
) -> None:
    """Adjust the network of a recording without instrument parameters: targets, stations, outliers.

    Writes calibration.json, targets.csv, targets.covariance.csv (joint covariance) and residuals.csv to --out.

    Example: ltsim adjust my-recording --robust --noise-from-data --out adjusted
    """
    _run_estimation(lt.adjust, source, reading_options, terminal, options.arguments(), with_stations=with_stations)


def calibrate(
    source: RecordingArgument,
    with_stations: WithStationsOption = False,
    *,
    options: CalibrateOptions,
    reading_options: ReadingOptionsWithFrame,
    terminal: ResultFolderTerminal,
) -> None:
    """Estimate the instrument's parameters, with uncertainties; report combinations that stay undetermined.

    Writes calibration.json, targets.csv, targets.covariance.csv (joint covariance) and residuals.csv to --out.

    Example: ltsim calibrate my-recording --out my-calibration
    """
    _run_estimation(lt.calibrate, source, reading_options, terminal, options.arguments(), with_stations=with_stations)


def correct(
    source: RecordingArgument,
    calibration: CalibrationFileOption,
    out: CorrectedRecordingOption,
    *,
    reading_options: ReadingOptionsWithFrame,
    allow_rejected: AllowRejectedOption = False,
    force: ForceOption = False,
    terminal: Terminal,
) -> None:
    """Remove the instrument's errors, estimated by a calibration, from a recording.

    Readings stay in the frame of each set-up; --frame sets the coordinate frame of later results. A calibration whose
    readings contradict its model is rejected.

    Example: ltsim correct my-recording --calibration my-calibration --out corrected
    """
    import numpy as np

    from ltsim.calibration.files import read_calibration
    from ltsim.geometry.polar import wrap_angle
    from ltsim.physics.effects import effect_title

    recording, instrument = reading_options.read(source), read_calibration(calibration)
    corrected_recording = lt.correct(recording, instrument, allow_repeated=force, allow_rejected=allow_rejected)
    terminal.print_notes((*recording.notes, *instrument.warnings))
    if not instrument.instrument_parameter_names:
        terminal.print_notes(["this calibration contains no instrument parameters; the readings do not change"])
    if instrument.effects:
        estimated = ", ".join(effect_title(effect.effect) for effect in instrument.effects)
        terminal.print_notes([f"effects that were estimated with the calibration stay in the readings: {estimated}"])
    if instrument.correction is not None:
        terminal.print_notes(instrument.correction.sentences)
    write_outputs({out: partial(lt.write, corrected_recording)}, force=force)
    reading_changes = corrected_recording.readings - recording.readings
    reading_changes[:, 1:] = wrap_angle(reading_changes[:, 1:])
    max_changes = np.nanmax(np.abs(reading_changes), axis=0, initial=0.0) / [MICROMETRE, ARCSECOND, ARCSECOND]
    keys = ("distance_um", "azimuth_arcsec", "elevation_arcsec")
    terminal.print_json(
        {"pointings": len(recording), "largest_change": dict(zip(keys, max_changes.tolist(), strict=True))}
    )
    distance, azimuth, elevation = max_changes
    largest_changes_text = (
        f"up to {distance:.1f} um in distance, {azimuth:.2f} arcsec in azimuth, {elevation:.2f} arcsec in elevation"
    )
    correction_sentence = f"{len(recording)} pointings corrected by {largest_changes_text}"
    terminal.print_text(
        correction_sentence
        if np.any(max_changes >= MIN_REPORTED_READING_CHANGE)
        else "no correction was applied: the readings do not change"
    )
    terminal.print_text(f"written to {out}")


def evaluate(
    source: RecordingArgument,
    calibration: OptionalCalibrationFileOption = None,
    *,
    reading_options: ReadingOptions,
    terminal: ResultFolderTerminal,
) -> None:
    """Evaluate the disagreement of the stations in distances and coordinates, before and after a calibration.

    Writes criteria.json to --out. Without a calibration, only the values before calibration are given.

    Example: ltsim evaluate my-recording --calibration my-calibration
    """
    from ltsim.adjustment.evaluation import Criteria
    from ltsim.adjustment.snooping import screen_gross_errors

    terminal.check_overwrite(Criteria)
    recording = reading_options.read_and_report(source, terminal)
    is_gross = screen_gross_errors(recording).is_gross_pointing
    if is_gross.any():
        rows = ", ".join(str(i + 1) for i in is_gross.nonzero()[0][:12])
        terminal.print_notes([f"{is_gross.sum()} pointings are gross errors and are not used (rows {rows})"])
    input_calibration = None if calibration is None else read_calibration_with_notes(terminal, calibration)
    _write_and_print_criteria(terminal, lt.evaluate(recording, input_calibration))


def verify(
    source: RecordingArgument,
    nominal: NominalPointsOption,
    calibration: CalibrationFileOption,
    *,
    reading_options: ReadingOptions,
    terminal: ResultFolderTerminal,
) -> None:
    """Compare a recording with nominal points, before and after its correction by an earlier calibration.

    The errors of distances and coordinates are those of Sensors 2021, 21, 7479, eq. 13 and 14. Writes criteria.json to
    --out.

    Example: ltsim verify laboratory --nominal cmm.csv --calibration my-calibration
    """
    from ltsim.adjustment.evaluation import Criteria

    terminal.check_overwrite(Criteria)
    recording = reading_options.read_and_report(source, terminal)
    input_calibration = read_calibration_with_notes(terminal, calibration)
    _write_and_print_criteria(terminal, lt.verify(recording, nominal, input_calibration))


def _run_estimation(
    estimator: Callable[..., Calibration],
    source: Path,
    reading_options: ReadingOptionsWithFrame,
    terminal: ResultFolderTerminal,
    options: dict[str, Any],
    *,
    with_stations: bool,
) -> None:
    """Run of `lt.adjust` or `lt.calibrate` (`estimator`) with output of the result on the terminal and in the folder.

    Without --force each command replaces only earlier results of the same command. `options` are keyword arguments of
    the estimator. With `with_stations` the files of targets and stations are written too.
    """
    from ltsim.calibration.calibration import Calibration
    from ltsim.calibration.files import write_calibration

    is_adjustment = estimator is lt.adjust
    terminal.check_overwrite(Calibration, lambda result: (result.method == "adjustment") == is_adjustment)
    recording = reading_options.read_and_report(source, terminal)
    with terminal.show_progress("adjusting" if is_adjustment else "calibrating"):
        result = estimator(recording, **options)
    result = write_calibration(result, terminal.out, with_stations=with_stations) if terminal.out else result
    terminal.print_result(result, notes=result.notes)


def _write_and_print_criteria(terminal: ResultFolderTerminal, criteria: Criteria) -> None:
    """Print the criteria (disagreement of stations in distances and coordinates) and write them to a folder."""
    criteria = terminal.write_result(criteria)
    terminal.print_json(criteria.content())
    terminal.print_text(criteria.table().text())
    if terminal.out is not None:
        terminal.print_text(f"\nwritten to {terminal.out}")


def read_calibration_with_notes(terminal: Terminal, path: Path) -> Calibration:
    """Calibration from a file, whose notes are printed; raises RecordError."""
    from ltsim.calibration.files import read_calibration

    calibration = read_calibration(path)
    terminal.print_notes(calibration.warnings)
    return calibration


FailOnMismatchOption = Annotated[
    bool, typer.Option("--fail-on-mismatch", help="Exit with status 1 if recording and model disagree (for CI).")
]
HeldOutErrorOption = Annotated[
    bool | None,
    typer.Option(
        "--held-out/--no-held-out",
        help="Compute the held-out error by 5-fold cross-validation: the diagnosis is repeated five times, each time "
        "without a fifth of the readings, which it then predicts. Effects that predict worse than no effect are "
        "reported as improbable. Default, as in Python: only in networks with up to 500 unknowns.",
    ),
]


def diagnose(
    source: RecordingArgument,
    held_out: HeldOutErrorOption = None,
    fail_on_mismatch: FailOnMismatchOption = False,
    with_stations: WithStationsOption = False,
    *,
    options: DiagnoseOptions,
    reading_options: ReadingOptionsWithFrame,
    terminal: ResultFolderTerminal,
) -> int:
    """Test whether recording and model agree; if not, report cause, location, probability, and the next measurement.

    Writes diagnosis.json, targets.csv (adjusted with the findings in the model), targets.covariance.csv (joint
    covariance), residuals and the recording to --out.

    Example: ltsim diagnose my-recording --out my-diagnosis && ltsim report my-diagnosis
    """
    from ltsim.diagnosis.diagnosis import Diagnosis
    from ltsim.diagnosis.files import write_diagnosis

    terminal.check_overwrite(Diagnosis)
    recording = reading_options.read_and_report(source, terminal)
    with terminal.show_progress("diagnosing"):
        diagnosis = lt.diagnose(recording, held_out=held_out, **options.arguments())
    if terminal.out:
        diagnosis = write_diagnosis(diagnosis, terminal.out, recording, with_stations=with_stations)
    terminal.print_result(diagnosis)
    return 1 if fail_on_mismatch and diagnosis.verdict == "mismatch" else 0


HistorySourcesArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="REC_OR_CALIBRATION...",
        help="Recordings, calibration.json files, or folders of either, in chronological order.",
    ),
]
EachSetUpOption = Annotated[
    bool, typer.Option("--each-set-up", help="Calibrate each set-up of a recording separately.")
]
FailOnChangeOption = Annotated[
    bool,
    typer.Option(
        "--fail-on-change",
        help="Exit with status 1 if a change exceeds the day-to-day changes or, with few calibrations, if the last "
        "calibration differs from the first (for CI).",
    ),
]


def history(
    sources: HistorySourcesArgument,
    each_set_up: EachSetUpOption = False,
    fail_on_change: FailOnChangeOption = False,
    *,
    options: HistoryOptions,
    reading_options: ReadingOptions,
    terminal: ResultFolderTerminal,
) -> int:
    """Report an instrument's parameters over several calibrations: estimates, uncertainties, and changes.

    Writes history.json and history.svg to --out.

    Example: ltsim history january.json may.json september-recording --out my-history
    """
    from ltsim.calibration.history import History
    from ltsim.reports.sections import result_section

    terminal.check_overwrite(History)
    source_by_label: dict[str, Calibration | Recording] = {}
    for source in sources:
        source_by_label |= _calibrations_or_recordings(terminal, source, reading_options, each_set_up=each_set_up)
    with terminal.show_progress("calibrating"):
        content = lt.history(source_by_label, **options.arguments())

    def history_picture() -> dict[str, str]:
        from ltsim.reports.figures.parameters import parameter_history_figure
        from ltsim.reports.style import svg_text

        return {"history.svg": svg_text(parameter_history_figure(content.labels, content.determined_parameters))}

    written_history = terminal.write_result(content, history_picture)
    terminal.print_result(written_history)
    return 1 if fail_on_change and result_section(content).assessment == "bad" else 0


def _calibrations_or_recordings(
    terminal: Terminal, source: Path, reading_options: ReadingOptions, *, each_set_up: bool
) -> dict[str, Calibration | Recording]:
    """Calibration or recording at a path, by its label; with `each_set_up` one recording for each of its set-ups."""
    from ltsim.calibration.calibration import Calibration

    file = Calibration.FILE
    if source.name == file or (source / file).is_file() or source.suffix == ".json":
        label = source.parent.name if source.name == file else source.stem
        return {label or source.stem: read_calibration_with_notes(terminal, source)}
    recording = reading_options.read(source)
    terminal.print_notes(recording.notes)
    label = source.stem if source.is_file() else source.name
    if not each_set_up:
        return {label: recording}
    return {f"{label} {name}": recording.select(recording.station == i) for i, name in enumerate(recording.stations)}
