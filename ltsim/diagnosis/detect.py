"""Does the recording agree with the model and the stated noise? One test for the whole search.

The statistic is the log evidence of everything that is tried, priors included, against nothing: cards, laws, changes of
the noise. Its distribution without any effect comes from the same sums over simulated residuals of the network at hand,
so the false-alarm rate is what it says however many hypotheses there are.
"""

from dataclasses import dataclass

import numpy as np
from scipy import special

from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import Floats
from ltsim.diagnosis.noise import NoiseBank
from ltsim.diagnosis.search import Searcher

ROUNDING = 1e-3
"""Log evidence that single precision, in which simulated recordings are scored, may lack."""


@dataclass(frozen=True)
class Detection:
    """Outcome of the global tests.

    Attributes
    ----------
    statistic : float
        Log evidence of the whole search.
    chi2_p_value : float
        Of the plain global test; NaN without redundancy.
    null : (trials,) float
        Statistic of simulated recordings without any effect.
    """

    statistic: float
    chi2_p_value: float
    null: Floats

    @property
    def p_value(self) -> float:
        """p-value of the search, corrected for everything that was tried."""
        return self.chance(self.statistic)

    def threshold(self, level: float) -> float:
        """Value of the statistic that a clean recording exceeds with probability `level`."""
        return float(np.quantile(self.null, 1.0 - level))

    def chance(self, statistic: float) -> float:
        """Chance that the whole search reaches a statistic in a clean recording: (k + 1) / (n + 1) of n simulated ones.

        A recording without any effect is one more of them, so that the chance of a value up to p is p at most. It is
        never less than 1 / (n + 1): what none of n recordings reached is told as that.
        """
        return (int(np.sum(self.null >= statistic - ROUNDING)) + 1) / (len(self.null) + 1)


def detect(searcher: Searcher, noise: NoiseBank) -> Detection:
    """Test a residual space against all hypotheses at once."""
    space = searcher.space
    own = noise.family_evidence(space.residual[:, None], space.redundancy)[:, 0]
    simulated = noise.family_evidence(searcher.probe.trials.astype(np.float64), space.redundancy)
    statistic = float(log_sum_exp(np.append(own, searcher.first.statistic)))
    null = np.logaddexp(log_sum_exp(simulated), searcher.first.null)
    chi2, dof = float(space.residual @ space.residual), space.adjustment.dof
    plain = float(special.chdtrc(dof, chi2)) if dof > 0 else float("nan")
    return Detection(statistic, plain, null)
