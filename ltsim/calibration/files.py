"""calibration.json with its tables, and history.json: written whole or not at all, and read back."""

from __future__ import annotations

import difflib
from pathlib import Path

import numpy as np

from ltsim.arrays import Floats
from ltsim.calibration.amplitude import Harmonic, harmonics
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.events import Event, events
from ltsim.calibration.history import Change, History
from ltsim.calibration.history_schema import (
    CalibrationOf,
    ChangeEntry,
    ChiSquareEntry,
    CourseEntry,
    DifferenceEntry,
    EventEntry,
    HistoryFile,
)
from ltsim.calibration.result import named
from ltsim.calibration.schema import (
    RESIDUALS,
    TARGETS,
    CalibrationFile,
    Fit,
    HarmonicEntry,
    ParameterEntry,
    VerdictEntry,
)
from ltsim.errors import ModelError, RecordError
from ltsim.model.construction import Construction, with_parameters
from ltsim.recording.files import shown
from ltsim.recording.result_file import read_result, write_result
from ltsim.units import DEGREE, FACTOR, MILLIMETRE


def write_calibration(calibration: Calibration, folder: Path) -> CalibrationFile:
    """Write `calibration.json`, `targets.csv` and, where the network is at hand, `residuals.csv` into a folder.

    Gives the content of the first.

    Raises
    ------
    RecordError
        When the folder cannot be written; nothing half-written stays behind.
    """
    texts = {TARGETS.file: calibration.table("targets").csv()}
    if calibration.adjustment is not None:
        texts[RESIDUALS.file] = calibration.table("residuals").csv()
    return write_result(folder, calibration_file(calibration), texts)


def calibration_file(calibration: Calibration) -> CalibrationFile:
    """The content of `calibration.json`; the covariance is in the units of the parameters."""
    factors = _factors(calibration)
    judged = calibration.verdict
    same: tuple[str, ...] = (
        "recording",
        "method",
        "fit",
        "frame",
        "parameters",
        "undetermined",
        "determined",
        "stations",
        "outliers",
    )
    same += (
        "robust",
        "known",
        "noise",
        "noise_estimated",
        "lost_targets",
        "axes",
        "informed",
        "correction",
        "effects",
        "notes",
    )
    return CalibrationFile(
        construction=calibration.construction.name,
        covariance=(calibration.covariance / np.outer(factors, factors)).tolist(),
        harmonics=tuple(_harmonic(harmonic) for harmonic in harmonics(calibration)),
        criteria=calibration.criteria.as_json() if calibration.criteria else {},
        verdict=VerdictEntry()
        if judged is None
        else VerdictEntry(case=judged.case.value, sentence=judged.sentence, scale_by_sigma0=judged.by_estimate),
        **{name: getattr(calibration, name) for name in same},
    )


def _factors(calibration: Calibration) -> Floats:
    own = [p.factor for p in calibration.construction.parameters]
    return np.tile(np.array(own, dtype=np.float64), len(calibration.instruments))


def _harmonic(harmonic: Harmonic) -> HarmonicEntry:
    factor = harmonic.parameter.factor
    return HarmonicEntry(
        name=harmonic.name,
        amplitude=harmonic.amplitude / factor,
        sigma=harmonic.sigma / factor,
        unit=harmonic.parameter.unit,
        phase_deg=None if harmonic.phase is None else harmonic.phase / DEGREE,
        sigma_phase_deg=None if harmonic.phase_sigma is None else harmonic.phase_sigma / DEGREE,
        **({"instrument": harmonic.instrument} if harmonic.instrument else {}),
    )


def read_targets(file: Path) -> tuple[tuple[str, ...], Floats, Floats]:
    """Names, coordinates (T, 3) [m] and their standard deviations (T, 3) [m] from a `targets.csv`.

    Raises
    ------
    RecordError
        When a column is missing or a field is no number.
    """
    names, values = TARGETS.read(file)
    columns = np.stack([values[name] for name in TARGETS.header[1:]], axis=1) * MILLIMETRE
    return tuple(names["target"]), columns[:, :3], columns[:, 3:]


def read_calibration(path: Path) -> Calibration:
    """The parameters of a `calibration.json` (or of the folder that holds one), with covariance and fit.

    Stations, targets and criteria belong to the network of that calibration and are not read back. A file
    without a covariance gets a diagonal one; parameters that it lacks are zero with their prior sigma, which the
    notes of the result say.

    Raises
    ------
    RecordError
        One sentence: which key, what was found, what would be right.
    """
    file = path / CalibrationFile.FILE if path.is_dir() else path
    return _calibration(read_result(file, CalibrationFile), file)


def _calibration(content: CalibrationFile, file: Path) -> Calibration:
    built = _construction(content, file)
    instruments = tuple(dict.fromkeys(row.instrument for row in content.parameters)) or ("",)
    place = {(i, name): k for k, (i, name) in enumerate((i, n) for i in instruments for n in built.names)}
    prior = np.array([p.prior_sigma for _ in instruments for p in built.parameters])
    values, sigma, factor = np.zeros(len(place)), prior.copy(), np.ones(len(place))
    held, applied = np.zeros(len(place), dtype=bool), np.zeros(len(place))
    at = [_place(row, place, built, number, file) for number, row in enumerate(content.parameters, start=1)]
    for number, (k, row) in enumerate(zip(at, content.parameters, strict=True), start=1):
        if at.index(k) != number - 1:
            raise RecordError(f"parameters: '{shown(row.name)}' stands there twice", file=file, row=number)
        factor[k] = FACTOR[row.unit]
        values[k] = row.value * factor[k]
        prior[k] = prior[k] if row.prior_sigma is None else row.prior_sigma * factor[k]
        sigma[k] = prior[k] if row.sigma is None else row.sigma * factor[k]
        held[k] = row.held
        applied[k] = values[k] if row.applied is None else row.applied * factor[k]
    covariance = np.diag(sigma**2)
    if content.covariance:
        covariance[np.ix_(at, at)] = np.array(content.covariance) * np.outer(factor[at], factor[at])
    shape = (len(instruments), built.size)
    return Calibration(
        method=content.method,
        construction=built,
        instruments=instruments,
        values=values.reshape(shape),
        prior_sigma=prior.reshape(shape),
        covariance=covariance,
        held=held.reshape(shape),
        informed=content.informed,
        effects=content.effects,
        correction=content.correction,
        weighed=None if np.array_equal(applied, values) else applied.reshape(shape),
        fit=content.fit,
        undetermined=content.undetermined,
        frame=content.frame,
        stations=(),
        recording=content.recording,
        notes=_missing([f"{n}@{i}" if i else n for (i, n), k in place.items() if k not in at], file),
    )


def _place(row: ParameterEntry, place: dict[tuple[str, str], int], built: Construction, number: int, file: Path) -> int:
    """Where a parameter of the file belongs; its name and unit are checked."""
    if (row.instrument, row.name) not in place:
        close = difflib.get_close_matches(row.name, built.names, n=1, cutoff=0.4)
        instead = f"; did you mean {close[0]}?" if close else f": those are {', '.join(built.names)}"
        raise RecordError(
            f"parameters: '{shown(row.name)}' is none of construction {built.name}{instead}", file=file, row=number
        )
    if row.unit not in FACTOR:
        raise RecordError(
            f"parameters: unknown unit '{shown(row.unit)}'; expected one of {', '.join(FACTOR)}", file=file, row=number
        )
    return place[row.instrument, row.name]


def _missing(names: list[str], file: Path) -> tuple[str, ...]:
    """What to say of parameters that a file lacks."""
    if not names:
        return ()
    which = "one parameter is" if len(names) == 1 else f"{len(names)} parameters are"
    return (f"{file}: {which} not in the file and taken as zero: {named(names)}",)


def _construction(content: CalibrationFile, file: Path) -> Construction:
    try:
        return with_parameters(content.construction, [row.name for row in content.parameters])
    except ModelError as problem:
        raise RecordError(str(problem), file=file) from None


def history_file(history: History) -> HistoryFile:
    """The content of `history.json`: parameters in the units a person reads, tests as chi-square."""
    factors = np.array([p.factor for p in history.construction.parameters])
    return HistoryFile(
        construction=history.construction.name,
        calibrations=tuple(
            CalibrationOf(label=label, fit=Fit(chi2=c.fit.chi2, dof=c.fit.dof, sigma0=c.fit.sigma0))
            for label, c in zip(history.labels, history.calibrations, strict=True)
        ),
        parameters=tuple(_course(history, k) for k in range(history.construction.size)),
        mean_covariance=(history.population.covariance / np.outer(factors, factors)).tolist(),
        constant=ChiSquareEntry(**history.constancy().entry),
        changes=tuple(_change(history, change) for change in history.changes()),
        events=tuple(_event(history, event) for event in events(history)),
        since_first=_change(history, history.change(0, len(history) - 1)),
    )


def _course(history: History, k: int) -> CourseEntry:
    parameter, known = history.construction.parameters[k], history.population
    return CourseEntry(
        name=parameter.name,
        unit=parameter.unit,
        values=(history.values[:, k] / parameter.factor).tolist(),
        sigmas=(history.sigma[:, k] / parameter.factor).tolist(),
        prior_sigma=history.prior_sigma[k] / parameter.factor,
        mean=known.mean[k] / parameter.factor,
        spread=known.spread[k] / parameter.factor,
        constant=ChiSquareEntry(**history.constancy(k).entry),
    )


def _event(history: History, event: Event) -> EventEntry:
    parameter = history.construction.parameters[event.parameter]
    content = {
        "from": history.labels[event.step],
        "to": history.labels[event.step + 1],
        "name": parameter.name,
        "difference": event.difference / parameter.factor,
        "sigma": event.sigma / parameter.factor,
        "usual": event.usual / parameter.factor,
        "unit": parameter.unit,
        "p_value": event.p_value,
    }
    return EventEntry.model_validate(content)


def _change(history: History, change: Change) -> ChangeEntry:
    parameters = history.construction.parameters
    content = {
        "from": change.first,
        "to": change.second,
        **change.joint.entry,
        "changed": [parameters[k].name for k in change.changed()],
        "parameters": [
            DifferenceEntry(
                name=parameter.name,
                difference=change.difference[k] / parameter.factor,
                sigma=change.sigma[k] / parameter.factor,
                unit=parameter.unit,
                p_value=change.p_values[k],
            )
            for k, parameter in enumerate(parameters)
        ],
    }
    return ChangeEntry.model_validate(content)
