"""Global test of a recording against model and declared noise, one for the complete search.

The statistic is the log evidence of all hypotheses with their priors (catalogue effects, laws, changes of the noise)
relative to none. Its null distribution is computed from simulated residuals of the same network, so that the
false-alarm rate is valid for any number of hypotheses.
"""

from dataclasses import dataclass

import numpy as np
from scipy import special

from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import Floats
from ltsim.core.rounding import MAX_SINGLE_ROUNDING_ERROR
from ltsim.diagnosis.noise import NoiseBank
from ltsim.diagnosis.search import Searcher


@dataclass(frozen=True)
class Detection:
    """Outcome of the global tests.

    Attributes
    ----------
    statistic : float
        Log evidence of the whole search.
    chi2_p_value : float
        p-value of the global test (chi-square); NaN without redundancy.
    null_statistics : (trials,) float
        Statistic of simulated recordings without any effect.
    """

    statistic: float
    chi2_p_value: float
    null_statistics: Floats

    @property
    def p_value(self) -> float:
        """p-value of the search, corrected for everything that was tried."""
        return self.p_value_of(self.statistic)

    def threshold(self, alpha: float) -> float:
        """Value of the statistic that a clean recording exceeds with probability `alpha`."""
        return float(np.quantile(self.null_statistics, 1.0 - alpha))

    def p_value_of(self, statistic: float) -> float:
        """p-value of a statistic in the complete search: (k + 1) / (n + 1) if k of n simulated recordings reach it.

        A recording without effects is exchangeable with them, so that the probability of a value up to p is at most p.
        The smallest value is 1 / (n + 1).
        """
        return (int(np.sum(self.null_statistics >= statistic - MAX_SINGLE_ROUNDING_ERROR)) + 1) / (
            len(self.null_statistics) + 1
        )


def detect(searcher: Searcher, noise: NoiseBank) -> Detection:
    """Joint test of the residuals of an adjustment against all effects, laws and changes of the noise."""
    space = searcher.space
    noise_evidence = noise.family_evidence(space.residuals[:, None], space.redundancy)[:, 0]
    simulated_evidence = noise.family_evidence(searcher.null_ensemble.simulated_residuals, space.redundancy)
    statistic = float(log_sum_exp(np.append(noise_evidence, searcher.empty_model_screening.statistic)))
    null = np.logaddexp(log_sum_exp(simulated_evidence), searcher.empty_model_screening.null_statistics)
    chi2, dof = float(space.residuals @ space.residuals), space.adjustment.dof
    chi2_p_value = float(special.chdtrc(dof, chi2)) if dof > 0 else float("nan")
    return Detection(statistic, chi2_p_value, null)
