"""Residuals as figures need them: one row an observation, in the unit a person reads, with its covariates."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ltsim.adjust.adjustment import Adjustment
from ltsim.arrays import Bools, Floats, Ints
from ltsim.errors import RecordError
from ltsim.recording.recording import OBSERVABLES
from ltsim.report.style import OBSERVABLE_UNIT
from ltsim.scene.sightings import Sightings
from ltsim.units import DEGREE, FACTOR

Names = NDArray[np.str_]

COVARIATE_UNIT = {"azimuth": "°", "elevation": "°", "distance": "m", "time": "min", "incidence": "°", "row": ""}
COLUMNS = ("row", "station", "target", "observable", "residual", "unit", "redundancy", "w")


@dataclass(frozen=True)
class Residuals:
    """Observed minus adjusted, one row an observation.

    Attributes
    ----------
    row : (n,) int
        Data row of the recording, from 1.
    station, target : (n,) str
    observable : (n,) int
        Index into `OBSERVABLES`.
    residual : (n,) float
        In um for a distance, in arcsec for an angle.
    w : (n,) float
        Normalised residual, standard normal where the model holds.
    redundancy : (n,) float
    covariates : mapping of str to (n,) float
        In the units of `COVARIATE_UNIT`.
    """

    row: Ints
    station: Names
    target: Names
    observable: Ints
    residual: Floats
    w: Floats
    redundancy: Floats
    covariates: Mapping[str, Floats] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.row)

    @property
    def stations(self) -> list[str]:
        """Names of the stations in the order of their appearance."""
        return list(dict.fromkeys(self.station.tolist()))

    def of(self, observable: str) -> Bools:
        """(n,) bool: which rows are of one observable."""
        rows: Bools = self.observable == OBSERVABLES.index(observable)
        return rows

    @classmethod
    def from_adjustment(cls, adjustment: Adjustment) -> Residuals:
        """Residuals of an adjustment with the geometry of its pointings."""
        rows, columns = np.nonzero(np.isfinite(adjustment.w))
        recording = adjustment.recording
        scale = np.array([1.0 / FACTOR[OBSERVABLE_UNIT[name]] for name in OBSERVABLES])
        return cls(
            row=(rows + 1).astype(np.int64),
            station=np.array(recording.stations)[recording.station[rows]],
            target=np.array(recording.targets)[recording.target[rows]],
            observable=columns.astype(np.int64),
            residual=adjustment.residuals[rows, columns] * scale[columns],
            w=adjustment.w[rows, columns],
            redundancy=adjustment.redundancy[rows, columns],
            covariates=_geometry(adjustment.sightings, rows),
        )

    @classmethod
    def read(cls, file: Path) -> Residuals:
        """Residuals from a `residuals.csv`.

        Raises
        ------
        RecordError
            When a column is missing or a field is no number.
        """
        with file.open(newline="", encoding="utf-8") as stream:
            reader = csv.DictReader(stream)
            missing = [name for name in COLUMNS if name not in (reader.fieldnames or ())]
            if missing:
                raise RecordError(f"there is no column {missing[0]}; the header needs {', '.join(COLUMNS)}", file=file)
            rows = list(reader)
        parsed = [_row(record, number, file) for number, record in enumerate(rows, start=1)]
        row, observable, residual, w, redundancy = np.array(parsed, dtype=np.float64).reshape(-1, 5).T
        return cls(
            row=row.astype(np.int64),
            station=np.array([r["station"] for r in rows], dtype=np.str_),
            target=np.array([r["target"] for r in rows], dtype=np.str_),
            observable=observable.astype(np.int64),
            residual=residual,
            w=w,
            redundancy=redundancy,
            covariates={"row": row},
        )

    def with_covariates(self, other: Residuals) -> Residuals:
        """The same residuals with the covariates that `other` knows for the same observations."""
        place = {key: i for i, key in enumerate(zip(other.row.tolist(), other.observable.tolist(), strict=True))}
        at = [place.get(key) for key in zip(self.row.tolist(), self.observable.tolist(), strict=True)]
        found = {
            name: np.array([np.nan if i is None else column[i] for i in at])
            for name, column in other.covariates.items()
        }
        return Residuals(
            self.row, self.station, self.target, self.observable, self.residual, self.w, self.redundancy, found
        )


def _row(record: Mapping[str, str | None], number: int, file: Path) -> tuple[float, ...]:
    """Row, observable, residual [shown unit], w, redundancy of one line."""
    name = record["observable"] or ""
    if name not in OBSERVABLES:
        raise RecordError(f"'{name}' is none of {', '.join(OBSERVABLES)}", file=file, row=number, column="observable")
    unit = record["unit"] or ""
    if unit not in FACTOR:
        raise RecordError(f"the unit '{unit}' is unknown", file=file, row=number, column="unit")
    values = []
    for column in ("row", "residual", "w", "redundancy"):
        try:
            values.append(float(record[column] or "nan"))
        except ValueError as error:
            raise RecordError(f"'{record[column]}' is no number", file=file, row=number, column=column) from error
    row, residual, w, redundancy = values
    shown = residual * FACTOR[unit] / FACTOR[OBSERVABLE_UNIT[name]]
    return row, float(OBSERVABLES.index(name)), shown, w, redundancy


def _geometry(sightings: Sightings, rows: Ints) -> dict[str, Floats]:
    """Covariates of pointings `rows` in the units of `COVARIATE_UNIT`."""
    found = {
        "azimuth": sightings.azimuth[rows] / DEGREE,
        "elevation": sightings.elevation[rows] / DEGREE,
        "distance": sightings.range_[rows],
        "time": sightings.time[rows] / 60.0,
    }
    incidence = sightings.incidence[rows] / DEGREE
    if np.isfinite(incidence).any():
        found["incidence"] = incidence
    further = {name: column[rows] for name, column in sightings.covariates.items()}
    return found | further
