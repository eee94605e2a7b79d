"""Does the recording agree with the model and the stated noise? One test for the whole search.

The statistic is the log evidence of all hypotheses together against none: mean shifts, changes of the noise, single bad
readings. Its distribution without any effect is simulated on the network at hand (white noise in the residual space,
one matrix product for all trials), so the false-alarm rate is what it says however many hypotheses were tried. Beyond
the reach of the simulation a likelihood ratio's own bound holds: P(statistic > x) <= exp(-x).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.special import logsumexp

from ltsim.arrays import Floats
from ltsim.diagnose.noise import NoiseBank
from ltsim.diagnose.search import Searcher
from ltsim.randomness import stream

TRIALS = 600
NOISE_ODDS = 0.5
"""Prior odds of a catalogued change of the noise against one catalogued mean shift."""
NOISE_UNKNOWN_ODDS = 0.05


@dataclass(frozen=True)
class Detection:
    """Outcome of the global tests.

    Attributes
    ----------
    statistic : float
        Log evidence of the whole search.
    p_value : float
        Corrected for everything that was searched.
    chi2_p_value : float
        Of the plain global test.
    null : (trials,) float
        Statistic of simulated recordings without any effect.
    """

    statistic: float
    p_value: float
    chi2_p_value: float
    null: Floats

    def threshold(self, level: float) -> float:
        """Value of the statistic that a clean recording exceeds with probability `level`."""
        return float(np.quantile(self.null, 1.0 - level))


def noise_prior(bank: NoiseBank) -> Floats:
    """Log prior odds (families,) of the noise families."""
    unknown = np.array([f.startswith("unknown") for f in bank.families])
    share = NOISE_UNKNOWN_ODDS / max(int(unknown.sum()), 1)
    odds: Floats = np.log(np.where(unknown, share, NOISE_ODDS)) if len(unknown) else np.zeros(0)
    return odds


def detect(searcher: Searcher, noise: NoiseBank, seed: int) -> Detection:
    """Test a residual space against all hypotheses at once."""
    space, bank = searcher.space, searcher.bank
    drop, rank = bank.drops(space.residual)
    prior = noise_prior(noise)
    statistic = _statistic(
        searcher.family_evidence(drop, rank)[:, None],
        noise.family_evidence(noise.log_likelihood_ratio(space.residual[:, None])) + prior[:, None],
    )[0]
    rng = stream(seed, "diagnose", "null")
    null = []
    for _ in range(TRIALS // 100):
        white = rng.standard_normal((space.size, 100))
        residual = space.project(white)
        null.append(
            _statistic(
                bank.simulated_evidence(residual) + searcher.prior[:, None],
                noise.family_evidence(noise.log_likelihood_ratio(residual)) + prior[:, None],
            )
        )
    simulated = np.concatenate(null)
    above = int(np.sum(simulated >= statistic))
    empirical = (above + 1) / (len(simulated) + 1)
    bound = float(np.exp(-max(statistic, 0.0)))
    p_value = empirical if above >= 5 else min(empirical, bound)
    chi2 = float(space.residual @ space.residual)
    dof = space.adjustment.dof
    return Detection(float(statistic), p_value, float(stats.chi2.sf(chi2, dof)), simulated)


def _statistic(mean: Floats, noise: Floats) -> Floats:
    """Log evidence (trials,) of all families (families, trials)."""
    total: Floats = logsumexp(np.vstack([mean, noise]), axis=0)
    return total
