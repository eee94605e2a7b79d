"""Limits of rounding errors in double and single precision."""

import numpy as np

MAX_ROUNDING_ERROR = float(np.sqrt(np.finfo(np.float64).eps))
"""Relative rounding error of a difference of squares in double precision, 1.5e-8 (half of the digits). A number that is
smaller relative to its terms counts as zero, two numbers that differ by less count as equal, and an iteration that
converges quadratically ends if its relative step is smaller."""
MAX_SOLUTION_ROUNDING_ERROR = 1e-6
"""Relative rounding error of numbers computed from normal equations: redundancy numbers, squared fractions of an effect
that remain in residuals, coefficients of combinations, log evidences. A smaller number counts as zero. It exceeds
`MAX_ROUNDING_ERROR` because the condition number of normal equations is the square of that of the design."""
MAX_SINGLE_ROUNDING_ERROR = 1e-3
"""Difference up to which log evidences in single precision count as equal: the spacing of numbers near 10,000, the log
evidence of a step of 140 standard deviations.
"""
