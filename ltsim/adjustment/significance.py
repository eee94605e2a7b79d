"""Significance levels of all tests, and limits that several tests share.

The levels follow Baarda's tests of networks: 5 % for the global test, 1 % for all tests of single hypotheses together,
0.1 % (with a power of 80 %) for one hypothesis that was chosen beforehand.

References
----------
Baarda, A testing procedure for use in geodetic networks (1968).
Kass and Raftery, Bayes factors, JASA 90 (1995) 773: odds of 20 to 1 are strong, of 150 to 1 very strong.
"""

import numpy as np

GLOBAL_TEST_LEVEL = 0.05
"""Significance level of the test of a whole model, for example of chi-square of a network."""
FAMILY_WISE_LEVEL = 0.01
"""Probability that a recording without errors fails at least one test of a family of single hypotheses (Sidak,
Bonferroni or Holm over the family)."""
SINGLE_TEST_LEVEL = 0.001
"""Significance level of a test of one hypothesis that was selected in advance."""
TEST_POWER = 0.8
"""Power: probability that an error of the minimal detectable size is detected."""

MIN_SIGNIFICANT_SIGMAS = 2.0
"""Ratio of an estimate to its standard deviation from which the estimate is reported: two-sided 5 %, the coverage
factor of the GUM (JCGM 100, 6.2).
"""
MAX_CHANCE_SIGMAS = 4.0
"""Ratio of an error to its standard deviation up to which chance explains it: 1 of 16,000 normal variates is
larger.
"""
MIN_CLEAR_SIGMAS = 5.0
"""Ratio of an error to its standard deviation from which it is clear whatever the number of tests: 1 of 1.7 million
normal variates exceeds it.
"""
MIN_GROSS_SIGMAS = 30.0
"""Residual, in robust standard deviations, from which a reading is a gross error if it also exceeds any error of a
tracker [m] (`MAX_TRACKER_ERROR`): in a large hall noise alone exceeds such an error.
"""
MAX_TRACKER_ERROR = 1e-3
"""Displacement [m] of a measured point above which its pointing is a gross error, for ranges up to
`MAX_WORKSHOP_RANGE`.
"""
MAX_WORKSHOP_RANGE = 10.0
"""Range [m] above which the limit `MAX_TRACKER_ERROR` grows in proportion to the range."""
MIN_RESIDUAL_BEYOND_NOISE = 50.0
"""Residual, in standard deviations, above which noise is no explanation, even if it is ten times as large as declared.
"""
MIN_CHECKED_REDUNDANCY = 0.05
"""Redundancy number up to which the other observations do not check a reading, a level or a mean: an error must have 20
times the size of its residual.
"""
MIN_DOF_FOR_ESTIMATED_NOISE = 15
"""Degrees of freedom below which an estimated sigma0 is too uncertain to replace the declared noise: its standard
deviation is 1 / sqrt(2 * 15), 18 %.
"""
MIN_REPEATS_FOR_VARIANCE = 4
"""Number of pointings to a target, of its occupations, or of targets in a group, from which their separate noise is
tested; with two or three an outlier explains as much.
"""
MIN_MEAN_REPEATS = 1.5
"""Mean number of pointings to an occupation, or of occupations of a target, from which displacements are a hypothesis:
half of the places are then repeated. Without repeats a displacement looks like noise, or is part of the coordinates.
"""
MIN_EQUIVALENT_CORRELATION = 0.9
"""Squared correlation of two residuals or design columns above which errors of both count as indistinguishable:
9/10 of the chi-square of one is explained by the other.
"""
MIN_MISFIT_RATIO = 10.0
"""Ratio of the misfits of two models of the same points (with and without a declared datum, a mirror image, another
unit), above which the model with the larger misfit is wrong. Correct coordinates have misfits of the size of the noise,
mirrored or misread ones of the size of the network.
"""
MAX_SINGLE_ERROR_FRACTION = 0.1
"""Fraction of outliers among the readings, or pointings, up to which they count as single errors; if more are rejected,
the declared noise or a unit is wrong.
"""
MIN_FAULTY_FRACTION_OF_PLACE = 0.5
"""Fraction of rejected readings at a station or target above which the error is ascribed to the station or target and
not to single readings: the majority.
"""
MIN_REPORTED_PROBABILITY = 0.01
"""Posterior probability above which an alternative hypothesis is reported."""
MIN_LOG_EVIDENCE_GAIN = 3.0
"""Smallest gain of log evidence of a selected hypothesis: odds of 20 to 1, strong on the scale of Kass and Raftery."""
MIN_LOG_EVIDENCE_CERTAIN = -float(np.log(SINGLE_TEST_LEVEL))
"""Gain of log evidence above which a hypothesis counts as certain, and the deficit below which it is negligible: odds
of 1 to `SINGLE_TEST_LEVEL`.
"""
