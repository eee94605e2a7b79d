"""Residuals as figures need them: one row an observation, in the unit a person reads, with its covariates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ltsim.adjustment.adjustment import Adjustment
from ltsim.arrays import Bools, Floats, Ints
from ltsim.calibration.schema import RESIDUALS
from ltsim.errors import RecordError
from ltsim.recording.files import shown
from ltsim.recording.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings
from ltsim.units import DEGREE, FACTOR

Names = NDArray[np.str_]

OBSERVABLE_UNIT = {"distance": "um", "azimuth": "arcsec", "elevation": "arcsec"}
USUAL = ("azimuth", "elevation", "distance", "time")
"""Covariates that every recording has."""
COVARIATE_UNIT = {"azimuth": "°", "elevation": "°", "distance": "m", "time": "min", "incidence": "°", "row": ""}


@dataclass(frozen=True)
class Residuals:
    """Observed minus adjusted, one row an observation."""

    row: Ints
    """(n,): data row of the recording, from 1."""
    station: Names
    target: Names
    """(n,) each."""
    observable: Ints
    """(n,): index into `OBSERVABLES`."""
    residual: Floats
    """(n,): in um for a distance, in arcsec for an angle."""
    w: Floats
    """(n,): normalised residual, standard normal where the model holds."""
    redundancy: Floats
    """(n,)."""
    covariates: Mapping[str, Floats] = field(default_factory=dict)
    """(n,): in the units of `COVARIATE_UNIT`."""

    def __len__(self) -> int:
        return len(self.row)

    @property
    def stations(self) -> list[str]:
        """Names of the stations in the order of their appearance."""
        return list(dict.fromkeys(self.station.tolist()))

    def of(self, observable: str) -> Bools:
        """(n,) bool: which rows are of one observable."""
        return self.observable == OBSERVABLES.index(observable)

    def at(self, stations: Sequence[str], targets: Sequence[str]) -> Bools:
        """(n,): which rows are at the named stations and targets; all where none is named."""
        inside = np.ones(len(self), dtype=np.bool_)
        for names, column in ((stations, self.station), (targets, self.target)):
            if names:
                inside &= np.isin(column, list(names))
        return inside

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
        """Residuals from a `residuals.csv`; raises RecordError when a column is missing or a field is no number."""
        names, values = RESIDUALS.read(file)
        for column, known in (("observable", OBSERVABLES), ("unit", FACTOR)):
            wrong = next((i for i, name in enumerate(names[column]) if name not in known), None)
            if wrong is not None:
                message = f"'{shown(names[column][wrong])}' is none of {', '.join(known)}"
                raise RecordError(message, file=file, row=wrong + 1, column=column)
        scale = [
            FACTOR[u] / FACTOR[OBSERVABLE_UNIT[o]] for o, u in zip(names["observable"], names["unit"], strict=True)
        ]
        return cls(
            row=values["row"].astype(np.int64),
            station=np.array(names["station"], dtype=np.str_),
            target=np.array(names["target"], dtype=np.str_),
            observable=np.array([OBSERVABLES.index(name) for name in names["observable"]], dtype=np.int64),
            residual=values["residual"] * np.array(scale),
            w=values["w"],
            redundancy=values["redundancy"],
            covariates={"row": values["row"]},
        )

    def with_covariates(self, other: Residuals | None) -> Residuals:
        """The same residuals with the covariates that `other`, if there is one, knows for the same observations."""
        if other is None:
            return self
        place = {key: i for i, key in enumerate(zip(other.row.tolist(), other.observable.tolist(), strict=True))}
        at = [place.get(key) for key in zip(self.row.tolist(), self.observable.tolist(), strict=True)]
        found = {
            name: np.array([np.nan if i is None else column[i] for i in at])
            for name, column in other.covariates.items()
        }
        return Residuals(
            self.row, self.station, self.target, self.observable, self.residual, self.w, self.redundancy, found
        )


def _geometry(sightings: Sightings, rows: Ints) -> dict[str, Floats]:
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
