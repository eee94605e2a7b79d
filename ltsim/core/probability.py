"""Two-sided p-values, their format, and the significance levels and prior probabilities that several packages share."""

import math

MIN_REPORTED_P_VALUE = 1e-6
"""Smallest p-value that is reported as a number; smaller p-values are reported as `< 1e-6`, because no test is exact
there."""
TWO_SIDED_GLOBAL_TEST_LEVEL = 0.02
"""Significance level of the two-sided global test (chi-square), 1 % on each side: readings and model disagree if the
two-sided p-value is smaller."""
PRIOR_BY_RELATIVE_EFFECT_SIZE = {0.03: 0.15, 0.1: 0.2, 0.3: 0.25, 1.0: 0.22, 3.0: 0.13, 10.0: 0.05}
"""Prior probability of each size of an effect that the adjustment does not model. The keys are ratios of the size to
the typical size of the effect, which the catalogue of effects declares.
"""
PRIOR_OF_WRONG_INSTRUMENT_CONSTANT = 0.04
"""Prior probability that a misfit is caused by a wrong instrument constant, such as the additive constant of the
ranges."""


def two_sided_p_value(upper_tail_probability: float) -> float:
    """Two-sided p-value of a chi-square test from its upper tail probability."""
    return 2.0 * min(upper_tail_probability, 1.0 - upper_tail_probability)


def p_value_text(p_value: float | None) -> str:
    """Text of a p-value: `0.02`, `< 1e-6`, `> 0.99`; a dash if it is missing."""
    if p_value is None or not math.isfinite(p_value):
        return "–"
    if p_value < MIN_REPORTED_P_VALUE:
        return "< 1e-6"
    return "> 0.99" if p_value > 0.99 else f"{p_value:.2g}"


def p_value_relation_text(p_value: float) -> str:
    """Text of a p-value in a sentence: `p = 0.02`, `p < 1e-6` or `p > 0.99`."""
    text = p_value_text(p_value)
    return f"p {text}" if text[0] in "<>" else f"p = {text}"
