"""Hypotheses about the noise: some readings scatter more (or less) than stated.

With r a whitened residual of redundancy k, a variance factor s raises the log likelihood by
    (r^2 (1 - 1/s) - k log s) / 2,
summed over readings: the diagonal form of the restricted likelihood (residuals' correlations are second order here).
Sizes are averaged over a grid, so these hypotheses compete with mean shifts by the same evidence.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy.sparse as sp

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.arrays import Floats, Ints
from ltsim.diagnosis.evidence import PRIOR, log_means, shares
from ltsim.diagnosis.hypotheses import Hypothesis
from ltsim.diagnosis.schema import Equivalent
from ltsim.effects import CATALOGUE
from ltsim.effects.effect import NoiseEffect
from ltsim.effects.signature import NoiseSignature
from ltsim.laws.offered import further
from ltsim.laws.places import Place, branches, trackers_of
from ltsim.laws.scatter import EACH_FACE, REPEATS, NoisePattern
from ltsim.recording.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings

EVERYWHERE, GROWING, AT_TARGETS = (0.25, 0.6, 1.5, 4.0, 12.0), (2.0, 6.0, 20.0), (3.0, 15.0)
"""Added variances that are tried, over the stated: of all readings, where a pattern is largest, of some targets. The
fewer readings have them, the larger they must be to be seen."""
MOST_TARGETS = 60
"""Targets up to whose number each is tried on its own, and those that belong together."""
COMPARED = 6
"""Families, the likeliest among them, that are compared."""
LEAST_SHARE = 0.05
"""Redundancy that a mean of repeats has at least."""
LARGEST = 400.0
"""Upper bound of a size in units of its plausible one."""
GRID, REACH, ZOOMS = 7, 4.0, 9
"""Points of the grid on which the posterior of a size is summed, deviations it reaches, and how often it is drawn anew:
sums over a bell curve are exact for spacings up to a deviation and a half, and nine grids shrink to the narrowest one
there is."""


@dataclass(frozen=True)
class NoiseHypothesis:
    """A noise effect with parameter values: one point of its grid of sizes; once told, with deviations and evidence."""

    family: str
    effect: NoiseSignature
    values: tuple[float, ...]
    sigma: tuple[float, ...] = ()
    drop: float = 0.0
    probability: float = 0.0
    equivalents: tuple[Equivalent, ...] = ()


def _patterns(sightings: Sightings, trackers: Sequence[Place]) -> Iterator[tuple[str, NoisePattern, tuple[float, ...]]]:
    """Noise that no effect of the catalogue describes: family, pattern, sizes."""
    known = ["elevation", "distance", "time", "station-time", "move-azimuth", "move-elevation"]
    known += ["incidence"] if np.isfinite(sightings.incidence).any() else []
    single: list[tuple[str, ...]] = [(observable,) for observable in OBSERVABLES]
    places = [NoisePattern(), *(NoisePattern(stations=p.stations, instruments=p.instruments) for p in trackers)]
    for at, acts, name, falling in product(places, single, [*known, *further(sightings)], (False, True)):
        pattern = replace(at, observables=acts, covariates=(name,), falling=falling)
        yield acts[0], pattern, GROWING
    names = sightings.target_names
    groups = [(t,) for t in range(len(names))] + sorted(branches(sightings)) if len(names) <= MOST_TARGETS else []
    for acts in (*single, OBSERVABLES):
        for faces in REPEATS if acts == ("distance",) and np.ptp(sightings.face) else REPEATS[:1]:
            yield "repeating", NoisePattern(acts, repeating=faces), EVERYWHERE
        yield "scatter", NoisePattern(acts), EVERYWHERE
        for group in groups:
            yield "target", NoisePattern(acts, targets=tuple(names[t] for t in group)), AT_TARGETS


def noise_hypotheses(
    sightings: Sightings, instruments: Sequence[str] = (), *, quieter: bool = True
) -> list[NoiseHypothesis]:
    """Every change of the noise that is tried, with a grid of sizes; that of each of several `instruments` too.

    Without `quieter` noise is never less than stated: beside amounts that repeat their differences are small anyhow.
    """
    kinds = [kind for kind in CATALOGUE if issubclass(kind, NoiseEffect)]
    known = [(effect, effect.size_grid()) for kind in kinds for effect in kind.candidates(sightings)]
    found = [NoiseHypothesis(effect.name, effect, values) for effect, sizes in known for values in sizes]
    found = [h for h in found if quieter or min(h.values) >= 0.0]
    for family, pattern, sizes in _patterns(sightings, trackers_of(sightings, instruments)):
        found += [NoiseHypothesis(f"unknown:noise:{family}", pattern, (size,)) for size in sizes]
    return found


@dataclass(frozen=True)
class NoiseBank:
    """Noise hypotheses as linear forms of squares of residuals, and of squares of their means over repeats.

    Attributes
    ----------
    gain, logs : (h, m + g) csr float32
        1 - 1/s and log s of each row; of each mean for what repeats.
    means : (g, m) csr float
        What adds up repeats, in each face and then in both.
    """

    hypotheses: list[NoiseHypothesis]
    families: tuple[str, ...]
    family: Ints
    gain: sp.csr_array
    logs: sp.csr_array
    means: sp.csr_array

    @classmethod
    def of(cls, space: ResidualSpace, hypotheses: Sequence[NoiseHypothesis]) -> NoiseBank:
        """Build the bank on a residual space."""
        repeated = [repeat_means(space, faces) for faces in REPEATS]
        means = sp.csr_array(sp.vstack(repeated))
        used, stated = space.use, space.sigma**2
        parts: list[tuple[Ints, Floats]] = []
        for h in hypotheses:
            factor = (h.effect.variance(space.sightings, space.sigma, np.array(h.values)) / stated)[used]
            if faces := getattr(h.effect, "repeating", ""):
                grown = [
                    _grown(m, factor if kind == faces else np.ones(0))
                    for kind, m in zip(REPEATS, repeated, strict=True)
                ]
                factor = np.concatenate([np.ones(space.size), *grown])
            rows = np.flatnonzero(factor != 1.0)
            parts.append((rows, factor[rows]))
        ends = np.cumsum([0, *(len(rows) for rows, _ in parts)])
        places, factors = (np.concatenate(x) if x else np.zeros(0) for x in zip(*parts, strict=True))
        gain, logs = (
            sp.csr_array((values.astype(np.float32), places, ends), (len(parts), space.size + means.shape[0]))
            for values in (1.0 - 1.0 / factors, np.log(factors))
        )
        names = tuple(dict.fromkeys(h.family for h in hypotheses))
        index = {name: i for i, name in enumerate(names)}
        family = np.array([index[h.family] for h in hypotheses], dtype=np.int64)
        return cls(list(hypotheses), names, family, gain, logs, means)

    def log_likelihood_ratio(self, residual: Floats, redundancy: Floats) -> Floats:
        """(h, trials) for whitened residuals (m, trials) of a redundancy (m,)."""
        squares = np.vstack([residual**2, (self.means @ residual) ** 2]).astype(np.float32)
        share = np.concatenate([redundancy, _share_of_means(self.means, redundancy)])
        ratio: Floats = 0.5 * ((self.gain @ squares).astype(np.float64) - (self.logs @ share)[:, None])
        return ratio

    def family_evidence(self, residual: Floats, redundancy: Floats) -> Floats:
        """Log evidence (families, trials) with priors."""
        known = np.array([not f.startswith("unknown") for f in self.families])
        share = np.where(known, PRIOR["noise"] / max(known.sum(), 1), PRIOR["scatter"] / max((~known).sum(), 1))
        ratio = self.log_likelihood_ratio(residual, redundancy)
        return log_means(ratio, self.family, len(self.families)) + np.log(share)[:, None]

    def rivals(self, residual: Floats, redundancy: Floats) -> list[Hypothesis]:
        """The first hypothesis of each family in a search's terms, with the evidence of all."""
        values = self.family_evidence(residual[:, None], redundancy)[:, 0]
        firsts = (self.hypotheses[int(np.argmax(self.family == f))].effect for f in range(len(self.families)))
        return [Hypothesis(effect, 0.0, float(v), effect.name) for effect, v in zip(firsts, values, strict=True)]

    def best(self, residual: Floats, redundancy: Floats) -> list[tuple[float, NoiseHypothesis]]:
        """Families in the order of their evidence, each with its likeliest hypothesis."""
        evidence = self.family_evidence(residual[:, None], redundancy)[:, 0]
        ratio = self.log_likelihood_ratio(residual[:, None], redundancy)[:, 0]
        found = []
        for family in np.argsort(-evidence)[:COMPARED]:
            members = np.flatnonzero(self.family == family)
            found.append((float(evidence[family]), self.hypotheses[members[int(np.argmax(ratio[members]))]]))
        return found


def repeat_means(space: ResidualSpace, faces: str = EACH_FACE) -> sp.csr_array:
    """Rows (g, m) that add up readings of one kind, target, station and perhaps face, over the root of their number."""
    s = space.sightings
    pair = 2 * (s.station * len(s.target_names) + s.target) + ((s.face == 2) & (faces == EACH_FACE))
    key = (3 * pair[:, None] + np.arange(3))[space.use]
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)
    keep = count[group] > 1
    _, number = np.unique(group[keep], return_inverse=True)
    places = np.flatnonzero(keep)
    shape = (int(number.max(initial=-1)) + 1, space.size)
    return sp.csr_array((1.0 / np.sqrt(count[group[keep]]), (number, places)), shape)


def _share_of_means(means: sp.csr_array, share: Floats) -> Floats:
    """Redundancy (g,) of means: an error common to repeats is absorbed as much as their sum of leverages says."""
    lost = (means > 0).astype(np.float64) @ (1.0 - share)
    return np.maximum(1.0 - lost, LEAST_SHARE)


def _grown(means: sp.csr_array, factor: Floats) -> Floats:
    """Variance (g,) of means whose members share what is above the stated variance: 1 + k v."""
    padded = np.concatenate([factor, np.ones(means.shape[1] - len(factor))])
    return 1.0 + np.maximum((means > 0).astype(np.float64) @ (padded - 1.0), 0.0)


def most_likely(space: ResidualSpace, stated: Floats, hypothesis: NoiseHypothesis) -> NoiseHypothesis:
    """A hypothesis with its sizes, their deviations, and twice the log ratio of the restricted likelihood.

    Variances are those of the hypothesis on the `stated` (n, 3) ones; residuals are whitened by the space's own. Sizes
    and deviations are those of the posterior, since the likelihood of a variance is skew and ends at zero; a priori all
    factors on a variance are alike, by their logarithm. Each reading follows one size at most, so that each size has a
    posterior of its own.
    """
    effect, used = hypothesis.effect, space.use
    faces = getattr(effect, "repeating", "")
    means = repeat_means(space, faces) if faces else None
    share = space.redundancy[: int(used.sum())] if means is None else _share_of_means(means, space.redundancy)
    squares = space.residual[: len(share)] ** 2 if means is None else (means @ space.residual) ** 2

    def factors(values: Floats) -> Floats:
        factor = (effect.variance(space.sightings, stated, values) / space.sigma**2)[used]
        return factor if means is None else _grown(means, factor)

    scale = np.array([p.prior_sigma for p in effect.parameters])
    own = np.argmax([factors(one) != factors(0.0 * scale) for one in np.diag(scale)], axis=0)

    def gains(values: Floats) -> Floats:
        factor = factors(values)
        with np.errstate(invalid="ignore", divide="ignore"):
            each = np.where(factor > 0.0, squares * (1 - 1 / factor) - share * np.log(factor), -np.inf)
        return np.array([each[own == i].sum() for i in range(len(scale))])

    least, most = np.full(len(scale), np.log1p(effect.least)), np.full(len(scale), np.log1p(LARGEST))
    low, high = least, most
    for _ in range(ZOOMS):
        points = np.linspace(low, high, GRID)
        sizes = scale * np.expm1(points)
        weight = shares(0.5 * np.array([gains(one) for one in sizes]))
        mean = np.sum(weight * points, axis=0)
        spread = np.sqrt(np.sum(weight * (points - mean) ** 2, axis=0))
        spread = np.maximum(spread, 0.4 * (high - low) / (GRID - 1))
        low, high = np.maximum(least, mean - REACH * spread), np.minimum(most, mean + REACH * spread)
    values = np.sum(weight * sizes, axis=0)
    sigma = np.sqrt(np.sum(weight * (sizes - values) ** 2, axis=0))
    drop = float(gains(values).sum())
    return replace(hypothesis, values=tuple(values.tolist()), drop=drop, sigma=tuple(sigma.tolist()))
