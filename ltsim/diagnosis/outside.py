"""A cause that nobody listed: doubt about the model, as a likelihood that evidence can overcome.

Whatever explains the readings best may be a likeness of something that is in no list. Of such a law nothing is known
but that it resembles the best one up to a share delta: the shift of each reading is off by a random amount of standard
deviation delta times the rms of the shift in its observable, delta log-uniform. Added variance that is not seen in what
is left of the readings speaks against it, by the restricted likelihood that changes of the noise have. A weak effect
leaves no residual to see it by, and the doubt stays what it was before; a strong one that leaves nothing else behind
ends it.
"""

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import Floats
from ltsim.diagnosis.evidence import restricted

SHARES = np.geomspace(0.05, 1.0, 9)
"""Shares of its shift by which a law may be a mere likeness: from what no network of this kind sees to all of it."""


def log_likeness(space: ResidualSpace, shift: Floats, residual: Floats, redundancy: Floats) -> float:
    """Log likelihood ratio of a law that is a mere likeness of one, against that one itself.

    Parameters
    ----------
    shift : (m,) float
        Change of the whitened readings by the law.
    residual, redundancy : (m,) float
        What is left beside the law, whitened, and the share of an error of each reading that it shows.
    """
    kind = np.nonzero(space.use)[1]
    rows = np.flatnonzero(shift[: len(kind)])
    kind, square, share = kind[rows], residual[rows] ** 2, redundancy[rows]
    count = np.maximum(np.bincount(kind, minlength=3), 1)
    size = (np.bincount(kind, shift[rows] ** 2, minlength=3) / count)[kind]
    variance = 1.0 + SHARES[:, None] ** 2 * size
    logs = restricted(square, share, variance).sum(axis=1)
    return float(log_sum_exp(logs) - np.log(len(SHARES)))
