"""Limits of rounding errors in double and single precision."""

from collections.abc import Sequence

import numpy as np

SQRT_MACHINE_EPSILON = float(np.sqrt(np.finfo(np.float64).eps))
"""Square root of the machine epsilon in double precision, 1.5e-8 (half of the digits): tolerance for relative
differences. Numbers with a smaller relative difference count as equal. A quadratically converging iteration ends at a
smaller relative step."""
NORMAL_EQUATIONS_TOLERANCE = 1e-6
"""Largest relative rounding error of numbers computed from normal equations, such as redundancy numbers and log
evidences (logarithms of marginal likelihoods). Smaller numbers count as zero. The limit exceeds `SQRT_MACHINE_EPSILON`
because the condition number of normal equations is the square of that of the design matrix.
"""
MAX_LOG_EVIDENCE_ROUNDING_ERROR = 1e-3
"""Largest difference of two log evidences (logarithms of marginal likelihoods) in single precision that count as equal:
the spacing of single-precision numbers near 10,000. An effect of 140 standard deviations has a log evidence of this
size.
"""


def index_of_largest(values: Sequence[float]) -> int:
    """Index of the largest of `values`; of several that differ only by rounding errors, the first.

    Which of equal values is the largest depends on the instructions that the matrix library chooses for a processor.
    """
    array = np.asarray(values, dtype=np.float64)
    largest = float(array.max())
    return int(np.flatnonzero(array >= largest - NORMAL_EQUATIONS_TOLERANCE * max(abs(largest), 1.0))[0])
