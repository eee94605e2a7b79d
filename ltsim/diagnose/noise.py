"""Hypotheses about the noise: some readings scatter more (or less) than stated.

With r a whitened residual of redundancy k, a variance factor s raises the log likelihood by
    (r^2 (1 - 1/s) - k log s) / 2,
summed over readings: the diagonal form of the restricted likelihood (residuals' correlations are second order here).
Sizes are averaged over a grid, so these hypotheses compete with mean shifts by the same evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from scipy.optimize import minimize_scalar
from scipy.special import expit

from ltsim.adjust.residual_space import ResidualSpace
from ltsim.arrays import Floats, Ints, Singles
from ltsim.diagnose.bank import sparse_rows
from ltsim.diagnose.evidence import carried_by, log_means
from ltsim.diagnose.flexible import further
from ltsim.diagnose.repeats import deciding_repeats, repeats
from ltsim.effects.signature import NoiseSignature, Parameter
from ltsim.recording.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class NoisePattern(NoiseSignature):
    """Noise of one observable that grows with a covariate, or is larger at one target: not in the catalogue.

    variance = sigma^2 (1 + value * pattern), the pattern running from 0 to 1 over the network.
    """

    stations: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    observable: str = "distance"
    covariate_name: str = ""
    falling: bool = False
    repeating: bool = False

    name = "unknown"
    parameters = (Parameter("added-variance", "", "variance added where the pattern is 1, over the stated", 3.0),)

    @property
    def observables(self) -> tuple[str, ...]:
        """What scatters."""
        return (self.observable,) if self.observable else OBSERVABLES

    @property
    def covariates(self) -> tuple[str, ...]:
        """What the scatter depends on."""
        return (self.covariate_name,) if self.covariate_name else ()

    @property
    def law(self) -> str:
        """What the noise does, in words."""
        if self.repeating:
            return "amounts without a visible law that repeat when a target is measured again"
        if not self.covariate_name:
            return "larger noise"
        return f"noise that {'falls' if self.falling else 'grows'} with {self.covariate_name}"

    def variance(self, sightings: Sightings, sigma: Floats, values: Floats) -> Floats:
        """Variance (n, 3)."""
        pattern = self.mask(sightings)
        if self.covariate_name:
            x = sightings.quantities[self.covariate_name]
            x = (x - x.min()) / max(float(np.ptp(x)), 1e-12)
            pattern = pattern * ((1 - x) if self.falling else x) ** 2
        acts = [float(o in self.observables) for o in OBSERVABLES]
        grown: Floats = sigma**2 * (1.0 + values[0] * pattern[:, None] * np.array(acts))
        return grown


@dataclass(frozen=True)
class NoiseHypothesis:
    """A noise effect with parameter values: one point of its grid of sizes."""

    family: str
    effect: NoiseSignature
    values: tuple[float, ...]
    known: bool = True
    sigma: tuple[float, ...] = ()
    drop: float = 0.0
    probability: float = 0.0
    equivalents: tuple[tuple[str, float], ...] = ()
    separate_by: str = ""


def pattern_hypotheses(sightings: Sightings) -> Iterator[NoiseHypothesis]:
    """Noise that no effect of the catalogue describes."""
    names = ["elevation", "time"] + (["incidence"] if np.isfinite(sightings.incidence).any() else [])
    names += further(sightings)
    for observable in OBSERVABLES:
        for name in names:
            for falling in (False, True):
                for size in (2.0, 6.0, 20.0):
                    effect = NoisePattern((), (), observable, name, falling)
                    yield NoiseHypothesis(f"unknown:noise:{observable}", effect, (size,), False)
    if len(sightings.target_names) <= 60:
        for target in sightings.target_names:
            for observable in (*OBSERVABLES, ""):
                for size in (3.0, 15.0):
                    effect = NoisePattern((), (target,), observable)
                    yield NoiseHypothesis("unknown:noise:target", effect, (size,), False)


SPARSE = 0.2
"""Share of nonzeros from which a matrix is a dense one."""


@dataclass(frozen=True)
class NoiseBank:
    """Noise hypotheses as linear forms of squared residuals.

    Attributes
    ----------
    gain : (h, m) float32
        1 - 1/s of each row; sparse where most hypotheses are about few readings.
    cost : (h,) float
        Sum of redundancy times log s.
    """

    hypotheses: list[NoiseHypothesis]
    families: tuple[str, ...]
    family: Ints
    gain: Singles | sp.csr_array
    cost: Floats

    @classmethod
    def of(cls, space: ResidualSpace, hypotheses: Sequence[NoiseHypothesis]) -> NoiseBank:
        """Build the bank on a residual space."""
        share = space.redundancy
        used, stated = space.use, space.sigma**2
        cost = np.zeros(len(hypotheses))
        parts: list[tuple[Ints, Singles]] = []
        for i, h in enumerate(hypotheses):
            factor = (h.effect.variance(space.sightings, space.sigma, np.array(h.values)) / stated)[used]
            rows = np.flatnonzero(factor != 1.0).astype(np.int64)
            parts.append((rows, (1.0 - 1.0 / factor[rows]).astype(np.float32)[None]))
            cost[i] = float(share[rows] @ np.log(factor[rows]))
        gain = sparse_rows(parts, space.size)
        if gain.nnz > SPARSE * len(hypotheses) * space.size:
            gain = gain.toarray()
        names = tuple(dict.fromkeys(h.family for h in hypotheses))
        index = {name: i for i, name in enumerate(names)}
        family = np.array([index[h.family] for h in hypotheses], dtype=np.int64)
        return cls(list(hypotheses), names, family, gain, cost)

    def log_likelihood_ratio(self, residual: Floats) -> Floats:
        """(h,) or (h, trials) for whitened residuals (m,) or (m, trials)."""
        squares = (residual**2).astype(np.float32)
        cost = self.cost if residual.ndim == 1 else self.cost[:, None]
        ratio: Floats = 0.5 * ((self.gain @ squares).astype(np.float64) - cost)
        return ratio

    def family_evidence(self, ratio: Floats) -> Floats:
        """Log evidence (families, ...) from log likelihood ratios (h, ...)."""
        if not self.families:
            return np.zeros((0, *ratio.shape[1:]))
        return log_means(ratio, self.family, len(self.families))

    def best(self, space: ResidualSpace, ratio: Floats, prior: Floats, residual: Floats) -> NoiseHypothesis:
        """The most probable hypothesis with its size at the maximum of the likelihood.

        Parameters
        ----------
        ratio : (h,) float
            Log likelihood ratios.
        prior : (families,) float
            Log prior odds.
        residual : (m,) float
            The whitened residuals they belong to.
        """
        rows = []
        for family in np.argsort(-(self.family_evidence(ratio) + prior))[:PROFILED]:
            members = np.flatnonzero(self.family == family)
            chosen = self.hypotheses[members[int(np.argmax(ratio[members]))]]
            values, drop, sigma = _most_likely(space, space.sigma, chosen, residual)
            profiled = replace(chosen, values=values, sigma=sigma, drop=drop)
            acting = np.abs(_factor(space, profiled) - 1.0) > 1e-3
            spent = len(values) * np.log(max(float((acting & space.use).sum()), 2.0))
            cost = np.log(len({h.effect for h in self._of(int(family))}))
            evidence = 0.5 * (drop - spent) - cost + float(prior[family])
            rows.append((evidence, profiled))
        rows.sort(key=lambda row: -row[0])
        weight = np.exp(np.array([row[0] for row in rows]) - rows[0][0])
        total: dict[str, float] = {}
        for (_, found), w in zip(rows, weight / weight.sum(), strict=True):
            total[found.effect.name] = total.get(found.effect.name, 0.0) + float(w)
        best = rows[0][1]
        name = best.effect.name
        factor = _factor(space, best)
        doubt = _doubt(space, factor, residual)
        total = {n: p * (1.0 - doubt) for n, p in total.items()}
        total["unknown"] = total.get("unknown", 0.0) + doubt
        if doubt > 0.5:
            best, name = _repeating(space, best, factor, residual), "unknown"
        others = sorted(((n, p) for n, p in total.items() if n != name and p > 0.01), key=lambda e: -e[1])
        advice = deciding_repeats(space, factor, best.effect.stations) if doubt > 0.0 else ""
        return replace(best, probability=total[name], equivalents=tuple(others[:3]), separate_by=advice)

    def _of(self, family: int) -> list[NoiseHypothesis]:
        return [h for h, f in zip(self.hypotheses, self.family, strict=True) if f == family]


LOOKS_LIKE_NOISE = 0.15
"""Odds of a law that changes from pointing to pointing against noise that looks like it; the same if it repeats."""
QUIETER = 0.9
"""Factor on a variance below which the stated noise is wrong, whatever else."""


def _factor(space: ResidualSpace, hypothesis: NoiseHypothesis) -> Floats:
    """Variance (n, 3) of a hypothesis over that of the space."""
    variance = hypothesis.effect.variance(space.sightings, space.sigma, np.array(hypothesis.values))
    return np.asarray(variance / space.sigma**2)


def _doubt(space: ResidualSpace, factor: Floats, residual: Floats) -> float:
    """Probability that larger noise is a law; a law makes no reading quieter than stated."""
    if float(factor[space.use].min()) < QUIETER:
        return 0.0
    return float(expit(np.log(LOOKS_LIKE_NOISE) + np.logaddexp(0.0, repeats(space, factor, residual))))


def _repeating(space: ResidualSpace, hypothesis: NoiseHypothesis, factor: Floats, residual: Floats) -> NoiseHypothesis:
    """The same scatter as physics without a name: where it is, and in which observable."""
    used, share = space.use, space.redundancy[: int(space.use.sum())]
    gain = residual[: len(share)] ** 2 * (1 - 1 / factor[used]) - share * np.log(factor[used])
    observable = "".join(carried_by(used, gain))
    effect = NoisePattern(hypothesis.effect.stations, hypothesis.effect.targets, observable, repeating=True)
    added = max(float(factor[used].max()) - 1.0, 0.1)
    found = NoiseHypothesis("unknown:noise:repeating", effect, (added,), False)
    values, drop, sigma = _most_likely(space, space.sigma, found, residual)
    return replace(found, values=values, drop=drop, sigma=sigma)


PROFILED = 8
"""Families whose sizes are profiled before they are compared."""


LARGEST = 400.0
"""Upper bound of a parameter in units of its prior sigma."""


def remeasured(space: ResidualSpace, stated: Floats, hypothesis: NoiseHypothesis) -> NoiseHypothesis:
    """A hypothesis with its sizes estimated in an adjustment that is weighted by it already.

    Repeated, this ends at the restricted maximum likelihood (Foerstner 1979): residuals of other readings no longer
    water down what the noisy ones say.

    Parameters
    ----------
    space : ResidualSpace
        Of an adjustment with the variances of the hypothesis.
    stated : (n, 3) float
        Standard deviations without it.
    """
    values, _, sigma = _most_likely(space, stated, hypothesis, space.residual)
    return replace(hypothesis, values=values, sigma=sigma)


def _most_likely(
    space: ResidualSpace, stated: Floats, hypothesis: NoiseHypothesis, residual: Floats
) -> tuple[tuple[float, ...], float, tuple[float, ...]]:
    """Sizes, twice the log ratio of the restricted likelihood at its maximum, standard deviations.

    Variances are those of the hypothesis on the `stated` (n, 3) ones; the residuals are whitened by the space's own.

    The maximum is found by moving every parameter of the effect in turn; sizes and standard deviations are those of the
    posterior around it, since the likelihood of a variance is skew and ends at zero.
    """
    used = space.use
    share = space.redundancy[: int(used.sum())]
    squares = residual[: len(share)] ** 2

    def gain(values: Floats) -> float:
        variance = hypothesis.effect.variance(space.sightings, stated, values)
        factor = (variance / space.sigma**2)[used]
        if float(factor.min()) <= 0.0:
            return -np.inf
        return float(squares @ (1 - 1 / factor) - share @ np.log(factor))

    values = np.array(hypothesis.values, dtype=np.float64)
    scale = np.array([p.prior_sigma for p in hypothesis.effect.parameters])
    for _ in range(3):
        for k in range(len(values)):

            def lost(log_size: float, at: int = k) -> float:
                tried = values.copy()
                tried[at] = scale[at] * (np.exp(log_size) - 1.0)
                return -gain(tried)

            bounds = (np.log1p(hypothesis.effect.least), np.log1p(LARGEST))
            found = minimize_scalar(lost, bounds=bounds, method="bounded")
            if -found.fun > gain(values):
                values[k] = scale[k] * (np.exp(found.x) - 1.0)
    reach = np.array([_reach(gain, values, k, scale[k]) for k in range(len(values))])
    least = hypothesis.effect.least * scale
    mean, sigma = _posterior(lambda v: gain(v) - 2.0 * float(np.log1p(v / scale).sum()), values, reach, least)
    return tuple(mean.tolist()), gain(values), tuple(sigma.tolist())


def _reach(gain: Callable[[Floats], float], values: Floats, k: int, scale: float) -> float:
    """How far upward a parameter can go before its likelihood falls by a factor of e^-2 (two standard deviations)."""
    top, step = gain(values), 0.05 * max(abs(float(values[k])), 0.2 * scale)
    while step < LARGEST * scale:
        tried = values.copy()
        tried[k] += step
        if gain(tried) < top - 4.0:
            return step
        step *= 1.5
    return step


GRID = 13
"""Points an axis of the grid on which the posterior of the sizes is summed."""


def _posterior(
    twice_log: Callable[[Floats], float], values: Floats, reach: Floats, least: Floats
) -> tuple[Floats, Floats]:
    """Mean and standard deviation (q,) of sizes above the `least` ones, around the maximum of the likelihood."""
    mean, sigma = values, 0.5 * reach
    for width in (4.0, 4.5):
        low = np.maximum(least, mean - width * sigma)
        axes = [np.linspace(a, b, GRID) for a, b in zip(low, mean + width * sigma, strict=True)]
        points = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
        logs = 0.5 * np.array([twice_log(point) for point in points])
        weight = np.exp(logs - logs.max())
        weight /= weight.sum()
        mean = weight @ points
        sigma = np.sqrt(weight @ (points - mean) ** 2)
    return mean, sigma
