"""Which errors drive the improvement by calibration: Sobol indices of the expected criteria.

The sizes of all groups of errors are uncertain over a range, evenly in their logarithm; a first-order index is the
share of the variance of the improvement that knowing one size would remove, a total index the share that would remain
if all others were known.

References
----------
Saltelli et al., Comput. Phys. Commun. 181 (2010) 259-270, the estimator of `scipy.stats.sobol_indices`.
"""

import warnings
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy import stats

from ltsim.arrays import Floats
from ltsim.errors import ModelError
from ltsim.planning.improvement import Predictor
from ltsim.randomness import stream

OUTPUTS = ("distance improvement", "coordinate improvement", "distance after", "coordinate after")
LEVEL = 0.95


class Index(NamedTuple):
    """Sobol indices of one output by one input, each with its 95 % interval (bootstrap)."""

    output: str
    input: str
    first: float
    first_low: float
    first_high: float
    total: float
    total_low: float
    total_high: float


def sensitivity(
    predictor: Predictor, ranges: Mapping[str, tuple[float, float]], *, samples: int = 1024, seed: int = 0
) -> list[Index]:
    """Indices of the expected improvement and of what is left after calibration.

    Parameters
    ----------
    predictor : Predictor
    ranges : mapping of str to (float, float)
        Lowest and highest size of each uncertain group of errors, in units of its stated size; others keep theirs.
    samples : int
        A power of two; the criteria are predicted ``samples * (inputs + 2)`` times.

    Raises
    ------
    ModelError
        When a range is empty or not positive, or `samples` is no power of two.
    """
    for name, (low, high) in ranges.items():
        if not 0.0 < low < high:
            found = f"the range of {name} is {low:g} to {high:g}"
            raise ModelError(f"{found}, expected two positive sizes, the lower first")
    if samples < 2 or samples & (samples - 1):
        raise ModelError(f"samples is {samples}, expected a power of two")
    names = list(ranges)

    def criteria(logs: Floats) -> Floats:
        expected = predictor.expected(dict(zip(names, np.exp(logs), strict=True)))
        return np.stack([getattr(expected, output.replace(" ", "_")) for output in OUTPUTS])

    bounds = [(np.log(low), np.log(high)) for low, high in ranges.values()]
    result = stats.sobol_indices(
        func=criteria,
        n=samples,
        dists=[stats.uniform(loc=low, scale=high - low) for low, high in bounds],
        random_state=stream(seed, "sobol"),
    )
    # An output that an input does not move has no bootstrap distribution; its interval is the index itself.
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        spread = result.bootstrap(LEVEL)
    columns = []
    for found, interval in ((result.first_order, spread.first_order), (result.total_order, spread.total_order)):
        ends = interval.confidence_interval
        columns += [found, *(np.where(np.isfinite(end), end, found) for end in (ends.low, ends.high))]
    return [
        Index(output, name, *(float(column[i, j]) for column in columns))
        for i, output in enumerate(OUTPUTS)
        for j, name in enumerate(names)
    ]
