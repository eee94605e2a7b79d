"""Criteria of what a calibration corrects, beside those of the parameters in `ltsim.planning.objective`."""

import numpy as np

from ltsim.arrays import Floats
from ltsim.planning.information import LayoutInformation


def g_criterion(covariance: Floats, regressors: Floats) -> Floats:
    """Largest standard deviation (...) of a prediction.

    Parameters
    ----------
    covariance : (..., p, p) float
    regressors : (m, p) float
        Each row predicts one quantity from the parameters: for an instrument, the correction of a reading
        somewhere in the working volume, as a displacement [m].
    """
    spread = np.einsum("mi,...ij,mj->...m", regressors, covariance, regressors, optimize=True)
    return np.sqrt(spread.max(axis=-1))


def corrections(information: LayoutInformation) -> Floats:
    """(m, p): displacement [m] that a prior sigma of each parameter makes all over the working volume, front face.

    Ranges of 1 to 8 m, all azimuths, elevations from -50 to 65 deg; three rows a place.
    """
    axes = np.arange(1.0, 8.5, 1.0), np.arange(12) * np.pi / 6, np.radians(np.linspace(-50, 65, 8))
    raw = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
    size = information.construction.size
    _, _, by_value = information.construction.linearised(raw, np.zeros(size))
    return by_value.reshape(-1, size) * information.prior_sigma
