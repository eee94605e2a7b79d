"""calibration.json, targets.csv and residuals.csv: written whole or not at all, and read back."""

from __future__ import annotations

import csv
import difflib
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, NonNegativeFloat, PositiveFloat, ValidationError

from ltsim.adjust.adjustment import Adjustment
from ltsim.arrays import Floats
from ltsim.calibrate.amplitude import harmonics
from ltsim.calibrate.calibration import Calibration, Combination, Fit, StationPose
from ltsim.calibrate.result import SHOWN_UNITS, named
from ltsim.errors import ModelError, RecordError
from ltsim.model.construction import Construction, construction
from ltsim.recording.files import read_text, shown, write_texts
from ltsim.recording.recording import OBSERVABLES
from ltsim.units import ARCSECOND, DEGREE, FACTOR, MILLIMETRE

FORMAT = "ltsim-calibration/1"
JSON, TARGETS, RESIDUALS = "calibration.json", "targets.csv", "residuals.csv"


def write_calibration(calibration: Calibration, folder: Path) -> None:
    """Write `calibration.json`, `targets.csv` and, where the network is at hand, `residuals.csv` into a folder.

    Raises
    ------
    RecordError
        When the folder cannot be written; nothing half-written stays behind.
    """
    text = json.dumps(calibration_json(calibration), indent=1, allow_nan=False) + "\n"
    table = targets_csv(calibration.targets, calibration.points, calibration.target_covariance)
    texts = {JSON: text, TARGETS: table}
    if calibration.adjustment is not None:
        texts[RESIDUALS] = residuals_csv(calibration.adjustment)
    write_texts(folder, texts)


def calibration_json(calibration: Calibration) -> dict[str, Any]:
    """The content of `calibration.json`; the covariance is in the units of the parameters."""
    fit = calibration.fit
    factors = _factors(calibration)
    entry: dict[str, Any] = {
        "format": FORMAT,
        "method": calibration.method,
        "construction": calibration.construction.name,
        "fit": {
            "chi2": fit.chi2,
            "dof": fit.dof,
            "sigma0": fit.sigma0,
            "p_value": fit.p_value,
            "iterations": fit.iterations,
            "status": fit.status,
            "sentence": fit.sentence,
        },
        "frame": calibration.frame,
        "parameters": _parameters(calibration),
        "covariance": (calibration.covariance / np.outer(factors, factors)).tolist(),
        "harmonics": _harmonics(calibration),
        "undetermined": [
            {"combination": dict(c.coefficients), "gain": c.gain, "cure": c.cure} for c in calibration.undetermined
        ],
        "stations": [_station(station) for station in calibration.stations],
        "criteria": calibration.criteria.as_json() if calibration.criteria else {},
        "outliers": [vars(outlier) for outlier in calibration.outliers],
    }
    return entry | _treatment(calibration)


def _treatment(calibration: Calibration) -> dict[str, Any]:
    """What was done to the readings and which test to trust; a factor that could not be estimated has no sigma."""
    judged = calibration.verdict
    noise = [vars(n) | {"factor_sigma": n.factor_sigma if np.isfinite(n.factor_sigma) else None}
             for n in calibration.noise]  # fmt: skip
    said: dict[str, Any] = {}
    if judged is not None:
        said = {"case": judged.case.value, "sentence": judged.sentence, "scale_by_sigma0": judged.by_estimate}
    return {
        "robust": calibration.robust,
        "noise": noise,
        "noise_estimated": calibration.noise_estimated,
        "verdict": said,
        "lost_targets": list(calibration.lost_targets),
    }


def _factors(calibration: Calibration) -> Floats:
    own = [p.factor for p in calibration.construction.parameters]
    return np.tile(np.array(own, dtype=np.float64), len(calibration.instruments))


def _parameters(calibration: Calibration) -> list[dict[str, Any]]:
    several = len(calibration.instruments) > 1
    rows = []
    for i, instrument in enumerate(calibration.instruments):
        for k, parameter in enumerate(calibration.construction.parameters):
            row = {
                "name": parameter.name,
                "value": float(calibration.values[i, k] / parameter.factor),
                "sigma": float(calibration.sigma[i, k] / parameter.factor),
                "unit": parameter.unit,
                "prior_sigma": float(calibration.prior_sigma[i, k] / parameter.factor),
            }
            rows.append(row | ({"instrument": instrument} if several else {}))
    return rows


def _harmonics(calibration: Calibration) -> list[dict[str, Any]]:
    rows = []
    for harmonic in harmonics(calibration):
        factor = harmonic.parameter.factor
        phase, spread = harmonic.phase, harmonic.phase_sigma
        row: dict[str, Any] = {
            "name": harmonic.name,
            "amplitude": harmonic.amplitude / factor,
            "sigma": harmonic.sigma / factor,
            "unit": harmonic.parameter.unit,
            "phase_deg": None if phase is None else phase / DEGREE,
            "sigma_phase_deg": None if spread is None else spread / DEGREE,
        }
        rows.append(row | ({"instrument": harmonic.instrument} if harmonic.instrument else {}))
    return rows


def _station(station: StationPose) -> dict[str, Any]:
    return {
        "name": station.name,
        "position_mm": (station.position / MILLIMETRE).tolist(),
        "rotation_quaternion": station.quaternion.tolist(),
        "sigma_position_mm": (station.sigma_position / MILLIMETRE).tolist(),
        "sigma_rotation_arcsec": (station.sigma_rotation / ARCSECOND).tolist(),
    }


def targets_csv(names: Sequence[str], points: Floats, covariance: Floats) -> str:
    """The content of `targets.csv` for points (T, 3) [m] with covariance (T, 3, 3) [m^2]; NaN ones have no row."""
    sigma = np.sqrt(np.einsum("tii->ti", covariance)) / MILLIMETRE
    rows = [
        [name, *_digits(point / MILLIMETRE), *_digits(spread)]
        for name, point, spread in zip(names, points, sigma, strict=True)
        if np.isfinite(spread).all()
    ]
    header = "target,x_mm,y_mm,z_mm,sigma_x_mm,sigma_y_mm,sigma_z_mm"
    return _csv(header, rows)


def residuals_csv(adjustment: Adjustment) -> str:
    """The content of `residuals.csv`: one row an observation that was used, rows counted from 1."""
    recording = adjustment.recording
    rows = []
    for i, k in np.argwhere(adjustment.problem.use):
        unit, factor = SHOWN_UNITS[k]
        rows.append(
            [
                str(i + 1),
                recording.stations[recording.station[i]],
                recording.targets[recording.target[i]],
                str(recording.face[i]),
                str(recording.repeat[i]),
                OBSERVABLES[k],
                f"{adjustment.residuals[i, k] / factor:.6g}",
                unit,
                f"{adjustment.redundancy[i, k]:.4f}",
                f"{adjustment.w[i, k]:.4f}",
            ]
        )
    return _csv("row,station,target,face,repeat,observable,residual,unit,redundancy,w", rows)


def _digits(values: Floats) -> list[str]:
    return [f"{value:.6f}" for value in values]


def _csv(header: str, rows: list[list[str]]) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header.split(","))
    writer.writerows(rows)
    return stream.getvalue()


class _Table(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class _ParameterRow(_Table):
    name: str
    value: FiniteFloat
    sigma: NonNegativeFloat | None = None
    unit: str
    prior_sigma: PositiveFloat | None = None
    instrument: str = ""


class _FitRow(_Table):
    chi2: FiniteFloat = 0.0
    dof: int = 0
    sigma0: FiniteFloat | None = None
    p_value: FiniteFloat | None = None
    iterations: int = 0
    status: str = ""
    sentence: str = ""


class _CombinationRow(_Table):
    combination: dict[str, FiniteFloat]
    gain: FiniteFloat
    cure: str = ""


class _File(_Table):
    """What a program needs of the file; the rest is for the reader."""

    format: str
    method: str = "network"
    construction: str
    fit: _FitRow = _FitRow(status="not stated")
    frame: str = ""
    parameters: tuple[_ParameterRow, ...]
    covariance: tuple[tuple[FiniteFloat, ...], ...] = Field(default=())
    undetermined: tuple[_CombinationRow, ...] = ()


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
    file = path / JSON if path.is_dir() else path
    try:
        content = _File.model_validate(json.loads(read_text(file)))
    except (json.JSONDecodeError, RecursionError):
        raise RecordError("is not JSON; expected a calibration.json", file=file) from None
    except ValidationError as problem:
        error = problem.errors()[0]
        key = ".".join(str(part) for part in error["loc"]) or "the file"
        raise RecordError(f"{shown(key)}: {shown(error['msg'], 120)}", file=file) from None
    if content.format != FORMAT:
        raise RecordError(f"format is '{shown(content.format)}', expected '{FORMAT}'", file=file)
    return _calibration(content, file)


def _calibration(content: _File, file: Path) -> Calibration:
    built = _construction(content.construction, file)
    instruments = tuple(dict.fromkeys(row.instrument for row in content.parameters)) or ("",)
    place = {(i, name): k for k, (i, name) in enumerate((i, n) for i in instruments for n in built.names)}
    prior = np.array([p.prior_sigma for _ in instruments for p in built.parameters])
    values, sigma, factor = np.zeros(len(place)), prior.copy(), np.ones(len(place))
    at = [_place(row, place, built, number, file) for number, row in enumerate(content.parameters, start=1)]
    for number, (k, row) in enumerate(zip(at, content.parameters, strict=True), start=1):
        if at.index(k) != number - 1:
            raise RecordError(f"parameters: '{shown(row.name)}' stands there twice", file=file, row=number)
        factor[k] = FACTOR[row.unit]
        values[k] = row.value * factor[k]
        prior[k] = prior[k] if row.prior_sigma is None else row.prior_sigma * factor[k]
        sigma[k] = prior[k] if row.sigma is None else row.sigma * factor[k]
    covariance = np.diag(sigma**2)
    if content.covariance:
        given = _square(content.covariance, len(at), file)
        covariance[np.ix_(at, at)] = given * np.outer(factor[at], factor[at])
    shape = (len(instruments), built.size)
    return Calibration(
        method=content.method,
        construction=built,
        instruments=instruments,
        values=values.reshape(shape),
        prior_sigma=prior.reshape(shape),
        covariance=covariance,
        fit=Fit(**content.fit.model_dump()),
        undetermined=tuple(Combination(c.combination, c.gain, c.cure) for c in content.undetermined),
        frame=content.frame,
        stations=(),
        notes=_missing([f"{n}@{i}" if i else n for (i, n), k in place.items() if k not in at], file),
    )


def _place(row: _ParameterRow, place: dict[tuple[str, str], int], built: Construction, number: int, file: Path) -> int:
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


def _construction(name: str, file: Path) -> Construction:
    try:
        return construction(name)
    except ModelError as problem:
        raise RecordError(str(problem), file=file) from None


def _square(rows: tuple[tuple[float, ...], ...], count: int, file: Path) -> Floats:
    if len(rows) != count or any(len(row) != count for row in rows):
        raise RecordError(f"the covariance is not a square of {count} x {count} numbers", file=file)
    return np.array(rows, dtype=np.float64)
