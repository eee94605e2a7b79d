"""Residuals for figures, one row per reading, in display units, with the covariates of the readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ltsim.adjustment.adjustment import Adjustment
from ltsim.calibration.schema import RESIDUALS_TABLE
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import RecordError
from ltsim.core.results import Table
from ltsim.core.units import DEGREE, SI_PER_UNIT
from ltsim.recordings.files import read_text, safe_excerpt
from ltsim.recordings.recording import OBSERVABLES

NameArray = NDArray[np.str_]
"""Array of names (of stations or targets)."""

OBSERVABLE_UNITS = {"distance": "um", "azimuth": "arcsec", "elevation": "arcsec"}
"""Display unit of the residuals of each observable."""
DEFAULT_COVARIATES = ("azimuth", "elevation", "distance", "time", "row")
"""Covariates in figures of residuals, as far as the residuals have them; `time` needs a recording with a clock."""
COVARIATE_UNITS = {"azimuth": "°", "elevation": "°", "distance": "m", "time": "min", "incidence": "°", "row": ""}
"""Display unit of each covariate in figures of residuals."""


@dataclass(frozen=True)
class Residuals:
    """Residuals (observed minus adjusted reading) of n readings, with station, target and covariates of each."""

    data_row_numbers: Ints
    """Number (n,), from 1, of the row of each of n readings in the table of the recording."""
    station_names: NameArray
    """Names (n,) of the stations of n readings."""
    target_names: NameArray
    """Names (n,) of the targets of n readings."""
    observable_indices: Ints
    """Index (n,) into `OBSERVABLES` of the observable of each of n readings."""
    displayed_residual: Floats
    """Residuals (n,) of n readings, in um for a distance and in arcsec for an angle."""
    normalised_residual: Floats
    """Residuals (n,) of n readings divided by their standard deviations; standard normal if the model is correct."""
    redundancy: Floats
    """Redundancy number (n,) of each of n readings, from 0 (not checked by other readings) to 1."""
    covariates: Mapping[str, Floats] = field(default_factory=dict)
    """Covariates (n,) of n readings by name, in the units of `COVARIATE_UNITS`."""

    def __len__(self) -> int:
        return len(self.data_row_numbers)

    @property
    def stations(self) -> list[str]:
        """Names of the stations in the order of their appearance."""
        return list(dict.fromkeys(self.station_names.tolist()))

    def observable_mask(self, observable: str) -> Bools:
        """Mask (n,) of n readings, True for those of the observable with this name."""
        return self.observable_indices == OBSERVABLES.index(observable)

    @property
    def measurement_order_covariate(self) -> str:
        """Covariate of the order of measurement: the time, or the row if the recording has no clock."""
        return "time" if "time" in self.covariates or "azimuth" not in self.covariates else "row"

    @property
    def sigma(self) -> Floats:
        """Standard deviations (n,) of n readings, computed from residual, normalised residual and redundancy."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.abs(self.displayed_residual / self.normalised_residual) / np.sqrt(self.redundancy))

    def station_and_target_mask(self, stations: Sequence[str], targets: Sequence[str]) -> Bools:
        """Mask (n,) of n readings, True for those from the given stations to the given targets.

        An empty sequence means all stations or all targets.
        """
        mask = np.ones(len(self), dtype=np.bool_)
        for names, column in ((stations, self.station_names), (targets, self.target_names)):
            if names:
                mask &= np.isin(column, list(names))
        return mask

    @classmethod
    def from_table(cls, table: Table, file: Path | None = None) -> Residuals:
        """Residuals of a table `RESIDUALS_TABLE`; raises RecordError for an invalid observable or unit.

        `file` is the path of the table, for messages.
        """
        for column, allowed in (("observable", OBSERVABLES), ("unit", SI_PER_UNIT)):
            wrong_row = next((i for i, name in enumerate(table.column(column)) if name not in allowed), None)
            if wrong_row is not None:
                message = f"'{safe_excerpt(table.column(column)[wrong_row])}' is not one of {', '.join(allowed)}"
                raise RecordError(message, file=file, row=wrong_row + 1, column=column)
        names, units = table.column("observable"), table.column("unit")
        unit_factors = np.array(
            [SI_PER_UNIT[u] / SI_PER_UNIT[OBSERVABLE_UNITS[o]] for o, u in zip(names, units, strict=True)]
        )
        row, residual, redundancy, w = table.float_array("row", "residual", "redundancy", "w").T
        return cls(
            data_row_numbers=row.astype(np.int64),
            station_names=np.array(table.column("station"), dtype=np.str_),
            target_names=np.array(table.column("target"), dtype=np.str_),
            observable_indices=np.array([OBSERVABLES.index(name) for name in names], dtype=np.int64),
            displayed_residual=residual * unit_factors,
            normalised_residual=w,
            redundancy=redundancy,
            covariates={"row": row},
        )

    @classmethod
    def from_adjustment(cls, adjustment: Adjustment) -> Residuals:
        """Residuals of the used readings of an adjustment, with the geometry of the pointings as covariates."""
        recording, is_used = adjustment.recording, adjustment.problem.is_used_reading
        rows, observable = np.nonzero(is_used)
        unit = np.array([SI_PER_UNIT[OBSERVABLE_UNITS[name]] for name in OBSERVABLES])
        return cls(
            data_row_numbers=rows + 1,
            station_names=np.array(recording.stations, dtype=np.str_)[recording.station[rows]],
            target_names=np.array(recording.targets, dtype=np.str_)[recording.target[rows]],
            observable_indices=observable,
            displayed_residual=(adjustment.residuals / unit)[is_used],
            normalised_residual=adjustment.normalised_residuals[is_used],
            redundancy=adjustment.redundancy[is_used],
            covariates=_geometric_covariates(adjustment, rows),
        )

    @classmethod
    def read(cls, file: Path) -> Residuals:
        """Residuals from a `residuals.csv`; raises RecordError if a column is missing or a field is not a number."""
        return cls.from_table(RESIDUALS_TABLE.parse_csv(read_text(file), file), file)

    def with_covariates(self, source: Residuals | None) -> Residuals:
        """Residuals with the covariates of the same readings in `source`; unchanged if `source` is None."""
        if source is None:
            return self
        source_rows = self._row_indices_in(source)
        covariates = {name: np.append(column, np.nan)[source_rows] for name, column in source.covariates.items()}
        return replace(self, covariates=covariates)

    def normalised_by_noise_of(self, reference: Residuals) -> Residuals:
        """Copy of the residuals, divided by the standard deviations that the same readings have in `reference`."""
        sigma = np.append(reference.sigma, np.nan)[self._row_indices_in(reference)]
        with np.errstate(divide="ignore", invalid="ignore"):
            return replace(self, normalised_residual=self.displayed_residual / (sigma * np.sqrt(self.redundancy)))

    def _row_indices_in(self, reference: Residuals) -> Ints:
        """Index (n,) in `reference` of each of n readings (same data row and observable); -1 for a missing reading."""
        row_by_key = {
            key: i
            for i, key in enumerate(
                zip(reference.data_row_numbers.tolist(), reference.observable_indices.tolist(), strict=True)
            )
        }
        keys = zip(self.data_row_numbers.tolist(), self.observable_indices.tolist(), strict=True)
        return np.array([row_by_key.get(key, -1) for key in keys], dtype=np.int64)


def _geometric_covariates(adjustment: Adjustment, rows: Ints) -> dict[str, Floats]:
    """Covariates (n,) by name, of n readings in the pointings `rows` (n,), in the units of `COVARIATE_UNITS`."""
    sightings, has_clock = adjustment.sightings, adjustment.recording.has_clock
    covariates = {
        "azimuth": sightings.azimuth[rows] / DEGREE,
        "elevation": sightings.elevation[rows] / DEGREE,
        "distance": sightings.range_[rows],
    }
    incidence = sightings.incidence_angle[rows] / DEGREE
    if np.isfinite(incidence).any():
        covariates["incidence"] = incidence
    other_covariates = {name: column[rows] for name, column in sightings.covariates.items()}
    measurement_order_covariate: dict[str, Floats] = (
        {"time": sightings.time[rows] / 60.0} if has_clock else {"row": (rows + 1).astype(np.float64)}
    )
    return covariates | measurement_order_covariate | other_covariates
