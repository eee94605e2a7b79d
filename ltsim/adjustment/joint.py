"""Joint covariance of adjusted targets, as input of `compare` and `uncertainty`."""

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.core.arrays import Floats
from ltsim.recordings.coordinates import AXIS_NAMES, covariance_text

COVARIANCE_FILE = "targets.covariance.csv"
"""Name of the file with the joint covariance of the coordinates in `targets.csv`."""
MAX_TARGETS_IN_FILE = 400
"""Largest number of targets with a joint covariance in a file. The file grows with the square of the number and has 20
MB at this limit."""


def joint_covariance(adjustment: Adjustment) -> Floats:
    """Joint covariance (3 T, 3 T) [m^2] of the coordinates of T targets, target by target; NaN if undetermined."""
    columns = adjustment.problem.unknowns.target_columns.ravel()
    unit = np.zeros((adjustment.problem.unknowns.n_columns, len(columns)))
    unit[columns, np.arange(len(columns))] = 1.0
    covariance = adjustment.factorised_normals.covariance_columns(unit)[columns]
    if adjustment.datum is not None:
        covariance = adjustment.datum.transform_covariance(covariance[None], columns[None])[0]
    is_undetermined = ~np.isfinite(np.einsum("tii->ti", adjustment.target_covariance)).ravel()
    covariance[is_undetermined] = covariance[:, is_undetermined] = np.nan
    return 0.5 * (covariance + covariance.T)


def covariance_csv(
    adjustment: Adjustment, spread: Floats | None = None, *, factor: float = 1.0, added_covariance: Floats | None = None
) -> str | None:
    """Content of `targets.covariance.csv`; None for more than `MAX_TARGETS_IN_FILE` targets.

    `spread` (k, T, 3) [m] contains the displacements of T targets by one standard deviation of each of k errors that
    the targets share. `factor` multiplies the standard deviations due to the readings. `added_covariance` (3 T, 3 T)
    [m^2] is added.
    """
    names = adjustment.recording.targets
    if len(names) > MAX_TARGETS_IN_FILE:
        return None
    covariance = factor**2 * joint_covariance(adjustment)
    if spread is not None:
        errors = spread.reshape(len(spread), -1)
        covariance = covariance + errors.T @ errors
    if added_covariance is not None:
        covariance = covariance + added_covariance
    is_determined = np.isfinite(np.diag(covariance))
    coordinates = [f"{name}.{axis}" for name in names for axis in AXIS_NAMES]
    rows = np.flatnonzero(is_determined)
    return covariance_text([coordinates[i] for i in rows.tolist()], covariance[np.ix_(rows, rows)])
