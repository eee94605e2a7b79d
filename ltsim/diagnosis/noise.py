"""Hypotheses of the noise: some readings scatter more (or less) than declared.

Let r be the whitened residuals, Q an orthonormal basis of the estimated parameters, s the variance factors, and W the
diagonal matrix of 1 - 1/s. The restricted likelihood ratio is exactly
    log L = [ r' W r + c' N^-1 c - log|N| - sum log s ] / 2,   N = 1 - Q' W Q,   c = Q' W r.
All hypotheses are screened by the diagonal form, the sum of (r^2 W - k log s) / 2 over readings with redundancy k. This
is the same for the recording and for simulated recordings. The best hypotheses are evaluated without approximation, if
the network is small enough for a basis. The evidence is an average over a grid of sizes, a fine one for the best
hypotheses. It can therefore be compared with the evidence of effects that shift readings.

Shapes below: m rows of the residual space, g means of repeated readings, h hypotheses, and trials (the recording, or
simulated recordings).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
import scipy.sparse as sp
from scipy.special import expit

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.significance import MAX_CHANCE_SIGMAS
from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import Floats, Ints, Singles, batches
from ltsim.diagnosis.evidence import (
    MAX_AVERAGED_HYPOTHESES,
    N_REFINED,
    log_means_by_group,
    log_restricted_likelihood_ratio,
    normalised_probabilities,
)
from ltsim.diagnosis.noise_centring import estimate_centring
from ltsim.diagnosis.noise_factors import NoiseFactors, VariancePattern
from ltsim.diagnosis.noise_groups import (
    GROUP_VARIANCE_FACTORS,
    NOISY_GROUP_FRACTIONS,
    TAIL_VARIANCE_FACTORS,
    GroupNoise,
    NoiseByGroup,
    RecordingNoiseLevel,
)
from ltsim.diagnosis.noise_hypothesis import NoiseHypothesis as NoiseHypothesis, log_prior_of_noise_family
from ltsim.diagnosis.noise_patterns import variance_functions
from ltsim.diagnosis.noise_windows import NoiseWindows
from ltsim.diagnosis.repeats import redundancy_of_means, relative_variance_of_means, repeat_means
from ltsim.physics.effects import CATALOGUE
from ltsim.physics.effects.effect import NoiseEffect
from ltsim.physics.effects.linear_effect import CandidateNoiseEffect
from ltsim.physics.effects.noise_level import NoiseLevel
from ltsim.physics.laws.centring import CentringVariance
from ltsim.physics.laws.places import instrument_places
from ltsim.physics.laws.variance import REPETITION_KINDS, VarianceFunction
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings
from ltsim.solve.projection import BasisResidualProjector

MIN_COMPARABLE_EVIDENCE_FRACTION = 0.2
"""Fraction of the largest log evidence. Noise in windows of time with more evidence is also sought at single places."""
N_FINE_SIZES = 48
"""Number of sizes of the fine grid over which the evidence of the best hypotheses is averaged."""
N_VARIANCE_GRID_VALUES = 7
"""Number of points of each grid on which the posterior distribution of a size is summed."""
N_GRID_ZOOMS = 9
"""Number of grids, each narrower, on which the posterior of a size is summed. The sum over a normal density is accurate
for spacings of up to 1.5 standard deviations."""


def noise_hypotheses(sightings: Sightings, instruments: Sequence[str] = ()) -> list[NoiseHypothesis]:
    """Changes of the noise that have one size, each at the sizes of a grid.

    `instruments` are the names of the instruments, each of which may have separate noise if there are several.
    """
    kinds = [kind for kind in CATALOGUE if issubclass(kind, NoiseEffect) and kind is not NoiseLevel]
    effects = [(effect, effect.size_grid()) for kind in kinds for effect in kind.candidates(sightings)]
    hypotheses = [NoiseHypothesis(effect.name, effect, values) for effect, sizes in effects for values in sizes]
    for family, pattern, sizes in variance_functions(sightings, instrument_places(sightings, instruments)):
        hypotheses += [NoiseHypothesis(f"unknown:noise:{family}", pattern, (size,)) for size in sizes]
    return hypotheses


@dataclass(frozen=True)
class NoiseBank:
    """Noise hypotheses on a residual space, with their evidence for the recording and for simulated recordings.

    The evidence is a linear form of squared residuals, and of squared means of repeated readings.
    """

    hypotheses: list[NoiseHypothesis]
    """Hypotheses with one size, h of them."""
    families: tuple[str, ...]
    """Names of the kinds of noise change (families) of these hypotheses."""
    family_index: Ints
    """Index (h,) of the family of each hypothesis."""
    factors: NoiseFactors
    """Variance factors of the m rows, and of the g means of repeated readings for errors that these have in common."""
    means: sp.csr_array
    """Matrix (g, m) of the means of repeated readings, first in each face and then in both faces."""
    basis: Floats | None
    """Orthonormal basis (m, u) of u estimated parameters; None in a network that is too large for a basis."""
    group_noises: tuple[GroupNoise, ...]
    """Hypotheses with a size for each group: the noise level first, then noise by target and station, and windows."""
    space: ResidualSpace
    """Residual space of the adjustment."""

    @classmethod
    def from_space(
        cls, space: ResidualSpace, hypotheses: Sequence[NoiseHypothesis], *, allows_quieter: bool = True
    ) -> NoiseBank:
        """Noise hypotheses on a residual space. The noise level may be less than declared only if `allows_quieter`."""
        repeat_patterns = [repeat_means(space, faces) for faces in REPETITION_KINDS]
        means = sp.csr_array(sp.vstack(repeat_patterns))
        pattern_counts = space.n_rows - int(space.is_used_reading.sum()), *(m.shape[0] for m in repeat_patterns)
        other_groups = [np.full(size, len(OBSERVABLES) + i) for i, size in enumerate(pattern_counts)]
        factors = NoiseFactors.from_patterns(
            _noise_patterns(space, hypotheses, repeat_patterns),
            np.concatenate([np.nonzero(space.is_used_reading)[1], *other_groups]),
        )
        names = tuple(dict.fromkeys(h.family for h in hypotheses))
        index = {name: i for i, name in enumerate(names)}
        family = np.array([index[h.family] for h in hypotheses], dtype=np.int64)
        basis = space.projector.basis if isinstance(space.projector, BasisResidualProjector) else None
        group_noises = (
            RecordingNoiseLevel.from_space(space, allows_quieter=allows_quieter),
            *NoiseByGroup.all_of(space),
            *NoiseWindows.from_space(space),
        )
        return cls(list(hypotheses), names, family, factors, means, basis, group_noises, space)

    def log_likelihood_ratio(self, residual: Floats, redundancy: Floats) -> Floats:
        """Log likelihood ratio (h, trials) in the diagonal form.

        `residual` (m, trials) are whitened residuals, and `redundancy` (m,) the redundancy numbers.
        """
        squares = np.vstack([residual**2, (self.means @ residual) ** 2]).astype(np.float32)
        share = np.concatenate([redundancy, redundancy_of_means(self.means, redundancy)])
        return self.factors.log_likelihood_ratios(squares, share)

    def family_evidence(self, residual: Floats | Singles, redundancy: Floats) -> Floats:
        """Log evidence (families, trials) with priors in the diagonal form, of `families`, then of `group_noises`."""
        slices = batches(residual.shape[1], len(residual))
        return np.hstack([self._family_evidence(residual[:, part].astype(np.float64), redundancy) for part in slices])

    def _family_evidence(self, residual: Floats, redundancy: Floats) -> Floats:
        patterns = self._log_evidence_by_family(self.log_likelihood_ratio(residual, redundancy))
        return np.vstack(
            [patterns, *(self._group_noise_evidence(change, residual, redundancy) for change in self.group_noises)]
        )

    def _group_noise_evidence(self, change: GroupNoise, residual: Floats, redundancy: Floats) -> Floats:
        return change.log_evidence(residual, redundancy) + self.log_prior_of_family(change.name)

    def log_prior_of_family(self, family: str) -> float:
        """Log prior of a family, which is a change of the noise in the catalogue, or outside it (`unknown`)."""
        return log_prior_of_noise_family(family, (*self.families, *(change.name for change in self.group_noises)))

    def _log_evidence_by_family(self, ratio: Floats) -> Floats:
        share = np.array([self.log_prior_of_family(family) for family in self.families])
        return log_means_by_group(ratio, self.family_index, len(self.families)) + share[:, None]

    def log_restricted_likelihood_ratio(self, index: int, residual: Floats, model_basis: Floats) -> float:
        """Log restricted likelihood ratio of the hypothesis with this index, without approximation.

        `residual` (m,) are the whitened residuals given a model, and `model_basis` (m, e) is the basis of the model.
        """
        assert self.basis is not None
        at, logs = self.factors.log_variance_factors(index)
        weight, size = -np.expm1(-logs), len(residual)
        basis = np.hstack([self.basis, model_basis])
        basis_rows = np.vstack([basis[at[at < size]], self.means[at[at >= size] - size] @ basis])
        values = np.concatenate([residual[at[at < size]], self.means[at[at >= size] - size] @ residual])
        normal = np.eye(basis_rows.shape[1]) - basis_rows.T @ (weight[:, None] * basis_rows)
        products = basis_rows.T @ (weight * values)
        fit = float(weight @ values**2 + products @ np.linalg.solve(normal, products))
        return 0.5 * (fit - float(np.linalg.slogdet(normal)[1]) - float(logs.sum()))

    def _excess_over_diagonal_form(self, index: int, ratio: float, residual: Floats, model_basis: Floats) -> float:
        """Log restricted likelihood ratio of a hypothesis minus its diagonal form `ratio`; 0 in a large network."""
        return 0.0 if self.basis is None else self.log_restricted_likelihood_ratio(index, residual, model_basis) - ratio

    def _fine_log_evidence(
        self, members: Ints, best_member: int, ratio: Floats, residual: Floats, redundancy: Floats
    ) -> float:
        """Log evidence of a kind of noise change, with a fine grid of sizes of its best effect.

        `members` are the indices of the family's hypotheses, `best_member` is the best of them, and `ratio` contains
        their log likelihood ratios. For an effect with several parameters, each alone and all together are averaged.
        """
        effect = self.hypotheses[best_member].effect
        is_same = np.array([self.hypotheses[i].effect == effect for i in members.tolist()])
        size_grid = np.array([self.hypotheses[i].sizes for i in members[is_same].tolist()])
        size_limits = np.where(size_grid > 0.0, size_grid, np.inf).min(axis=0), size_grid.max(axis=0)
        reml_gain = reml_gain_function(self.space, self.space.sigma, effect, residual, redundancy)
        log_evidences = log_sum_exp(
            np.array([reml_gain(sizes) for sizes in np.geomspace(*size_limits, N_FINE_SIZES)])
        ) - np.log(N_FINE_SIZES)
        subsets = [*log_evidences, log_evidences.sum()] if len(log_evidences) > 1 else log_evidences
        fine_evidence = log_sum_exp(np.array(subsets)) + np.log(is_same.sum() / len(subsets))
        return float(log_sum_exp(np.append(ratio[~is_same], fine_evidence)) - np.log(len(members)))

    def ranked_families(
        self, residual: Floats, redundancy: Floats, model_basis: Floats
    ) -> list[tuple[float, NoiseHypothesis]]:
        """Pairs of log evidence (with prior) and best hypothesis of each kind of noise change, the best kind first.

        `residual` (m,), `redundancy` (m,) and the basis `model_basis` (m, e) are those of a model.
        """
        ratio = self.log_likelihood_ratio(residual[:, None], redundancy)
        evidence = self._log_evidence_by_family(ratio)[:, 0]
        ranking = []
        for rank, family in enumerate(np.argsort(-evidence)):
            members = np.flatnonzero(self.family_index == family)
            likeliest = int(members[int(np.argmax(ratio[members, 0]))])
            value = float(evidence[family])
            if rank < N_REFINED:
                value = self._fine_log_evidence(members, likeliest, ratio[members, 0], residual, redundancy)
                value += self.log_prior_of_family(self.families[family])
                value += self._excess_over_diagonal_form(likeliest, float(ratio[likeliest, 0]), residual, model_basis)
            ranking.append((value, self.hypotheses[likeliest]))
        for change, value in self.ranked_group_noise(residual, redundancy, max(0.0, *(value for value, _ in ranking))):
            effect = change.most_likely_effect(residual, redundancy)
            ranking.append((value, NoiseHypothesis(change.name, effect, (0.0,) * len(effect.parameters))))
        return sorted(ranking, key=lambda entry: -entry[0])

    def expected_factors(self) -> Floats:
        """Posterior mean (n, 3) of the variance factors of the readings over all hypotheses and no change.

        The mean of a variance s has the smallest expected loss s/t - 1 - log(s/t) of an estimate t (Stein's loss).
        """
        space, residual, redundancy = self.space, self.space.residuals, self.space.redundancy
        values, factors = [0.0], [np.ones(space.sigma.shape)]
        for hypothesis, value in self._ranked_patterns(residual, redundancy):
            sizes = np.array(most_likely_sizes(space, space.sigma, hypothesis).sizes)
            values.append(value)
            factors.append(hypothesis.effect.variance(space.sightings, space.sigma, sizes) / space.sigma**2)
        n_readings = np.count_nonzero(space.is_used_reading)
        for change, value in self.ranked_group_noise(residual, redundancy, max(values)):
            values.append(value)
            factors.append(np.ones(space.sigma.shape))
            factors[-1][space.is_used_reading] = change.expected_factors(residual, redundancy)[:n_readings]
        mean_factors = np.einsum("k,kij->ij", normalised_probabilities(np.array(values)), np.stack(factors))
        return np.nan_to_num(mean_factors, nan=1.0)

    def _ranked_patterns(self, residual: Floats, redundancy: Floats) -> list[tuple[NoiseHypothesis, float]]:
        """Most probable patterns of noise, each at its best size, with the log evidence summed over its sizes."""
        ratio = self.log_likelihood_ratio(residual[:, None], redundancy)[:, 0]
        prior = np.array([self.log_prior_of_family(name) for name in self.families])
        prior -= np.log(np.bincount(self.family_index))
        members: dict[CandidateNoiseEffect, list[int]] = {}
        for i, hypothesis in enumerate(self.hypotheses):
            members.setdefault(hypothesis.effect, []).append(i)
        log_evidence = ratio + prior[self.family_index]
        evidence = np.array([float(log_sum_exp(log_evidence[same])) for same in members.values()])
        none, groups, ranked = np.zeros((len(residual), 0)), list(members.values()), []
        for i in np.argsort(-evidence)[:MAX_AVERAGED_HYPOTHESES]:
            best = groups[i][int(np.argmax(ratio[groups[i]]))]
            excess = self._excess_over_diagonal_form(best, float(ratio[best]), residual, none)
            ranked.append((self.hypotheses[best], float(evidence[i]) + excess))
        return ranked

    def ranked_group_noise(self, residual: Floats, redundancy: Floats, rival: float) -> list[tuple[GroupNoise, float]]:
        """Changes of the noise by group or window with log evidence; at single places too if not far below `rival`."""
        ranked_hypotheses = [
            (change, self._log_evidence_of_group_noise(change, residual, redundancy)) for change in self.group_noises
        ]
        least = max(rival, *(value for _, value in ranked_hypotheses)) * MIN_COMPARABLE_EVIDENCE_FRACTION
        places = [
            x
            for change, value in ranked_hypotheses
            if value > least
            for x in change.noise_at_best_place(residual, redundancy)
        ]
        return ranked_hypotheses + [
            (place, self._log_evidence_of_group_noise(place, residual, redundancy)) for place in places
        ]

    def _log_evidence_of_group_noise(self, change: GroupNoise, residual: Floats, redundancy: Floats) -> float:
        return float(self._group_noise_evidence(change, residual[:, None], redundancy)[0])


def _noise_patterns(
    space: ResidualSpace, hypotheses: Sequence[NoiseHypothesis], mean_patterns: Sequence[sp.csr_array]
) -> Iterator[VariancePattern]:
    """Iterator over patterns: the added variance of the readings per unit of the size, and the sizes.

    For errors that repeated readings have in common, the pattern contains the means of these readings
    (`mean_patterns`). A variance function has one pattern, because it is linear in its size. A catalogue effect has one
    pattern for each size.
    """
    used, variance = space.is_used_reading, space.sigma**2
    for effect, same in groupby(hypotheses, key=lambda h: h.effect):
        sizes = [h.sizes for h in same]
        linear = isinstance(effect, VarianceFunction)
        for values in [(1.0,)] if linear else sizes:
            added = (effect.variance(space.sightings, space.sigma, np.array(values)) / variance)[used] - 1.0
            if faces := getattr(effect, "repetition", ""):
                grown = (
                    relative_variance_of_means(m, added if kind == faces else np.zeros(0))
                    for kind, m in zip(REPETITION_KINDS, mean_patterns, strict=True)
                )
                added = np.concatenate([np.zeros(space.n_rows), *grown])
            yield added, tuple(size for (size,) in sizes) if linear else (1.0,)


def reml_gain_function(
    space: ResidualSpace, sigma: Floats, effect: CandidateNoiseEffect, residual: Floats, redundancy: Floats
) -> Callable[[Floats], Floats]:
    """Function from the sizes (k,) of k variance parameters to the gain (k,) of restricted log likelihood by each.

    Each reading depends on one parameter at most. The effect changes the standard deviations `sigma` (n, 3), while the
    residuals (m,) are whitened by the standard deviations of the space.
    """
    faces, used, scale = getattr(effect, "repetition", ""), space.is_used_reading, effect.size_scales
    means = repeat_means(space, faces) if faces else None
    share = redundancy[: int(used.sum())] if means is None else redundancy_of_means(means, redundancy)
    squares = residual[: len(share)] ** 2 if means is None else (means @ residual) ** 2

    def factors(values: Floats) -> Floats:
        factor = (effect.variance(space.sightings, sigma, values) / space.sigma**2)[used]
        return factor if means is None else 1.0 + relative_variance_of_means(means, factor - 1.0)

    parameter = np.argmax([factors(unit) != factors(0.0 * scale) for unit in np.diag(scale)], axis=0)

    def gain(values: Floats) -> Floats:
        factor = factors(values)
        with np.errstate(invalid="ignore", divide="ignore"):
            each = np.where(factor > 0.0, log_restricted_likelihood_ratio(squares, share, factor), -np.inf)
        return np.asarray(np.bincount(parameter, each, minlength=len(scale)), dtype=np.float64)

    return gain


def _tail_with_variances(hypothesis: NoiseHypothesis, reml_gain: Callable[[Floats], Floats]) -> NoiseHypothesis:
    """Hypothesis of a heavy tail with the variance of each reading, which is the inverse of its expected weight.

    Let p be the probability that a reading is in the tail, where its variance is multiplied by a factor f. Its expected
    weight is (1 - p) + p E[1 / f], as in the EM algorithm for scale mixtures (Little 1988, Applied Statistics 37, 23).
    The fraction of readings in the tail is the one with the largest likelihood.
    """
    n_parameters = len(hypothesis.effect.parameters)
    base_gain = reml_gain(np.zeros(n_parameters))
    log_gains = np.stack([reml_gain(np.full(n_parameters, f - 1.0)) - base_gain for f in TAIL_VARIANCE_FACTORS])
    ratio = log_sum_exp(log_gains) - np.log(len(TAIL_VARIANCE_FACTORS))
    likelihood = [np.logaddexp(np.log1p(-q), np.log(q) + ratio).sum() for q in NOISY_GROUP_FRACTIONS]
    q = float(NOISY_GROUP_FRACTIONS[int(np.argmax(likelihood))])
    inside = expit(ratio + np.log(q / (1.0 - q)))
    probabilities = np.exp(log_gains - log_sum_exp(log_gains))
    weight = 1.0 - inside + inside * (probabilities / TAIL_VARIANCE_FACTORS[:, None]).sum(axis=0)
    values = 1.0 / weight - 1.0
    drop, sigma = 2.0 * float((reml_gain(values) - base_gain).sum()), np.sqrt(2.0) * (1.0 + values)  # one reading each
    return replace(hypothesis, sizes=tuple(values.tolist()), chi2_drop=drop, size_sigmas=tuple(sigma.tolist()))


def most_likely_sizes(space: ResidualSpace, nominal_sigma: Floats, hypothesis: NoiseHypothesis) -> NoiseHypothesis:
    """Hypothesis with estimated sizes, their standard deviations, and twice the log restricted likelihood ratio.

    The hypothesis changes the standard deviations `nominal_sigma` (n, 3). The estimates are posterior means and
    standard deviations with a log-uniform prior of the variance factor, because the likelihood of a variance is skew.
    The posteriors of several sizes are independent (`reml_gain_function`). A size on which no reading depends is 0 with
    an infinite standard deviation.
    """
    effect, scale = hypothesis.effect, hypothesis.effect.size_scales
    if isinstance(effect, CentringVariance):
        return estimate_centring(space, hypothesis)
    reml_gain = reml_gain_function(space, nominal_sigma, effect, space.residuals, space.redundancy)
    if getattr(effect, "group_kind", "") == "reading":
        return _tail_with_variances(hypothesis, reml_gain)
    least, most = (
        np.full(len(scale), np.log1p(effect.min_relative_size)),
        np.full(len(scale), np.log1p(GROUP_VARIANCE_FACTORS.max())),
    )
    low, high = least, most
    for _ in range(N_GRID_ZOOMS):
        points = np.linspace(low, high, N_VARIANCE_GRID_VALUES)
        sizes = scale * np.expm1(points)
        ratio = np.array([reml_gain(size) for size in sizes])
        weight, felt = normalised_probabilities(ratio), np.ptp(ratio, axis=0) > 0.0
        mean = np.sum(weight * points, axis=0)
        spread = np.sqrt(np.sum(weight * (points - mean) ** 2, axis=0))
        spread = np.maximum(spread, 0.4 * (high - low) / (N_VARIANCE_GRID_VALUES - 1))
        low, high = (
            np.maximum(least, mean - MAX_CHANCE_SIGMAS * spread),
            np.minimum(most, mean + MAX_CHANCE_SIGMAS * spread),
        )
    values = np.where(felt, np.sum(weight * sizes, axis=0), 0.0)
    sigma = np.where(felt, np.sqrt(np.sum(weight * (sizes - values) ** 2, axis=0)), np.inf)
    gain = reml_gain(values) - reml_gain(0.0 * scale)
    if getattr(effect, "group_kind", ""):  # most groups have none: weighted by the probability that there is one
        values = values * expit(gain + np.log(NOISY_GROUP_FRACTIONS.min() / (1.0 - NOISY_GROUP_FRACTIONS.min())))
        gain = reml_gain(values) - reml_gain(0.0 * scale)
    drop = 2.0 * float(gain.sum())
    return replace(hypothesis, sizes=tuple(values.tolist()), chi2_drop=drop, size_sigmas=tuple(sigma.tolist()))
