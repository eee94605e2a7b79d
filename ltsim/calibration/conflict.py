"""Where the readings contradict what was known of a parameter before them."""

from __future__ import annotations

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.prior import ParameterPrior
from ltsim.arrays import Bools, Floats
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.evidence import change_seen, evidence
from ltsim.notation import with_sigma
from ltsim.remedies.undetermined import SILENT, Direction

LEVEL = 0.01
"""Chance that any parameter of a correct prior is said to contradict it."""
FREED = 100.0
"""Stated sigmas that a parameter may be off once the readings contradict its prior; no instrument's are off more."""
MOST_SAID = 3
MOST_TERMS = 6


def normalised(calibration: Calibration, mean: Floats | None = None) -> Floats:
    """Estimates less prior over the standard deviation of that difference (I, p); 0 where the readings are silent.

    The prior is an observation like any other: its residual has the variance of the prior less that of the estimate
    (Baarda's w-test of the prior's row). `mean` (I, p) of the prior is zero by default.
    """
    before, after = calibration.prior_sigma**2, calibration.sigma**2
    heard = ~calibration.held & (before - after > SILENT * before)
    gap = calibration.values if mean is None else calibration.values - mean
    return np.where(heard, gap / np.sqrt(np.where(heard, before - after, 1.0)), 0.0)


def beyond_prior(adjustment: Adjustment) -> Bools:
    """(I, p) Parameters whose prior the readings contradict: one after the other, those before free to be anything."""
    prior, scale = adjustment.problem.prior, max(1.0, adjustment.sigma0)
    found = np.zeros(prior.mean.shape, dtype=bool)
    for i in range(len(found) if not prior.correlated and np.isfinite(prior.sigma).all() else 0):
        at = np.flatnonzero(~prior.held[i])
        unit, gap = prior.sigma[i, at], (adjustment.state.instrument - prior.mean)[i, at]
        said = evidence(gap, adjustment.instrument_covariance_of(i)[np.ix_(at, at)], unit, unit)
        variance = np.eye(len(at))
        while True:
            score, weight = change_seen(said.information, said.told, variance)
            seen = np.diag(weight)
            heard = (seen > SILENT) & ~found[i, at]
            off = np.where(heard, score / np.where(heard, seen, 1.0), 0.0)
            beyond = _beyond(off * np.sqrt(np.maximum(seen, 0.0)) / scale)
            if not beyond or abs(off[beyond[0]]) > FREED:
                break
            found[i, at[beyond[0]]] = True
            variance[beyond[0], beyond[0]] = FREED**2
    return found


def widened(prior: ParameterPrior, freed: Bools) -> ParameterPrior:
    """The prior with some parameters (I, p) practically free."""
    factor = np.where(freed, FREED, 1.0)
    return ParameterPrior(prior.mean, prior.covariance * factor[:, :, None] * factor[:, None, :], prior.held)


def contradictions(calibration: Calibration, freed: Bools) -> tuple[str, ...]:
    """A sentence on each parameter that follows the readings because they contradict its prior."""
    said, size = [], calibration.construction.size
    for k in np.flatnonzero(freed.ravel()).tolist():
        parameter = calibration.construction.parameters[k % size]
        value, sigma, prior = (
            float(x.ravel()[k]) / parameter.factor
            for x in (calibration.values, calibration.sigma, calibration.prior_sigma / FREED)
        )
        said.append(
            f"{calibration.names[k]} is {with_sigma(value, sigma, parameter.unit)} by the readings, which contradicts "
            f"its stated prior of {prior:.3g} {parameter.unit}: the estimate follows the readings"
        )
    return tuple(said)


def disagreement(calibration: Calibration) -> tuple[str, ...]:
    """Sentences about the parameters that contradict their prior most, or else the combinations of them.

    Two-sided tests at a level shared out over all that is tested, parameters and then combinations.
    """
    if not calibration.values.size:
        return ()
    size, w = calibration.construction.size, normalised(calibration, _prior_mean(calibration)).ravel()
    found = _beyond(w)
    if not found:
        return _of_combinations(calibration)
    said = []
    for k in found[:MOST_SAID]:
        parameter = calibration.construction.parameters[k % size]
        value, prior = (float(x.ravel()[k]) / parameter.factor for x in (calibration.values, calibration.prior_sigma))
        said.append(
            f"{calibration.names[k]}: the readings contradict its prior of {prior:.3g} {parameter.unit} "
            f"(w = {w[k]:.1f}, estimate {value:.3g}); if it may be larger, state it in [instrument.prior.parameters]"
        )
    if len(found) > MOST_SAID:
        said.append(f"{len(found) - MOST_SAID} more parameters contradict their prior")
    return tuple(said)


def _beyond(w: Floats) -> list[int]:
    """Places of values that chance does not make, the largest first; zeros were not tested."""
    tested = int(np.count_nonzero(w))
    limit = float(-special.ndtri(LEVEL / (4 * tested))) if tested else np.inf
    return [int(k) for k in np.argsort(-np.abs(w)) if abs(w[k]) > limit]


def _of_combinations(calibration: Calibration) -> tuple[str, ...]:
    """A sentence on the combination that contradicts the prior most: in prior sigmas these are independent."""
    if calibration.adjustment is None:
        return ()
    prior, size = calibration.adjustment.problem.prior, calibration.construction.size
    for i in range(len(calibration.instruments)):
        at = np.flatnonzero(~calibration.held[i])
        root = prior.roots[i][np.ix_(at, at)]
        own = calibration.covariance[np.ix_(i * size + at, i * size + at)]
        left, vectors = np.linalg.eigh(root @ own @ root.T)
        gain = np.clip(1.0 - left, 0.0, 1.0)
        told = vectors.T @ root @ (calibration.values[i] - prior.mean[i])[at]
        w = np.where(gain > SILENT, told / np.sqrt(np.maximum(gain, SILENT)), 0.0)
        found = _beyond(w)
        if found:
            k = found[0]
            shown = Direction(vectors[:, k], float(gain[k])).coefficients([calibration.names[i * size + j] for j in at])
            terms = " ".join(f"{value:+.2f} {name}" for name, value in list(shown.items())[:MOST_TERMS])
            return (f"the readings contradict the prior of a combination (w = {w[k]:.1f}): {terms}",)
    return ()


def _prior_mean(calibration: Calibration) -> Floats | None:
    return None if calibration.adjustment is None else calibration.adjustment.problem.prior.mean
