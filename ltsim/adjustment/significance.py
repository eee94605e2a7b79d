"""Significance levels of all tests, and the limits that several of them share.

The levels are those of the network tests of Baarda: the global test at 5 %, a family of tests of single hypotheses at
1 % together, one hypothesis that was chosen beforehand at 0.1 % with a power of 80 %.

References
----------
Baarda, A testing procedure for use in geodetic networks (1968).
"""

GLOBAL_LEVEL = 0.05
"""Significance level of the test of a whole model: chi-square of a network, any cause in a search."""
FAMILY_LEVEL = 0.01
"""Probability that a recording without errors fails any test of a family of single hypotheses (Sidak, Bonferroni or
Holm over the family)."""
SINGLE_LEVEL = 0.001
"""Significance level of a test of one hypothesis that was chosen beforehand."""
POWER = 0.8
"""Power: probability that an error of the minimal detectable size is detected."""
UNCHECKED = 1e-6
"""Redundancy, or share of a squared signature that an adjustment leaves, below which a residual is rounding: the square
root of the precision of doubles is 1.5e-8, and normal equations lose as many digits again."""
FAR = 50.0
"""Residual in standard deviations that no noise explains, also if it is declared ten times too small: beyond five."""
MAJORITY = 0.5
"""Share of the readings of a place from which its errors are the place's and not those of single readings."""
NOT_EXCLUDED = 0.01
"""Posterior probability from which an alternative is reported."""
