"""Chances of tests: of both sides together, and as a person reads them."""

import math

LEAST = 1e-6
"""A smaller chance is told as smaller than this: no test is that exact."""
AGREES = 0.02
"""Two-sided chance of a chi-square from which readings agree with model and stated noise: 1 % on each side."""
SIZES = {0.03: 0.15, 0.1: 0.2, 0.3: 0.25, 1.0: 0.22, 3.0: 0.13, 10.0: 0.05}
"""Sizes of what is missing over a plausible one, and their shares: ten times as large is rare, a tenth is common."""
CONSTANT = 0.04
"""Share of a constant of an instrument that is not what is known of it, in what may be missing."""


def two_sided(upper: float) -> float:
    """Chance of a chi-square at least as unusual, too large or too small, from that of one as large or larger."""
    return 2.0 * min(upper, 1.0 - upper)


def p_text(p: float | None) -> str:
    """A chance as a person writes it; a dash for none."""
    if p is None or not math.isfinite(p):
        return "–"
    if p < LEAST:
        return "< 1e-6"
    return "> 0.99" if p > 0.99 else f"{p:.2g}"


def p_is(p: float) -> str:
    """`p = 0.02`, `p < 1e-6` or `p > 0.99`."""
    text = p_text(p)
    return f"p {text}" if text[0] in "<>" else f"p = {text}"
