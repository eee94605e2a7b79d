"""Contradictions between the readings and the prior of a parameter."""

from collections.abc import Collection

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.prior import FREED, ParameterPrior
from ltsim.adjustment.reliability import FEW
from ltsim.adjustment.remedies.undetermined import SILENT, Direction
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.evidence import change_seen, changes_found, evidence, log_evidence
from ltsim.core.arrays import Bools, Floats
from ltsim.core.notation import with_sigma
from ltsim.core.probability import P_CONSTANT

LEVEL = 0.01
"""Chance that any combination under a correct prior is said to contradict it."""
RARE = 1e-3
"""Chance of as little scatter by the stated noise, under which the noise is estimated."""
NONE = 0.1
"""Share of the stated noise up to which readings have no noise at all, as in a simulation without."""
UNEXPLAINED = 2.0
"""sigma0 from which the readings contradict each other too, and no parameter is believed beyond its prior."""
MOST_FREED = 0.25
"""Share of an instrument's parameters beyond which its prior is wrong as a whole, and all keep it."""
CORRECTED = "the correction that it is said to have, which leaves"
MOST_SAID = 3
MOST_TERMS = 6


def rest_of(adjustment: Adjustment) -> float:
    """Root of chi-square over degrees of freedom, without the contribution of the parameters' prior."""
    gap = adjustment.problem.prior.residual(adjustment.state.instrument)
    return float(np.sqrt(max(adjustment.chi2 - float(gap @ gap), 0.0) / max(adjustment.dof, 1)))


def too_quiet(adjustment: Adjustment) -> bool:
    """Whether readings scatter less than stated: no effect that is missing makes them, so the stated noise is wrong."""
    heard = adjustment.dof >= FEW and rest_of(adjustment) > NONE
    return heard and bool(special.chdtr(adjustment.dof, adjustment.chi2) < RARE)


def beyond_prior(adjustment: Adjustment, prior: ParameterPrior) -> Bools:
    """(I, p) Parameters whose `prior` the readings contradict, of one instrument or of all alike.

    One change is looked for after another, those before free to be anything; each gives way to one that explains more
    in its place (`changes_found`). The prior of the adjustment may be wider.
    """
    found, scale = np.zeros(prior.mean.shape, dtype=bool), max(1.0, adjustment.sigma0)
    if prior.correlated or not np.isfinite(prior.sigma).all() or not scale < UNEXPLAINED:
        return found
    free, size = np.flatnonzero(~prior.held.ravel()), prior.mean.shape[1]
    unit, own = prior.sigma.ravel()[free], adjustment.problem.prior.sigma.ravel()[free]
    gap = (adjustment.state.instrument - prior.mean).ravel()[free]
    said = evidence(gap, adjustment.constants_covariance[np.ix_(free, free)], own, unit)
    alike = np.tile(np.eye(size), len(found))[~prior.held.any(axis=0) & (len(found) > 1)]
    ways = np.concatenate([np.eye(found.size)[free], alike])[:, free]

    def beyond(others: Collection[int]) -> Floats:
        """Log odds (h,) of each change beside others, to a tenth: of those that explain alike the first is taken."""
        given = FREED * ways[list(others)]
        score, weight = change_seen(said.information, said.told, np.eye(len(free)) + given.T @ given)
        seen = np.einsum("hi,ij,hj->h", ways, weight, ways)
        heard = (seen > SILENT) & ~np.isin(np.arange(len(ways)), list(others))
        told = ways @ score / np.where(heard, seen, np.inf)
        odds = np.round(log_odds(told * np.sqrt(np.abs(seen)) / scale, seen, len(ways)), 1)
        return np.where(heard & (np.abs(told) < FREED), odds, -np.inf)

    chosen = [k for k, odds in changes_found(beyond, 0.0).items() if odds[k] > 0.0]
    found.flat[free] = ways[chosen].any(axis=0)
    return found & (found.sum(axis=1, keepdims=True) <= MOST_FREED * size)


def disagreement(calibration: Calibration) -> tuple[str, ...]:
    """Sentences about the parameters that contradict their prior most, or else the combinations of them.

    Those whose estimate follows the readings are told as such. All that is tested, parameters and then combinations,
    shares the odds of one of them.
    """
    if not calibration.values.size or calibration.adjustment is None:
        return ()
    prior, freed = calibration.adjustment.problem.prior, calibration.beyond_prior
    rows, size = list(zip(calibration.names, calibration.parameters, strict=True)), freed.shape[1]
    scale, lengths = max(1.0, calibration.adjustment.sigma0), len(calibration.adjustment.problem.gauge)
    instruments = map(calibration.adjustment.recording.setup.instrument_named, calibration.instruments)
    known = [CORRECTED if one.corrected else "its stated prior of" for one in instruments]
    said = []
    for k in np.flatnonzero(freed).tolist():
        name, p = rows[k]
        said.append(
            f"{name} is {with_sigma(p.value, p.sigma, p.unit)} by the readings, which contradicts {known[k // size]} "
            f"{p.prior_sigma:.3g} {p.unit}: the estimate follows the readings"
        )
        if lengths and calibration.construction.parameters[k % size].prior_kind == "range_scale":
            said[-1] += " and the known lengths, whose temperature or expansion may be what is wrong instead"
    # The prior is an observation like any other: its residual has its variance less that of the estimate (Baarda).
    gain = np.where(calibration.held | freed, 0.0, 1.0 - (calibration.sigma / calibration.prior_sigma) ** 2).ravel()
    told = ((calibration.values - prior.mean) / calibration.prior_sigma).ravel()
    w = _normalised(told, gain) / scale
    odds = log_odds(w, gain, freed.size + size * (len(freed) > 1))
    found = [int(k) for k in np.argsort(-odds) if odds[k] > 0.0]
    if not found:
        return (*said, *_of_combinations(calibration, prior, scale))
    for k in found[:MOST_SAID]:
        name, p = rows[k]
        said.append(
            f"{name}: the readings contradict its prior of {p.prior_sigma:.3g} {p.unit} "
            f"(w = {w[k]:.1f}, estimate {p.value:.3g}); if it may be larger, state it in [instrument.prior.parameters]"
        )
    if len(found) > MOST_SAID:
        said.append(f"{len(found) - MOST_SAID} more parameters contradict their prior")
    return tuple(said)


def log_odds(z: Floats, weight: Floats, count: int) -> Floats:
    """Log odds (h,) that each of `count` constants is off, by normalised changes (h,) of such weights in priors.

    As in a diagnosis, averaged over sizes: a constant that the readings hardly see would be off by more than any is.
    """
    weight = np.maximum(weight, 0.0)
    return log_evidence((z**2 * weight)[:, None], weight[:, None]) + np.log(P_CONSTANT / count)


def _normalised(told: Floats, gain: Floats) -> Floats:
    """Deviations (k,) from the prior, told in its sigmas with such gains, over their own; 0 where nothing is heard."""
    return np.where(gain > SILENT, told / np.sqrt(np.maximum(gain, SILENT)), 0.0)


def _of_combinations(calibration: Calibration, prior: ParameterPrior, scale: float) -> tuple[str, ...]:
    """A sentence on the combination that contradicts the prior most: in prior sigmas these are independent."""
    size = calibration.construction.size
    for i in range(len(calibration.instruments)):
        at = np.flatnonzero(~calibration.held[i])
        root = prior.roots[i][np.ix_(at, at)]
        own = calibration.covariance[np.ix_(i * size + at, i * size + at)]
        left, vectors = np.linalg.eigh(root @ own @ root.T)
        gain = np.clip(1.0 - left, 0.0, 1.0)
        told = vectors.T @ root @ (calibration.values[i] - prior.mean[i])[at]
        w = _normalised(told, gain) / scale
        k = int(np.argmax(np.abs(w)))
        if abs(w[k]) > -special.ndtri(LEVEL / (4 * max(int(np.count_nonzero(w)), 1))):
            shown = Direction(vectors[:, k], float(gain[k])).coefficients([calibration.names[i * size + j] for j in at])
            terms = " ".join(f"{value:+.2f} {name}" for name, value in list(shown.items())[:MOST_TERMS])
            return (f"the readings contradict the prior of a combination (w = {w[k]:.1f}): {terms}",)
    return ()
