"""Where the readings contradict what was known of a parameter before them."""

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
UNEXPLAINED = 2.0
"""sigma0 from which the readings contradict each other too, and no parameter is believed beyond its prior."""
MOST_FREED = 0.25
"""Share of an instrument's parameters beyond which its prior is wrong as a whole, and all keep it."""
MOST_SAID = 3
MOST_TERMS = 6


def beyond_prior(adjustment: Adjustment) -> Bools:
    """(I, p) Parameters whose prior the readings contradict: one after the other, those before free to be anything."""
    prior, scale = adjustment.problem.prior, max(1.0, adjustment.sigma0)
    found = np.zeros(prior.mean.shape, dtype=bool)
    if prior.correlated or not np.isfinite(prior.sigma).all() or not scale < UNEXPLAINED:
        return found
    for i in range(len(found)):
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
        found[i] &= found[i].sum() <= MOST_FREED * len(at)
    return found


def widened(prior: ParameterPrior, freed: Bools) -> ParameterPrior:
    """The prior with some parameters (I, p) practically free."""
    factor = np.where(freed, FREED, 1.0)
    return ParameterPrior(prior.mean, prior.covariance * factor[:, :, None] * factor[:, None, :], prior.held)


def disagreement(calibration: Calibration, freed: Bools) -> tuple[str, ...]:
    """Sentences about the parameters that contradict their prior most, or else the combinations of them.

    Those that were `freed` (I, p) of it are told as such. Two-sided tests at a level shared out over all that is
    tested, parameters and then combinations.
    """
    if not calibration.values.size or calibration.adjustment is None:
        return ()
    prior, rows = (
        calibration.adjustment.problem.prior,
        list(zip(calibration.names, calibration.parameters, strict=True)),
    )
    w = np.where(freed, 0.0, _normalised(calibration, prior.mean)).ravel()
    said = [
        f"{name} is {with_sigma(p.value, p.sigma, p.unit)} by the readings, which contradicts "
        f"its stated prior of {p.prior_sigma:.3g} {p.unit}: the estimate follows the readings"
        for (name, p), is_freed in zip(rows, freed.ravel(), strict=True)
        if is_freed
    ]
    found = _beyond(w)
    if not found:
        return (*said, *_of_combinations(calibration, prior))
    for k in found[:MOST_SAID]:
        name, p = rows[k]
        said.append(
            f"{name}: the readings contradict its prior of {p.prior_sigma:.3g} {p.unit} "
            f"(w = {w[k]:.1f}, estimate {p.value:.3g}); if it may be larger, state it in [instrument.prior.parameters]"
        )
    if len(found) > MOST_SAID:
        said.append(f"{len(found) - MOST_SAID} more parameters contradict their prior")
    return tuple(said)


def _normalised(calibration: Calibration, mean: Floats) -> Floats:
    """Estimates less prior over the standard deviation of that difference (I, p); 0 where the readings are silent.

    The prior is an observation like any other: its residual has the variance of the prior less that of the estimate
    (Baarda's w-test of the prior's row).
    """
    told = calibration.prior_sigma**2 - calibration.sigma**2
    heard = ~calibration.held & (told > SILENT * calibration.prior_sigma**2)
    return np.where(heard, (calibration.values - mean) / np.sqrt(np.where(heard, told, 1.0)), 0.0)


def _beyond(w: Floats) -> list[int]:
    """Places of values that chance does not make, the largest first; zeros were not tested."""
    tested = int(np.count_nonzero(w))
    limit = float(-special.ndtri(LEVEL / (4 * tested))) if tested else np.inf
    return [int(k) for k in np.argsort(-np.abs(w)) if abs(w[k]) > limit]


def _of_combinations(calibration: Calibration, prior: ParameterPrior) -> tuple[str, ...]:
    """A sentence on the combination that contradicts the prior most: in prior sigmas these are independent."""
    size = calibration.construction.size
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
