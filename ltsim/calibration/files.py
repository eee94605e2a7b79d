"""Files of a calibration: `calibration.json` and its tables, written completely or not at all."""

from pathlib import Path

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.coordinate_uncertainty import (
    COVARIANCE_FILE_NAME,
    MAX_POINTS_IN_COVARIANCE_FILE,
    POINTS_COVARIANCE_FILE_NAME,
    named_covariance_csv_text,
    point_names,
)
from ltsim.calibration.arrays import POINTS_TABLE, arrays_from_file_rows
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.reported_uncertainty import point_covariance
from ltsim.calibration.schema import TARGETS_TABLE
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError, RecordError, unknown_name_error
from ltsim.core.notation import names_text
from ltsim.core.units import MILLIMETRE
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.recordings.files import read_text, safe_excerpt
from ltsim.recordings.result_file import read_result, write_result

CalibrationSource = Calibration | str | Path
"""Calibration, or path of its file or of the folder with this file."""


def write_calibration(calibration: Calibration, folder: Path, *, with_stations: bool = False) -> Calibration:
    """Writing of a calibration and its tables to a folder; returns the calibration with hashes of these files.

    The files are `calibration.json`, `targets.csv`, and for a network the residuals and the covariance. With
    `with_stations`, `points.csv` and `points.covariance.csv` contain the targets and the stations of the network.

    Raises
    ------
    RecordError
        If the folder cannot be written; no partial files remain.
    """
    texts: dict[str, str] = {}
    if with_stations:
        require_writable_covariance(calibration.adjustment)
    if calibration.adjustment is not None:
        covariance = point_covariance(calibration, with_stations=with_stations)
        if covariance is not None:
            points = np.concatenate([calibration.target_points, calibration.adjustment.state.station_positions])
            texts |= covariance_file_texts(calibration.adjustment, points, covariance)
    return write_result(folder, calibration, texts)


def require_writable_covariance(adjustment: Adjustment | None) -> None:
    """Check that targets and stations are few enough for a covariance file; raises ModelError, also without network."""
    if adjustment is None or len(point_names(adjustment, with_stations=True)) > MAX_POINTS_IN_COVARIANCE_FILE:
        raise ModelError(
            "the joint covariance of targets and stations is for the adjustment of a network with at most "
            f"{MAX_POINTS_IN_COVARIANCE_FILE} points"
        )


def covariance_file_texts(adjustment: Adjustment, points: Floats, covariance: Floats) -> dict[str, str]:
    """Contents of `targets.covariance.csv`, `points.csv` and `points.covariance.csv`, by name of the file.

    `points` (T + S, 3) [m] are the coordinates of T targets and S stations. `covariance` [m^2] is the joint covariance
    of all these points, or of the targets alone, (3 T, 3 T): then the result is `targets.covariance.csv` only. The
    variance is NaN for an undetermined coordinate. A point without a determined coordinate has no row in `points.csv`.
    """
    targets = adjustment.recording.targets
    n_target_coordinates = 3 * len(targets)
    target_covariance = covariance[:n_target_coordinates, :n_target_coordinates]
    texts = {COVARIANCE_FILE_NAME: named_covariance_csv_text(targets, target_covariance)}
    if len(covariance) == n_target_coordinates:
        return texts
    names = point_names(adjustment, with_stations=True)
    sigmas = np.sqrt(np.diag(covariance)).reshape(-1, 3)
    numbers = np.concatenate([np.where(np.isfinite(sigmas), points, np.nan), sigmas], axis=1) / MILLIMETRE
    rows = [[name, *row] for name, row in zip(names, numbers.tolist(), strict=True) if np.isfinite(row).any()]
    texts[POINTS_TABLE.file] = POINTS_TABLE.with_rows(rows).csv_text()
    texts[POINTS_COVARIANCE_FILE_NAME] = named_covariance_csv_text(names, covariance)
    return texts


def read_targets(file: Path) -> tuple[tuple[str, ...], Floats, Floats]:
    """Names, coordinates (targets, 3) [m] and standard deviations (targets, 3) [m] of targets from a `targets.csv`.

    Raises
    ------
    RecordError
        When a column is missing or a field is no number.
    """
    table = TARGETS_TABLE.parse_csv(read_text(file), file)
    coordinates_and_sigmas = table.float_array(*TARGETS_TABLE.header[1:]) * MILLIMETRE
    return tuple(table.column("target")), coordinates_and_sigmas[:, :3], coordinates_and_sigmas[:, 3:]


def load_calibration(source: CalibrationSource) -> Calibration:
    """Calibration from an object or a path: the object itself, or the calibration read from the path."""
    return source if isinstance(source, Calibration) else read_calibration(Path(source))


def read_calibration(path: Path) -> Calibration:
    """Calibration read from a `calibration.json`, or from the folder that contains it.

    The targets and the network are not in this file. Without a covariance in the file the parameters count as
    uncorrelated. Missing parameters are zero with the prior standard deviation of the error model, and a warning
    reports them.

    Raises
    ------
    RecordError
        If the file is invalid; the message names the key, its value and the expected value.
    """
    file = path / Calibration.FILE if path.is_dir() else path
    calibration = read_result(file, Calibration)
    _check_reflector_parameters(calibration, file)
    file_values = calibration.parameters, calibration.parameter_covariance
    arrays, missing = arrays_from_file_rows(calibration.construction_name, *file_values, file)
    return calibration.with_arrays(
        arrays, warnings=(*_missing_parameters_warnings(missing, file), *_rejected_fit_warnings(calibration, file))
    )


def _check_reflector_parameters(calibration: Calibration, file: Path) -> None:
    """Check of names and units of reflector parameters against the effect `smr-incidence`; raises RecordError."""
    unit_by_name = {parameter.name: parameter.unit for parameter in SmrIncidence.parameters}
    for entry in calibration.reflectors:
        for row in entry.parameters:
            if row.name not in unit_by_name:
                unknown = unknown_name_error("parameter of smr-incidence", safe_excerpt(row.name), tuple(unit_by_name))
                raise RecordError(f"reflectors: {unknown}", file=file)
            if row.unit != unit_by_name[row.name] or isinstance(row.value, str):
                problem = f"{safe_excerpt(row.name)} is '{safe_excerpt(str(row.value))} {safe_excerpt(row.unit)}'"
                raise RecordError(f"reflectors: {problem}; expected a number in {unit_by_name[row.name]}", file=file)


def _rejected_fit_warnings(content: Calibration, file: Path) -> tuple[str, ...]:
    """Warning that the readings of a calibration contradict its model; empty if they do not contradict it."""
    if content.uncertainty_factor == 1.0:
        return ()
    return (
        f"{file}: the readings of this calibration contradict its model (sigma0 = {content.uncertainty_factor:.3g}); "
        "an unmodelled cause may distort its parameters: run ltsim diagnose on its recording, remove the cause and "
        "calibrate again",
    )


def _missing_parameters_warnings(names: list[str], file: Path) -> tuple[str, ...]:
    """Warning with the names of the parameters that a file lacks; empty for a complete file."""
    if not names:
        return ()
    phrase = "one parameter is" if len(names) == 1 else f"{len(names)} parameters are"
    return (f"{file}: {phrase} not in the file and taken as zero: {names_text(names)}",)
