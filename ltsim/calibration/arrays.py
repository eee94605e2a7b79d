"""Arrays of a calibration in SI units, their construction from a file, and tables of targets and residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.coordinate_uncertainty import COVARIANCE_FILE_NAME, POINTS_COVARIANCE_FILE_NAME
from ltsim.adjustment.prior import WIDENED_PRIOR_SIGMA_FACTOR
from ltsim.calibration.schema import (
    COORDINATE_COLUMNS,
    OBSERVABLE_DISPLAY_UNITS,
    RESIDUALS_TABLE,
    TARGETS_TABLE,
    ParameterEntry,
)
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.equality import ValueEquality
from ltsim.core.errors import ModelError, RecordError, unknown_name_error
from ltsim.core.results import Table
from ltsim.core.units import MILLIMETRE, SI_PER_UNIT, permitted_units_text
from ltsim.physics.model.construction import GeometricErrorModel, construction_for_parameters
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.recording import OBSERVABLES

POINTS_TABLE = Table(
    "points.csv", "adjusted targets and stations; undetermined ones have no row or no height", COORDINATE_COLUMNS
)
"""Table of the adjusted targets and stations."""
NETWORK_FILE_NAMES = (COVARIANCE_FILE_NAME, POINTS_TABLE.file, POINTS_COVARIANCE_FILE_NAME)
"""Names of the files with the joint covariance of an adjusted network, and with its targets and stations."""


@dataclass(frozen=True)
class CalibrationArrays(ValueEquality):
    """Arrays of a calibration in SI units: parameters of each instrument, and coordinates of the targets."""

    construction: GeometricErrorModel
    """Geometric error model whose parameters were estimated."""
    instruments: tuple[str, ...]
    """Names of the instruments; a single unnamed instrument is called ''."""
    estimates: Floats
    """Estimates of the parameters of each instrument, shape (instruments, parameters) [SI]."""
    prior_sigma: Floats
    """Prior standard deviations of the parameters of each instrument, shape (instruments, parameters) [SI]."""
    covariance: Floats
    """Covariance of the parameters of all instruments, instrument by instrument, shape (parameters, parameters)
    [SI]. Rows and columns of fixed parameters are zero."""
    is_fixed: Bools = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    """Mask (instruments, parameters) of the parameters that were fixed at a value instead of being estimated."""
    is_prior_rejected: Bools = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    """Mask (instruments, parameters) of the parameters that were estimated without their prior, because the readings
    contradict it."""
    applied_values: Floats | None = None
    """Parameters that a correction removes from readings, shape (instruments, parameters) [SI]. None means the
    estimates."""
    null_space: Floats | None = field(default=None, repr=False)
    """Orthonormal combinations of parameters that distances between targets do not determine and that are set to zero.

    The shape is (combinations, instruments times parameters); the unit is the prior standard deviation.
    """
    target_names: tuple[str, ...] = ()
    """Names of the adjusted targets."""
    target_points: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """Coordinates of the targets, shape (targets, 3) [m]."""
    target_covariances: Floats = field(default_factory=lambda: np.zeros((0, 3, 3)))
    """Covariance of the coordinates of each target, shape (targets, 3, 3) [m^2]."""
    adjustment: Adjustment | None = field(default=None, repr=False, compare=False)
    """Adjusted network; None for a calibration that was read from a file."""

    def __post_init__(self) -> None:
        for name in ("is_fixed", "is_prior_rejected"):
            if getattr(self, name).shape != self.estimates.shape:
                object.__setattr__(self, name, np.zeros(self.estimates.shape, dtype=bool))

    @cached_property
    def sigma(self) -> Floats:
        """Standard deviations of the estimates, shape (instruments, parameters) [SI]."""
        return np.sqrt(np.diag(self.covariance)).reshape(self.estimates.shape)

    @property
    def effective_prior_sigma(self) -> Floats:
        """Standard deviations of the prior as used in the estimation, shape (instruments, parameters) [SI].

        A prior that the readings contradict is wider by the factor `WIDENED_PRIOR_SIGMA_FACTOR`.
        """
        return np.where(self.is_prior_rejected, WIDENED_PRIOR_SIGMA_FACTOR, 1.0) * self.prior_sigma

    @property
    def negative_bias_operator(self) -> Floats:
        """Matrix B of the bias by the prior: for true parameters x the expected error of the estimates is -B x.

        The shape is (parameters, parameters), for the parameters of all instruments in prior standard deviations.
        """
        if self.null_space is not None:
            return self.null_space.T @ self.null_space
        unit = self.prior_sigma.ravel()
        return self.covariance / np.outer(unit, unit)

    def for_instrument(self, instrument: int, parameter_indices: Ints) -> CalibrationArrays:
        """Arrays of the instrument with index `instrument`, reduced to the parameters `parameter_indices`."""
        row, at = slice(instrument, instrument + 1), instrument * self.construction.n_parameters + parameter_indices
        return replace(
            self,
            construction=self.construction.with_parameter_subset(parameter_indices),
            instruments=self.instruments[row],
            estimates=self.estimates[row, parameter_indices],
            prior_sigma=self.prior_sigma[row, parameter_indices],
            covariance=self.covariance[np.ix_(at, at)],
            is_fixed=self.is_fixed[row, parameter_indices],
            is_prior_rejected=self.is_prior_rejected[row, parameter_indices],
        )


def arrays_from_file_rows(
    construction_name: str,
    parameter_entries: Sequence[ParameterEntry],
    covariance: Sequence[Sequence[float]],
    file_path: object,
) -> tuple[CalibrationArrays, list[str]]:
    """Arrays of the parameters in a calibration file, and the names of the parameters that the file lacks.

    Without a covariance in the file the parameters count as uncorrelated. Missing parameters are zero with the prior
    standard deviation of the geometric error model.

    Raises
    ------
    RecordError
        If the file is invalid; the message names the key, its value and the expected value.
    """
    try:
        built = construction_for_parameters(construction_name, [row.name for row in parameter_entries])
    except ModelError as problem:
        raise RecordError(str(problem), file=file_path) from None
    instruments = tuple(dict.fromkeys(row.instrument for row in parameter_entries)) or ("",)
    place = {(i, name): k for k, (i, name) in enumerate((i, n) for i in instruments for n in built.parameter_names)}
    flat_indices = _parameter_vector_indices(
        construction_name, parameter_entries, place, built.parameter_names, file_path
    )
    factor = np.array([SI_PER_UNIT[row.unit] for row in parameter_entries])

    def with_file_values(default_values: Floats, file_values: Sequence[float | None]) -> Floats:
        """Parameters [SI] of all instruments: the values of the file, and the defaults where the file has none."""
        prior_covariance, given = (
            default_values.copy(),
            np.array([np.nan if cell is None else cell for cell in file_values]) * factor,
        )
        prior_covariance[flat_indices] = np.where(np.isnan(given), default_values[flat_indices], given)
        return prior_covariance

    nominal_sigmas = np.array([p.prior_sigma for _ in instruments for p in built.parameters])
    values = with_file_values(np.zeros(len(place)), [row.value for row in parameter_entries])
    prior = with_file_values(nominal_sigmas, [row.prior_sigma for row in parameter_entries])
    applied_values = with_file_values(values, [row.applied_value for row in parameter_entries])
    prior_covariance = np.diag(with_file_values(prior, [row.sigma for row in parameter_entries]) ** 2)
    if len(covariance):
        prior_covariance[np.ix_(flat_indices, flat_indices)] = np.array(covariance) * np.outer(factor, factor)
    held, prior_rejected = np.zeros((2, len(place)), dtype=bool)
    held[flat_indices], prior_rejected[flat_indices] = (
        [row.held for row in parameter_entries],
        [row.prior_rejected for row in parameter_entries],
    )
    shape = (len(instruments), built.n_parameters)
    arrays = CalibrationArrays(
        construction=built,
        instruments=instruments,
        estimates=values.reshape(shape),
        prior_sigma=prior.reshape(shape),
        covariance=prior_covariance,
        is_fixed=held.reshape(shape),
        is_prior_rejected=prior_rejected.reshape(shape),
        applied_values=None if np.array_equal(applied_values, values) else applied_values.reshape(shape),
    )
    return arrays, [f"{n}@{i}" if i else n for (i, n), k in place.items() if k not in flat_indices]


def _parameter_vector_indices(
    construction: str,
    parameter_entries: Sequence[ParameterEntry],
    index_by_instrument_and_name: dict[tuple[str, str], int],
    names: Sequence[str],
    file: object,
) -> list[int]:
    """Indices of a file's parameters in the vector of the parameters of all instruments.

    `construction` is the name of the geometric error model, `index_by_instrument_and_name` gives the index in the
    vector.

    Raises RecordError for unknown names, unknown units and repeated parameters.
    """
    flat_indices: list[int] = []
    for number, row in enumerate(parameter_entries, start=1):
        if (row.instrument, row.name) not in index_by_instrument_and_name:
            kind = f"parameter of construction {construction}"
            raise RecordError(
                f"parameters: {unknown_name_error(kind, safe_excerpt(row.name), names)}", file=file, row=number
            )
        if row.unit not in SI_PER_UNIT:
            expected = f"expected one of {permitted_units_text()}"
            raise RecordError(f"parameters: unknown unit '{safe_excerpt(row.unit)}'; {expected}", file=file, row=number)
        flat_indices.append(index_by_instrument_and_name[row.instrument, row.name])
        if flat_indices[-1] in flat_indices[:-1]:
            problem = f"parameters: '{safe_excerpt(row.name)}' occurs twice; expected one entry per parameter"
            raise RecordError(problem, file=file, row=number)
    return flat_indices


def targets_table(names: Sequence[str], points: Floats, covariance: Floats) -> Table:
    """Table of the coordinates of targets with standard deviations.

    `points` (targets, 3) [m] are the coordinates, `covariance` (targets, 3, 3) [m^2] is the covariance of each target.
    A target without determined coordinates has no row; a target without a determined height has an empty cell.
    """
    sigma = np.sqrt(np.einsum("tii->ti", covariance)) / MILLIMETRE
    cells = np.concatenate([np.where(np.isfinite(sigma), points / MILLIMETRE, np.nan), sigma], axis=1)
    placed_indices = np.flatnonzero(np.isfinite(sigma[:, :2]).all(axis=1)).tolist()
    return TARGETS_TABLE.with_rows([names[i], *cells[i].tolist()] for i in placed_indices)


def residuals_table(adjustment: Adjustment) -> Table:
    """Table of residuals with one row for each observation in use; the row numbers of the recording start at 1."""
    recording = adjustment.recording

    def table_row(pointing_index: int, observable_index: int) -> list[object]:
        unit, factor = OBSERVABLE_DISPLAY_UNITS[observable_index]
        names = (
            recording.stations[recording.station[pointing_index]],
            recording.targets[recording.target[pointing_index]],
        )
        residual_entries = (
            adjustment.residuals[pointing_index, observable_index] / factor,
            unit,
            adjustment.redundancy[pointing_index, observable_index],
            adjustment.normalised_residuals[pointing_index, observable_index],
        )
        return [
            pointing_index + 1,
            *names,
            recording.face[pointing_index],
            recording.repeat[pointing_index],
            OBSERVABLES[observable_index],
            *residual_entries,
        ]

    return RESIDUALS_TABLE.with_rows(
        table_row(i, k) for i, k in np.argwhere(adjustment.problem.is_used_reading).tolist()
    )
