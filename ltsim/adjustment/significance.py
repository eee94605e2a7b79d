"""Significance levels of all tests, and limits that several tests share.

The levels follow Baarda's tests of networks: 5 % for the global test, 1 % for all tests of single hypotheses together,
0.1 % (with a power of 80 %) for one hypothesis that was chosen beforehand.

References
----------
Baarda, A testing procedure for use in geodetic networks (1968).
"""

GLOBAL_LEVEL = 0.05
"""Significance level of the test of a whole model, for example of chi-square of a network."""
FAMILY_LEVEL = 0.01
"""Probability that a recording without errors fails any test of a family of single hypotheses (Sidak, Bonferroni or
Holm over the family)."""
SINGLE_LEVEL = 0.001
"""Significance level of a test of one hypothesis that was selected in advance."""
TEST_POWER = 0.8
"""Power: probability that an error of the minimal detectable size is detected."""
MIN_NUMERICAL_REDUNDANCY = 1e-6
"""Redundancy number, or remaining fraction of a squared signature, up to which a residual counts as rounding error. The
square root of double precision is 1.5e-8, and normal equations lose further digits.
"""
MIN_FAR_RESIDUAL = 50.0
"""Residual, in standard deviations, above which noise is no explanation, even if it is ten times as large as declared.
"""
MIN_FAULTY_FRACTION_OF_PLACE = 0.5
"""Fraction of rejected readings at a station or target above which the error is ascribed to the station or target and
not to single readings.
"""
MIN_REPORTED_PROBABILITY = 0.01
"""Posterior probability above which an alternative hypothesis is reported."""
