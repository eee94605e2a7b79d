"""Global test of the agreement of a recording with the ordinary model and the declared noise.

The test statistic is the log of the summed evidence, with priors, of all hypotheses of the search relative to no
effect. The hypotheses are catalogue effects, empirical laws, and noise hypotheses. The null distribution of the
statistic is computed from simulated residuals of the same network. The false-alarm rate is therefore valid for any
number of hypotheses.
"""

from dataclasses import dataclass

import numpy as np
from scipy import special

from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import Floats
from ltsim.core.rounding import MAX_LOG_EVIDENCE_ROUNDING_ERROR
from ltsim.diagnosis.noise import NoiseHypothesisSet
from ltsim.diagnosis.search import Searcher


@dataclass(frozen=True)
class GlobalTestResult:
    """Result of the global tests of a recording: the search over all possible causes, and the chi-square test."""

    test_statistic: float
    """Test statistic: log of the sum of the evidence of all hypotheses (possible causes of a misfit)."""
    chi2_p_value: float
    """One-sided p-value of chi-square in the ordinary adjustment; NaN without redundancy."""
    null_test_statistics: Floats
    """Test statistics of simulated recordings without any effect, one per recording."""

    @property
    def p_value(self) -> float:
        """p-value of the recording in the search over all effects, corrected for the number of hypotheses."""
        return self.p_value_of(self.test_statistic)

    def critical_value(self, alpha: float) -> float:
        """Value of the test statistic that a recording without effects exceeds with the probability `alpha`."""
        return float(np.quantile(self.null_test_statistics, 1.0 - alpha))

    def p_value_of(self, statistic: float) -> float:
        """p-value of a value of the test statistic: (k + 1) / (n + 1) if k of n simulated recordings reach this value.

        A recording without effects is exchangeable with the simulated recordings. Its p-value is therefore at most p
        with a probability of at most p. The smallest p-value is 1 / (n + 1).
        """
        return (int(np.sum(self.null_test_statistics >= statistic - MAX_LOG_EVIDENCE_ROUNDING_ERROR)) + 1) / (
            len(self.null_test_statistics) + 1
        )


def run_global_test(searcher: Searcher, noise_hypotheses: NoiseHypothesisSet) -> GlobalTestResult:
    """Result of the simultaneous test of an adjustment for all effects, empirical laws and hypotheses of changed noise.

    An empirical law describes an error as a function of covariates.
    """
    space = searcher.residual_space
    noise_evidence = noise_hypotheses.log_evidence_by_family(space.whitened_residuals[:, None], space.redundancy)[:, 0]
    simulated_evidence = noise_hypotheses.log_evidence_by_family(
        searcher.null_ensemble.simulated_residuals, space.redundancy
    )
    statistic = float(log_sum_exp(np.append(noise_evidence, searcher.empty_model_screening.test_statistic)))
    null = np.logaddexp(log_sum_exp(simulated_evidence), searcher.empty_model_screening.null_test_statistics)
    chi2, dof = float(space.whitened_residuals @ space.whitened_residuals), space.adjustment.dof
    chi2_p_value = float(special.chdtrc(dof, chi2)) if dof > 0 else float("nan")
    return GlobalTestResult(statistic, chi2_p_value, null)
