"""calibration.json with its tables, written whole or not at all and read back."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ltsim.adjustment.joint import COVARIANCE
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.reported import joint_csv
from ltsim.calibration.schema import RESIDUALS, TARGETS, CalibrationFile, ReflectorEntry, VerdictEntry
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError, RecordError, unknown_name
from ltsim.core.notation import listing
from ltsim.core.units import FACTOR, MILLIMETRE
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.physics.model.construction import with_parameters
from ltsim.recordings.files import read_text, shown
from ltsim.recordings.result_file import read_result, write_result

CalibrationSource = Calibration | str | Path
"""A calibration, its file, or the folder that holds it."""


def write_calibration(calibration: Calibration, folder: Path) -> CalibrationFile:
    """Write `calibration.json` and `targets.csv` into a folder, of a network at hand residuals and covariance.

    Gives the content of the first.

    Raises
    ------
    RecordError
        When the folder cannot be written; nothing half-written stays behind.
    """
    texts = {TARGETS.file: calibration.table("targets").csv()}
    if calibration.adjustment is not None:
        texts[RESIDUALS.file] = calibration.table("residuals").csv()
        covariance = joint_csv(calibration)
        texts |= {} if covariance is None else {COVARIANCE: covariance}
    return write_result(folder, calibration_file(calibration), texts)


def calibration_file(calibration: Calibration) -> CalibrationFile:
    """The content of `calibration.json`; the covariance is in the units of the parameters."""
    factors = np.tile([p.factor for p in calibration.construction.parameters], len(calibration.instruments))
    judged = calibration.verdict
    content = {name: getattr(calibration, name) for name in CalibrationFile.model_fields if hasattr(calibration, name)}
    content |= {
        "construction": calibration.construction.name,
        "covariance": (calibration.covariance / np.outer(factors, factors)).tolist(),
        "criteria": calibration.criteria.model_dump(exclude_unset=True) if calibration.criteria else {},
        "verdict": VerdictEntry()
        if judged is None
        else VerdictEntry(case=judged.case.value, sentence=judged.sentence, scale_by_sigma0=judged.by_estimate),
    }
    return CalibrationFile(**content)


def read_targets(file: Path) -> tuple[tuple[str, ...], Floats, Floats]:
    """Names, coordinates (T, 3) [m] and their standard deviations (T, 3) [m] from a `targets.csv`.

    Raises
    ------
    RecordError
        When a column is missing or a field is no number.
    """
    table = TARGETS.parsed(read_text(file), file)
    numbers = table.numbers(*TARGETS.header[1:]) * MILLIMETRE
    return tuple(table.column("target")), numbers[:, :3], numbers[:, 3:]


def calibration_of(source: CalibrationSource) -> Calibration:
    """The calibration itself, read where a path was given."""
    return source if isinstance(source, Calibration) else read_calibration(Path(source))


def read_calibration(path: Path) -> Calibration:
    """The parameters of a `calibration.json` (or of the folder that holds one), with covariance and fit.

    Stations, targets and criteria belong to the network of that calibration and are not read back. A file
    without a covariance gets a diagonal one; missing parameters are zero with their prior sigma, as the notes of the
    result report.

    Raises
    ------
    RecordError
        One sentence: key, value, expected value.
    """
    file = path / CalibrationFile.FILE if path.is_dir() else path
    return _calibration(read_result(file, CalibrationFile), file)


def _calibration(content: CalibrationFile, file: Path) -> Calibration:
    rows = content.parameters
    try:
        built = with_parameters(content.construction, [row.name for row in rows])
    except ModelError as problem:
        raise RecordError(str(problem), file=file) from None
    instruments = tuple(dict.fromkeys(row.instrument for row in rows)) or ("",)
    place = {(i, name): k for k, (i, name) in enumerate((i, n) for i in instruments for n in built.names)}
    at = _places(content, place, built.names, file)
    factor = np.array([FACTOR[row.unit] for row in rows])

    def filled(default: Floats, cells: Sequence[float | None]) -> Floats:
        """The default [SI], replaced by the values of the file."""
        merged, given = default.copy(), np.array([np.nan if cell is None else cell for cell in cells]) * factor
        merged[at] = np.where(np.isnan(given), default[at], given)
        return merged

    nominal = np.array([p.prior_sigma for _ in instruments for p in built.parameters])
    values = filled(np.zeros(len(place)), [row.value for row in rows])
    prior = filled(nominal, [row.prior_sigma for row in rows])
    applied = filled(values, [row.applied for row in rows])
    covariance = np.diag(filled(prior, [row.sigma for row in rows]) ** 2)
    if content.covariance:
        covariance[np.ix_(at, at)] = np.array(content.covariance) * np.outer(factor, factor)
    held, prior_rejected = np.zeros((2, len(place)), dtype=bool)
    held[at], prior_rejected[at] = [row.held for row in rows], [row.prior_rejected for row in rows]
    shape = (len(instruments), built.size)
    return Calibration(
        method=content.method,
        construction=built,
        instruments=instruments,
        values=values.reshape(shape),
        prior_sigma=prior.reshape(shape),
        covariance=covariance,
        held=held.reshape(shape),
        prior_rejected=prior_rejected.reshape(shape),
        history_prior=content.history_prior,
        effects=content.effects,
        reflectors=_reflectors(content, file),
        correction=content.correction,
        applied_values=None if np.array_equal(applied, values) else applied.reshape(shape),
        fit=content.fit,
        undetermined=content.undetermined,
        frame=content.frame,
        stations=(),
        recording=content.recording,
        uncertainty_factor=content.uncertainty_factor,
        notes=(
            *_missing([f"{n}@{i}" if i else n for (i, n), k in place.items() if k not in at], file),
            *_rejected(content, file),
        ),
    )


def _reflectors(content: CalibrationFile, file: Path) -> tuple[ReflectorEntry, ...]:
    """The file's reflectors; RecordError where a parameter is none of `smr-incidence` in its unit."""
    expected = {parameter.name: parameter.unit for parameter in SmrIncidence.parameters}
    for entry in content.reflectors:
        for row in entry.parameters:
            if row.name not in expected:
                unknown = unknown_name("parameter of smr-incidence", shown(row.name), tuple(expected))
                raise RecordError(f"reflectors: {unknown}", file=file)
            if row.unit != expected[row.name] or isinstance(row.value, str):
                problem = f"{shown(row.name)} is '{shown(str(row.value))} {shown(row.unit)}'"
                raise RecordError(f"reflectors: {problem}; expected a number in {expected[row.name]}", file=file)
    return content.reflectors


def _places(content: CalibrationFile, place: dict[tuple[str, str], int], names: Sequence[str], file: Path) -> list[int]:
    """Indices of the file's parameters among those of the instruments; their names and units are checked."""
    at: list[int] = []
    for number, row in enumerate(content.parameters, start=1):
        if (row.instrument, row.name) not in place:
            kind = f"parameter of construction {content.construction}"
            raise RecordError(f"parameters: {unknown_name(kind, shown(row.name), names)}", file=file, row=number)
        if row.unit not in FACTOR:
            expected = f"expected one of {', '.join(FACTOR)}"
            raise RecordError(f"parameters: unknown unit '{shown(row.unit)}'; {expected}", file=file, row=number)
        at.append(place[row.instrument, row.name])
        if at[-1] in at[:-1]:
            problem = f"parameters: '{shown(row.name)}' occurs twice; expected one entry per parameter"
            raise RecordError(problem, file=file, row=number)
    return at


def _rejected(content: CalibrationFile, file: Path) -> tuple[str, ...]:
    """Warning about a calibration whose fit was rejected; empty for others."""
    if content.uncertainty_factor == 1.0:
        return ()
    return (
        f"{file}: the readings of this calibration contradict its model (sigma0 = {content.uncertainty_factor:.3g}); "
        "another cause may be in its parameters: run ltsim diagnose on its recording before you use them",
    )


def _missing(names: list[str], file: Path) -> tuple[str, ...]:
    """Warning about parameters that a file lacks; empty where it lacks none."""
    if not names:
        return ()
    which = "one parameter is" if len(names) == 1 else f"{len(names)} parameters are"
    return (f"{file}: {which} not in the file and taken as zero: {listing(names)}",)
