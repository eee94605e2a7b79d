"""Limits of rounding errors in double and single precision."""

import numpy as np

MAX_ROUNDING_ERROR = float(np.sqrt(np.finfo(np.float64).eps))
"""Relative size up to which a number counts as zero, or two numbers as equal, and relative step at which an iteration
that converges quadratically has ended: half of the digits of double precision, 1.5e-8, as in a difference of squares.
"""
MAX_SOLUTION_ROUNDING_ERROR = 1e-6
"""Relative size up to which a number that was computed from normal equations counts as zero, or two of them as equal:
redundancy numbers, squared fractions of an effect that remain in residuals, coefficients of combinations, log
evidences. Normal equations have the square of the condition number of the design, so that results differ by more than
`MAX_ROUNDING_ERROR` between processors.
"""
MAX_SINGLE_ROUNDING_ERROR = 1e-3
"""Difference up to which log evidences in single precision count as equal: the spacing of numbers near 10,000, the log
evidence of a step of 140 standard deviations.
"""
