"""Coordinates of points at one epoch with their joint covariance."""

from dataclasses import dataclass, replace

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.recordings.files import safe_excerpt

AXIS_NAMES = "xyz"
"""Names of the three axes."""
MAX_NAMES_IN_NOTE = 6
"""Largest number of names of points in a note."""


@dataclass(frozen=True)
class EpochCoordinates:
    """Coordinates of T points at one epoch, along the d axes that were measured, with one covariance matrix of all."""

    title: str
    names: tuple[str, ...]
    """Names of the T points."""
    axes: str
    """Measured axes, as letters among `xyz`, such as `xy`."""
    points: Floats
    """Coordinates (T, 3) [m] of the T points; 0 along axes that were not measured."""
    covariance: Floats
    """Joint covariance matrix (T d, T d) [m^2] of T points along d axes; rows are sorted by point, then by axis. NaN
    for coordinates without standard deviations."""
    notes: tuple[str, ...] = ()

    @property
    def has_covariance(self) -> bool:
        """True if the coordinates have standard deviations."""
        return bool(np.isfinite(np.diag(self.covariance)).all())

    @property
    def axis_indices(self) -> Ints:
        """Indices (d,) of the d measured axes: 0 for x, 1 for y, 2 for z."""
        return np.array([AXIS_NAMES.index(axis) for axis in self.axes])


def without_fixed_points(epoch: EpochCoordinates) -> EpochCoordinates:
    """Epoch without the points whose coordinates all have the variance 0, and a note on them.

    The epoch is unchanged if no point has another variance.
    """
    variances = np.diag(epoch.covariance).reshape(len(epoch.names), -1)
    is_fixed = (variances == 0.0).all(axis=1)
    if not is_fixed.any() or is_fixed.all():
        return epoch
    variable_points = np.flatnonzero(~is_fixed).tolist()
    rows = np.flatnonzero(np.repeat(~is_fixed, variances.shape[1]))
    fixed_names = ", ".join(safe_excerpt(epoch.names[i]) for i in np.flatnonzero(is_fixed).tolist()[:MAX_NAMES_IN_NOTE])
    note = f"points that define the frame, with the variance 0, are not used: {fixed_names}"
    return replace(
        epoch,
        names=tuple(epoch.names[i] for i in variable_points),
        points=epoch.points[variable_points],
        covariance=epoch.covariance[np.ix_(rows, rows)],
        notes=(*epoch.notes, note),
    )
