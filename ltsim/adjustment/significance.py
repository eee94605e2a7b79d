"""Significance levels of all statistical tests, and limits that several tests share.

The levels follow Baarda's tests of networks: 5 % for the global test, 1 % for all tests of single hypotheses together,
0.1 % (with a power of 80 %) for one hypothesis that was chosen beforehand.

References
----------
Baarda, A testing procedure for use in geodetic networks (1968).
Kass and Raftery, Bayes factors, JASA 90 (1995) 773: odds of 20 to 1 are strong, of 150 to 1 very strong.
"""

import numpy as np

GLOBAL_TEST_LEVEL = 0.05
"""Significance level of the test of a whole model, such as the global test of a network by chi-square."""
FAMILY_WISE_LEVEL = 0.01
"""Family-wise significance level of all tests of single hypotheses: probability that a recording without errors fails
at least one of them (correction by Sidak, Bonferroni or Holm)."""
SINGLE_TEST_LEVEL = 0.001
"""Significance level of the test of one hypothesis that was chosen before the data were known."""
TEST_POWER = 0.8
"""Power of a test: probability that it detects an error of the minimal detectable size."""

MIN_SIGNIFICANT_SIGMAS = 2.0
"""Smallest ratio of an estimate to its standard deviation with which a sentence reports the estimate: two-sided 5 %,
the coverage factor of the GUM (JCGM 100, 6.2)."""
MAX_CHANCE_SIGMAS = 4.0
"""Largest ratio of an error to its standard deviation that noise may explain: 1 of 16,000 normal variates is larger."""
MIN_CERTAIN_ERROR_SIGMAS = 5.0
"""Smallest ratio of an error to its standard deviation that is significant in any number of tests: 1 of 1.7 million
normal variates exceeds it."""
MIN_GROSS_ERROR_SIGMAS = 30.0
"""Smallest residual of a reading with a gross error, in robust standard deviations. As a displacement the residual must
also exceed `MAX_TRACKER_ERROR`.
"""
MAX_TRACKER_ERROR = 1e-3
"""Largest displacement [m] of a measured point by errors of a tracker, for ranges up to
`MIN_RANGE_OF_PROPORTIONAL_ERROR_LIMIT`. A larger displacement is a gross error."""
MIN_RANGE_OF_PROPORTIONAL_ERROR_LIMIT = 10.0
"""Range [m] above which the limit `MAX_TRACKER_ERROR` grows in proportion to the range."""
MIN_SIGMAS_BEYOND_NOISE = 50.0
"""Smallest residual, in declared standard deviations, that noise does not explain, even noise ten times as large as
declared."""
MIN_CHECKED_REDUNDANCY = 0.05
"""Smallest redundancy number of a reading, level or mean that counts as checked by other observations. At this limit an
error is 20 times as large as the residual that it causes."""
MIN_DOF_FOR_ESTIMATED_NOISE = 15
"""Smallest number of degrees of freedom of an estimated sigma0 that may replace the declared noise; its relative
standard deviation is then 1 / sqrt(2 * 15) = 18 %. """
MIN_REPEATS_FOR_VARIANCE = 4
"""Smallest number of pointings to a target, of occupations of a target (placements of a reflector), or of targets in a
group, for a test that their noise differs from other noise. With two or three of them, a single outlier looks like
larger noise.
"""
MIN_MEAN_REPEATS = 1.5
"""Smallest mean number of pointings per occupation (placement of a reflector on a target), or of occupations per
target, for a test of random displacements of reflectors. Without repeated pointings a displacement is not
distinguishable from noise; without repeated occupations it is part of the coordinates.
"""
MIN_EQUIVALENT_SQUARED_CORRELATION = 0.9
"""Smallest squared correlation of two indistinguishable errors, computed from their effects on the residuals. One of
two such errors explains at least 9/10 of the chi-square of the other."""
MIN_MISFIT_RATIO = 10.0
"""Limit of the ratio of misfits of two models of the same points, such as a network and its mirror image, or two units.
If the ratio is larger, the model with the larger misfit is wrong: correct coordinates have misfits of the size of the
noise, mirrored or misread coordinates have misfits of the size of the network."""
MAX_SINGLE_ERROR_FRACTION = 0.1
"""Largest fraction of outliers among the readings or pointings of a recording that may be single errors. If more are
rejected, the declared noise or a unit is wrong.
"""
MIN_FAULTY_FRACTION_OF_GROUP = 0.5
"""Limit of the fraction of rejected readings of a station or target (one half). If it is exceeded, the error is
ascribed to the station or target and not to single readings."""
MIN_REPORTED_PROBABILITY = 0.01
"""Smallest posterior probability of a reported alternative hypothesis."""
MIN_LOG_EVIDENCE_GAIN = 3.0
"""Smallest gain of log evidence of a selected hypothesis: odds of 20 to 1, strong on the scale of Kass and Raftery."""
MIN_LOG_EVIDENCE_CERTAIN = -float(np.log(SINGLE_TEST_LEVEL))
"""Smallest gain of log evidence of a certain hypothesis: odds of 1 to `SINGLE_TEST_LEVEL`. If the log evidence of a
hypothesis is smaller by this amount than that of a rival, the hypothesis is negligible."""
