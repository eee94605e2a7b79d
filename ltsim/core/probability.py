"""Probabilities of tests: two-sided p-values, their format, and the levels and priors that several packages share."""

import math

SMALLEST_REPORTED_P = 1e-6
"""Reporting limit of p-values: smaller ones are reported as `< 1e-6`, because no test is exact that far out."""
AGREEMENT_LEVEL = 0.02
"""Level of the global test: a two-sided p-value of chi-square below it is a disagreement, 1 % on each side."""
SIZE_PRIOR = {0.03: 0.15, 0.1: 0.2, 0.3: 0.25, 1.0: 0.22, 3.0: 0.13, 10.0: 0.05}
"""Prior probabilities of the size of an unmodelled effect, by its ratio to the effect's plausible size."""
P_CONSTANT = 0.04
"""Prior probability that an unmodelled effect is a wrong constant of an instrument."""


def two_sided(upper_tail_probability: float) -> float:
    """Two-sided p-value of a chi-square test from its upper tail probability `upper_tail_probability`."""
    return 2.0 * min(upper_tail_probability, 1.0 - upper_tail_probability)


def p_text(p_value: float | None) -> str:
    """A p-value as text: `0.02`, `< 1e-6`, `> 0.99`; a dash for a missing value."""
    if p_value is None or not math.isfinite(p_value):
        return "–"
    if p_value < SMALLEST_REPORTED_P:
        return "< 1e-6"
    return "> 0.99" if p_value > 0.99 else f"{p_value:.2g}"


def format_p(p_value: float) -> str:
    """A p-value as part of a sentence: `p = 0.02`, `p < 1e-6` or `p > 0.99`."""
    text = p_text(p_value)
    return f"p {text}" if text[0] in "<>" else f"p = {text}"
