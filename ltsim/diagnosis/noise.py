"""Hypotheses on the noise: some readings scatter more (or less) than declared.

Let r be the whitened residuals, Q an orthonormal basis of the estimated parameters, s the variance factors, and W the
diagonal matrix of 1 - 1/s. The restricted likelihood ratio is exactly
    log L = [ r' W r + c' N^-1 c - log|N| - sum log s ] / 2,   N = 1 - Q' W Q,   c = Q' W r.
All hypotheses are screened by the diagonal form, the sum of (r^2 W - k log s) / 2 over readings with redundancy k. The
same form is used for the recording and for simulated recordings. The hypotheses with the largest evidence are evaluated
without approximation, if the network is small enough for a basis. The evidence is an average over a grid of sizes,
which is finer for these hypotheses. It can therefore be compared with the evidence of effects that shift readings.

Sizes of arrays below: m observation equations, g means of repeated readings, h hypotheses, and trials (the recording,
or simulated recordings).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import scipy.sparse as sp

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import Floats, Floats32, Ints, batches
from ltsim.diagnosis.evidence import (
    MAX_AVERAGED_HYPOTHESES,
    N_EXACTLY_EVALUATED_HYPOTHESES,
    log_mean_exp_by_group,
    log_restricted_likelihood_ratio,
    normalised_probabilities,
)
from ltsim.diagnosis.noise_estimation import reml_gain_function, with_estimated_sizes
from ltsim.diagnosis.noise_factors import VarianceFactors, VariancePatternWithSizes
from ltsim.diagnosis.noise_groups import (
    GroupNoiseHypothesis,
    GroupNoiseMixture,
    RecordingNoiseLevel,
)
from ltsim.diagnosis.noise_hypothesis import NoiseHypothesis, log_prior_of_noise_family
from ltsim.diagnosis.noise_patterns import candidate_variance_functions
from ltsim.diagnosis.noise_windows import NoiseWindows
from ltsim.diagnosis.null_ensemble import parameter_basis_of_small_network
from ltsim.diagnosis.repeats import added_variance_of_means, normalised_sum_matrix_of_repeats, redundancy_of_means
from ltsim.physics.effects import CATALOGUE
from ltsim.physics.effects.effect import NoiseEffect
from ltsim.physics.effects.linear_effect import CandidateNoiseEffect
from ltsim.physics.effects.noise_level import NoiseLevel
from ltsim.physics.laws.places import instrument_places
from ltsim.physics.laws.variance import REPETITION_KINDS, VarianceFunction
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings

MIN_LOG_EVIDENCE_FRACTION_FOR_NOISE_AT_PLACES = 0.2
"""Limit of the log evidence of larger noise in intervals of time, divided by the largest log evidence of another noise.
Above it, such noise is also tried at single stations, groups of targets and regions of the hall."""
N_FINE_GRID_NOISE_SIZES = 48
"""Number of sizes of the changed noise on the fine grid, for the average of the evidence of the best hypotheses."""


def noise_hypotheses(sightings: Sightings, instruments: Sequence[str] = ()) -> list[NoiseHypothesis]:
    """Changes of the noise by one size (factor or added variance) for all affected readings, for a grid of sizes.

    `instruments` are the names of the instruments, each of which may have separate noise if there are several.
    """
    kinds = [kind for kind in CATALOGUE if issubclass(kind, NoiseEffect) and kind is not NoiseLevel]
    effects = [(effect, effect.candidate_parameter_values()) for kind in kinds for effect in kind.candidates(sightings)]
    hypotheses = [NoiseHypothesis(effect.name, effect, values) for effect, sizes in effects for values in sizes]
    for family, pattern, sizes in candidate_variance_functions(sightings, instrument_places(sightings, instruments)):
        hypotheses += [NoiseHypothesis(f"unknown:noise:{family}", pattern, (size,)) for size in sizes]
    return hypotheses


@dataclass(frozen=True)
class NoiseHypothesisSet:
    """Hypotheses of changed noise for an adjustment, with their evidence.

    The evidence is computed for the recording and for simulated recordings. In the diagonal form (independent readings)
    it is a linear function of squared residuals and of squared means of repeated readings.
    """

    hypotheses: list[NoiseHypothesis]
    """Changed noise levels, h of them, each with one size (factor or added variance) for all affected readings."""
    family_names: tuple[str, ...]
    """Names of the families (kinds of changed noise level) in `hypotheses`."""
    family_indices: Ints
    """Index (h,) of the family (kind of changed noise level) of each of h hypotheses."""
    variance_factors: VarianceFactors
    """Variance factors of m observation equations, and of g means of repeated readings for errors that these share."""
    averaging_matrix: sp.csr_array
    """Matrix (g, m) that maps m observations to g means of repeated readings, first in each face and then in both
    faces."""
    parameter_basis: Floats | None
    """Orthonormal basis (m, u) of the changes of m observations by u estimated parameters; None for a large network."""
    group_noise_hypotheses: tuple[GroupNoiseHypothesis, ...]
    """Noise hypotheses with a size for each group of readings: noise level, noise by target and by station, noise in
    intervals of time."""
    residual_space: ResidualSpace
    """Residual space of the adjustment: whitened observations without the part that the unknowns absorb."""

    @classmethod
    def from_residual_space(
        cls, space: ResidualSpace, hypotheses: Sequence[NoiseHypothesis], *, allows_noise_below_declared: bool = True
    ) -> NoiseHypothesisSet:
        """Noise hypotheses for an adjustment with the whitened equations `space`.

        The `hypotheses` have one size for all readings. `allows_noise_below_declared` permits a smaller noise level.
        """
        repeat_patterns = [normalised_sum_matrix_of_repeats(space, faces) for faces in REPETITION_KINDS]
        averaging_matrix = sp.csr_array(sp.vstack(repeat_patterns))
        pattern_counts = space.n_equations - int(space.is_used_reading.sum()), *(m.shape[0] for m in repeat_patterns)
        other_groups = [np.full(size, len(OBSERVABLES) + i) for i, size in enumerate(pattern_counts)]
        variance_factors = VarianceFactors.from_patterns(
            _noise_patterns(space, hypotheses, repeat_patterns),
            np.concatenate([np.nonzero(space.is_used_reading)[1], *other_groups]),
        )
        names = tuple(dict.fromkeys(h.family_name for h in hypotheses))
        index = {name: i for i, name in enumerate(names)}
        family = np.array([index[h.family_name] for h in hypotheses], dtype=np.int64)
        basis = parameter_basis_of_small_network(space)
        group_noise_hypotheses = (
            RecordingNoiseLevel.from_residual_space(space, allows_noise_below_declared=allows_noise_below_declared),
            *GroupNoiseMixture.candidates(space),
            *NoiseWindows.from_residual_space(space),
        )
        return cls(
            list(hypotheses), names, family, variance_factors, averaging_matrix, basis, group_noise_hypotheses, space
        )

    def log_likelihood_ratios(self, residual: Floats, redundancy: Floats) -> Floats:
        """Log likelihood ratios (h, trials) of h noise levels for each recording (trial), with independent readings.

        `residual` (m, trials) are m whitened residuals of each recording (trial), and `redundancy` (m,) the redundancy
        numbers.
        """
        squares = np.vstack([residual**2, (self.averaging_matrix @ residual) ** 2]).astype(np.float32)
        share = np.concatenate([redundancy, redundancy_of_means(self.averaging_matrix, redundancy)])
        return self.variance_factors.log_likelihood_ratios(squares, share)

    def log_evidence_by_family(self, residual: Floats | Floats32, redundancy: Floats) -> Floats:
        """Log evidence (families, trials), with priors, of all kinds of changed noise, with independent readings.

        The first rows of the result belong to `family_names`, all following rows to `group_noise_hypotheses`.
        `residual` (m, trials) are m whitened residuals of each recording (trial), and `redundancy` (m,) the redundancy
        numbers.
        """
        slices = batches(residual.shape[1], len(residual))
        return np.hstack(
            [self._log_evidence_of_all_families(residual[:, part].astype(np.float64), redundancy) for part in slices]
        )

    def _log_evidence_of_all_families(self, residual: Floats, redundancy: Floats) -> Floats:
        """Log evidence (families, trials) with priors of all kinds of changed noise for a batch of recordings.

        `residual` (m, trials) are m whitened residuals of each recording (trial).
        """
        patterns = self._log_evidence_from_ratios(self.log_likelihood_ratios(residual, redundancy))
        return np.vstack(
            [
                patterns,
                *(
                    self._group_noise_log_evidence(change, residual, redundancy)
                    for change in self.group_noise_hypotheses
                ),
            ]
        )

    def _group_noise_log_evidence(self, change: GroupNoiseHypothesis, residual: Floats, redundancy: Floats) -> Floats:
        """Log evidence (trials,), with prior, of the changed noise `change` with a size for each group of readings.

        The evidence is computed for a batch of recordings (trials).
        """
        return change.log_evidence(residual, redundancy) + self.log_prior_of_family(change.name)

    def log_prior_of_family(self, family_name: str) -> float:
        """Log prior probability of a kind of changed noise, given by its name: a catalogue effect or `unknown`."""
        return log_prior_of_noise_family(
            family_name, (*self.family_names, *(change.name for change in self.group_noise_hypotheses))
        )

    def _log_evidence_from_ratios(self, ratio: Floats) -> Floats:
        """Log evidence (kinds of noise, trials), with priors, from the log likelihood `ratio` (h, trials).

        The ratios are those of h changed noise levels for each recording (trial).
        """
        share = np.array([self.log_prior_of_family(family) for family in self.family_names])
        return log_mean_exp_by_group(ratio, self.family_indices, len(self.family_names)) + share[:, None]

    def log_restricted_likelihood_ratio(self, hypothesis_index: int, residual: Floats, model_basis: Floats) -> float:
        """Log restricted likelihood ratio of the noise with the index `hypothesis_index`, without approximation.

        `residual` (m,) are the m whitened residuals given the effects of a model. The e columns of `model_basis` (m, e)
        are the basis of the changes by these effects.
        """
        rows, logs = self.variance_factors.affected_rows_and_log_factors(hypothesis_index)
        return self._log_restricted_likelihood_ratio(rows, logs, residual, model_basis)

    def _log_restricted_likelihood_ratio(
        self, rows: Ints, logs: Floats, residual: Floats, model_basis: Floats
    ) -> float:
        """Log restricted likelihood ratio for variance factors, without approximation.

        `logs` (k,) are the logarithms of the factors of the `rows` (k,): readings, then means of repeated readings.
        `residual` (m,) and `model_basis` (m, e) are given the effects of a model.
        """
        assert self.parameter_basis is not None
        weight, size = -np.expm1(-logs), len(residual)
        basis = np.hstack([self.parameter_basis, model_basis])
        single, repeated = rows[rows < size], self.averaging_matrix[rows[rows >= size] - size]
        basis_rows = np.vstack([basis[single], repeated @ basis])
        values = np.concatenate([residual[single], repeated @ residual])
        normal = np.eye(basis_rows.shape[1]) - basis_rows.T @ (weight[:, None] * basis_rows)
        products = basis_rows.T @ (weight * values)
        fit = float(weight @ values**2 + products @ np.linalg.solve(normal, products))
        return 0.5 * (fit - float(np.linalg.slogdet(normal)[1]) - float(logs.sum()))

    def _excess_over_diagonal_form(
        self, hypothesis_index: int, diagonal_log_ratio: float, residual: Floats, model_basis: Floats
    ) -> float:
        """Log restricted likelihood ratio of a changed noise minus its approximation `diagonal_log_ratio`.

        The approximation treats the readings as independent. In a large network the result is 0.
        """
        return (
            0.0
            if self.parameter_basis is None
            else self.log_restricted_likelihood_ratio(hypothesis_index, residual, model_basis) - diagonal_log_ratio
        )

    def _log_evidence_on_fine_grid(
        self,
        hypothesis_indices: Ints,
        best_index: int,
        log_likelihood_ratios: Floats,
        residual: Floats,
        redundancy: Floats,
    ) -> float:
        """Log evidence of a kind of changed noise, with a fine grid of sizes of its most probable effect.

        `hypothesis_indices` are the indices of the hypotheses of this kind, `best_index` is the one with the largest
        likelihood, and `log_likelihood_ratios` are their log likelihood ratios. For an effect with several parameters,
        the evidence is averaged over each parameter alone and all parameters together.
        """
        effect = self.hypotheses[best_index].effect
        is_same = np.array([self.hypotheses[i].effect == effect for i in hypothesis_indices.tolist()])
        candidate_parameter_values = np.array([self.hypotheses[i].sizes for i in hypothesis_indices[is_same].tolist()])
        size_limits = (
            np.where(candidate_parameter_values > 0.0, candidate_parameter_values, np.inf).min(axis=0),
            candidate_parameter_values.max(axis=0),
        )
        reml_gain = reml_gain_function(
            self.residual_space, self.residual_space.reading_sigmas, effect, residual, redundancy
        )
        log_evidences = log_sum_exp(
            np.array([reml_gain(sizes) for sizes in np.geomspace(*size_limits, N_FINE_GRID_NOISE_SIZES)])
        ) - np.log(N_FINE_GRID_NOISE_SIZES)
        subsets = [*log_evidences, log_evidences.sum()] if len(log_evidences) > 1 else log_evidences
        fine_evidence = log_sum_exp(np.array(subsets)) + np.log(is_same.sum() / len(subsets))
        return float(
            log_sum_exp(np.append(log_likelihood_ratios[~is_same], fine_evidence)) - np.log(len(hypothesis_indices))
        )

    def ranked_noise_hypotheses(
        self, residual: Floats, redundancy: Floats, model_basis: Floats
    ) -> list[tuple[float, NoiseHypothesis]]:
        """Pairs of log evidence (with prior) and most probable changed noise of each kind, by decreasing evidence.

        The m residuals `residual` (m,), redundancy numbers `redundancy` (m,) and the basis `model_basis` (m, e) of e
        dimensions are given the effects of a model.
        """
        ratio = self.log_likelihood_ratios(residual[:, None], redundancy)
        evidence = self._log_evidence_from_ratios(ratio)[:, 0]
        ranking = []
        for rank, family in enumerate(np.argsort(-evidence)):
            members = np.flatnonzero(self.family_indices == family)
            likeliest = int(members[int(np.argmax(ratio[members, 0]))])
            value = float(evidence[family])
            if rank < N_EXACTLY_EVALUATED_HYPOTHESES:
                value = self._log_evidence_on_fine_grid(members, likeliest, ratio[members, 0], residual, redundancy)
                value += self.log_prior_of_family(self.family_names[family])
                value += self._excess_over_diagonal_form(likeliest, float(ratio[likeliest, 0]), residual, model_basis)
            ranking.append((value, self.hypotheses[likeliest]))
        rival = max(0.0, *(value for value, _ in ranking))
        for change, value in self.ranked_group_noise(residual, redundancy, model_basis, rival):
            effect = change.most_likely_effect(residual, redundancy)
            ranking.append((value, NoiseHypothesis(change.name, effect, (0.0,) * len(effect.parameters))))
        return sorted(ranking, key=lambda entry: -entry[0])

    def expected_variance_factors(self) -> Floats:
        """Posterior mean (n, 3) of variance factors of the readings of n pointings, over all changes of the noise.

        The mean is the estimate t of a variance s with the smallest expectation of s/t - 1 - log(s/t) (Stein).
        """
        space, residual, redundancy = (
            self.residual_space,
            self.residual_space.whitened_residuals,
            self.residual_space.redundancy,
        )
        values, factors = [0.0], [np.ones(space.reading_sigmas.shape)]
        for hypothesis, value in self._ranked_patterns(residual, redundancy):
            sizes = np.array(with_estimated_sizes(space, space.reading_sigmas, hypothesis).sizes)
            values.append(value)
            factors.append(
                hypothesis.effect.variance(space.sightings, space.reading_sigmas, sizes) / space.reading_sigmas**2
            )
        n_readings = np.count_nonzero(space.is_used_reading)
        none = np.zeros((len(residual), 0))
        for change, value in self.ranked_group_noise(residual, redundancy, none, max(values)):
            values.append(value)
            factors.append(np.ones(space.reading_sigmas.shape))
            factors[-1][space.is_used_reading] = change.expected_variance_factors(residual, redundancy)[:n_readings]
        mean_factors = np.einsum("k,kij->ij", normalised_probabilities(np.array(values)), np.stack(factors))
        return np.nan_to_num(mean_factors, nan=1.0)

    def _ranked_patterns(self, residual: Floats, redundancy: Floats) -> list[tuple[NoiseHypothesis, float]]:
        """Most probable changes of the noise by one size, in fixed ratios between readings, and their log evidence."""
        ratio = self.log_likelihood_ratios(residual[:, None], redundancy)[:, 0]
        prior = np.array([self.log_prior_of_family(name) for name in self.family_names])
        prior -= np.log(np.bincount(self.family_indices))
        members: dict[CandidateNoiseEffect, list[int]] = {}
        for i, hypothesis in enumerate(self.hypotheses):
            members.setdefault(hypothesis.effect, []).append(i)
        log_evidence = ratio + prior[self.family_indices]
        evidence = np.array([float(log_sum_exp(log_evidence[same])) for same in members.values()])
        none, groups, ranked = np.zeros((len(residual), 0)), list(members.values()), []
        for i in np.argsort(-evidence)[:MAX_AVERAGED_HYPOTHESES]:
            best = groups[i][int(np.argmax(ratio[groups[i]]))]
            excess = self._excess_over_diagonal_form(best, float(ratio[best]), residual, none)
            ranked.append((self.hypotheses[best], float(evidence[i]) + excess))
        return ranked

    def ranked_group_noise(
        self, residual: Floats, redundancy: Floats, model_basis: Floats, rival_log_evidence: float
    ) -> list[tuple[GroupNoiseHypothesis, float]]:
        """Pairs of a changed noise of groups of readings or intervals of time, and its log evidence.

        Hypotheses limited to some targets, a station or a region are included if their log evidence is not far below
        `rival_log_evidence`, the largest log evidence of another hypothesis.
        """
        ranked_hypotheses = [
            (change, self._group_noise_log_evidence_of_residuals(change, residual, redundancy, model_basis))
            for change in self.group_noise_hypotheses
        ]
        least = (
            max(rival_log_evidence, *(value for _, value in ranked_hypotheses))
            * MIN_LOG_EVIDENCE_FRACTION_FOR_NOISE_AT_PLACES
        )
        places = [
            x
            for change, value in ranked_hypotheses
            if value > least
            for x in change.limited_to_most_probable_place(residual, redundancy)
        ]
        return ranked_hypotheses + [
            (place, self._group_noise_log_evidence_of_residuals(place, residual, redundancy, model_basis))
            for place in places
        ]

    def _group_noise_log_evidence_of_residuals(
        self, change: GroupNoiseHypothesis, residual: Floats, redundancy: Floats, model_basis: Floats
    ) -> float:
        """Log evidence, with prior, of the changed noise `change` with a size for each group, for one recording.

        For the noise level of a small network, the difference of the exact restricted likelihood from that for
        independent readings is added. For other changes of the noise this difference has no meaning: their factors are
        averages.
        """
        value = float(self._group_noise_log_evidence(change, residual[:, None], redundancy)[0])
        if self.parameter_basis is None or not isinstance(change, RecordingNoiseLevel):
            return value
        factors = change.expected_variance_factors(residual, redundancy)[: len(residual)]
        at = np.flatnonzero(factors != 1.0)
        exact = self._log_restricted_likelihood_ratio(at, np.log(factors[at]), residual, model_basis)
        diagonal = log_restricted_likelihood_ratio(residual[at] ** 2, redundancy[at], factors[at])
        return value + exact - float(diagonal.sum())


def _noise_patterns(
    space: ResidualSpace, hypotheses: Sequence[NoiseHypothesis], averaging_matrices: Sequence[sp.csr_array]
) -> Iterator[VariancePatternWithSizes]:
    """Iterator over patterns of noise: added variance of the readings per unit of the size, and the sizes to be tried.

    For errors that repeated readings share, the pattern contains the means of these readings (`averaging_matrices`). A
    variance function has one pattern, because it is linear in its size. A catalogue effect has one pattern for each
    size.
    """
    used, variance = space.is_used_reading, space.reading_sigmas**2
    for effect, same in groupby(hypotheses, key=lambda h: h.effect):
        sizes = [h.sizes for h in same]
        linear = isinstance(effect, VarianceFunction)
        for values in [(1.0,)] if linear else sizes:
            added = (effect.variance(space.sightings, space.reading_sigmas, np.array(values)) / variance)[used] - 1.0
            if faces := getattr(effect, "shared_error_repetition", ""):
                grown = (
                    added_variance_of_means(m, added if kind == faces else np.zeros(0))
                    for kind, m in zip(REPETITION_KINDS, averaging_matrices, strict=True)
                )
                added = np.concatenate([np.zeros(space.n_equations), *grown])
            yield added, tuple(size for (size,) in sizes) if linear else (1.0,)
