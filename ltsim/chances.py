"""Chances of tests: of both sides together, and as a person reads them."""

import math

LEAST = 1e-6
"""A smaller chance is told as smaller than this: no test is that exact."""
AGREES = 0.02
"""Two-sided chance of a chi-square from which readings agree with model and stated noise: 1 % on each side."""


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
