"""Limits of rounding errors in double and single precision."""

import numpy as np

SQRT_MACHINE_EPSILON = float(np.sqrt(np.finfo(np.float64).eps))
"""Square root of the machine epsilon in double precision, 1.5e-8 (half of the digits): relative rounding error of a
difference of squares. A difference below this fraction of its terms counts as zero, numbers with a smaller relative
difference count as equal, and an iteration that converges quadratically ends at a smaller relative step."""
NORMAL_EQUATIONS_TOLERANCE = 1e-6
"""Relative rounding error of numbers computed from normal equations: redundancy numbers, squared fractions of an effect
that remain in residuals, coefficients of combinations, log evidences. A smaller number counts as zero. The limit
exceeds `SQRT_MACHINE_EPSILON` because the condition number of normal equations is the square of that of the design
matrix."""
MAX_LOG_EVIDENCE_ROUNDING_ERROR = 1e-3
"""Largest difference of two log evidences, computed in single precision, that count as equal. It is the spacing of
single-precision numbers near 10,000, the log evidence of a step of 140 standard deviations.
"""
