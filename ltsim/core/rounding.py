"""Limits of rounding errors in double and single precision."""

import numpy as np

MAX_ROUNDING_ERROR = float(np.sqrt(np.finfo(np.float64).eps))
"""Relative size up to which a number counts as zero, or two numbers as equal, and a step up to which an iteration that
converges quadratically has ended: half of the digits of double precision, 1.5e-8. A difference of squares has no more.
"""
MAX_SOLUTION_ROUNDING_ERROR = 1e-6
"""Relative size up to which a number that was computed from normal equations counts as zero, or two of them as equal. It
applies to redundancy numbers, fractions of squared signatures and log evidences. Normal equations lose more digits than
half: they have the square of the condition number of the design, and results differ by the processor.
"""
MAX_SINGLE_ROUNDING_ERROR = float(np.sqrt(np.finfo(np.float32).eps))
"""Difference up to which log evidences in single precision count as equal: half of the digits, 3.5e-4."""
