"""Significance levels of all tests, and limits that several tests share.

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
"""Significance level of a test of one hypothesis that was selected in advance."""
TEST_POWER = 0.8
"""Power: probability that an error of the minimal detectable size is detected."""
MIN_NUMERICAL_REDUNDANCY = 1e-6
"""Redundancy, or fraction of a squared signature after the adjustment, below which a residual is rounding error:
the square root of double precision is 1.5e-8, and normal equations lose as many digits again.
"""
MIN_FAR_RESIDUAL = 50.0
"""Smallest residual, in standard deviations, that noise does not explain, even noise ten times as large as declared."""
MIN_FAULTY_FRACTION_OF_PLACE = 0.5
"""Fraction of faulty readings at a place from which the place, and not the single readings, has an error."""
MIN_REPORTED_PROBABILITY = 0.01
"""Smallest posterior probability of a reported alternative."""
