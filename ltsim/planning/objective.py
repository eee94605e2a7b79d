"""Objective of a layout: one number, smaller is better.

The D, A and E criteria are mean or largest standard deviations of p parameters in units of their prior sigmas. They are
computed from one covariance matrix (p, p), or from many at once (..., p, p). Micrometres and microradians can thus be
averaged, and a criterion of 1 means that the readings contain no information. The D criterion is smallest for the
largest determinant of the information matrix, as in the literature. The A criterion follows from the trace of the
covariance matrix; the trace of the information matrix is no measure of precision.

References
----------
Atkinson, Donev, Tobias, Optimum Experimental Designs, with SAS (2007), chapter 10.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ltsim.adjustment.remedies.detectability import search_noncentrality
from ltsim.core.arrays import Floats
from ltsim.physics.effects.effect import Effect
from ltsim.planning.layout_scorer import LayoutPrecision

CriterionName = Literal["D", "A", "E"]
"""Name of an optimality criterion: D (determinant), A (mean variance) or E (worst combination)."""
INSTRUMENT_QUALITY_NAME = "instrument"
"""Name of the quality of a layout that is an optimality criterion of the instrument parameters."""
TARGETS_QUALITY_NAME = "targets"
"""Name of the quality of a layout that is the weighted root mean square point error of the targets."""
DIAGNOSIS_QUALITY_NAME = "diagnosis"
"""Name of a quality of a layout: geometric mean, over effects, of the minimal detectable size divided by a plausible
size."""
QUALITY_PHRASES = {
    INSTRUMENT_QUALITY_NAME: "the precision of the instrument parameters",
    TARGETS_QUALITY_NAME: "the precision of the targets",
    DIAGNOSIS_QUALITY_NAME: "the sensitivity of a diagnosis to effects",
}
"""Noun phrase for each quality of a layout in sentences for users, by the name of the quality."""
MIN_SWEEP_IMPROVEMENT = 1e-4
"""Limit of the relative improvement of the objective by a sweep (one attempt to replace each station). After a larger
improvement the search makes another sweep."""


def d_criterion(covariance: Floats) -> Floats:
    """Geometric mean (...) of the standard deviations along the principal axes of covariance matrices (..., p, p).

    For p parameters it is det(covariance)^(1 / 2p), the p-th root of the volume of the confidence ellipsoid up to a
    factor.
    """
    _, logarithm = np.linalg.slogdet(covariance)
    return np.exp(0.5 * logarithm / covariance.shape[-1])


def a_criterion(covariance: Floats) -> Floats:
    """Root mean square (...) of the standard deviations of p parameters, from their covariance matrices (..., p, p)."""
    return np.sqrt(np.trace(covariance, axis1=-2, axis2=-1) / covariance.shape[-1])


def e_criterion(covariance: Floats) -> Floats:
    """Standard deviation (...) of the worst determined combination of p parameters, from covariances (..., p, p).

    The coefficients of the combination have the norm 1.
    """
    return np.sqrt(np.linalg.eigvalsh(covariance)[..., -1])


CRITERION_FUNCTIONS: dict[CriterionName, Callable[[Floats], Floats]] = {
    "D": d_criterion,
    "A": a_criterion,
    "E": e_criterion,
}
"""Function of each optimality criterion, by its name; it computes the criterion from the covariance of the parameters.
"""


@dataclass(frozen=True)
class LayoutObjective:
    """Objective function of layouts, a weighted geometric mean of up to three qualities; smaller is better."""

    quality_weights: Mapping[str, float] = field(default_factory=lambda: {INSTRUMENT_QUALITY_NAME: 1.0})
    """Weight of each quality by name: `instrument` (optimality criterion of the parameters, in prior sigmas), `targets`
    (weighted root mean square point error [m]) and `diagnosis` (geometric mean of the minimal detectable sizes of
    effects, divided by their plausible sizes)."""
    criterion_name: CriterionName = "D"
    """Optimality criterion of the instrument parameters: "D", "A" or "E"."""
    effects: tuple[Effect, ...] = ()
    """Effects that a diagnosis should detect."""
    n_diagnosis_variants_by_effect: Mapping[str, int] = field(default_factory=dict)
    """Number of variants of each effect that a diagnosis tests, by name of the effect; default the number of entries in
    `effects`. Variants differ in the station or target where the effect acts, or in shape parameters (period, time
    constant, onset time). The more variants are tested, the larger an effect must be to be detected at the same
    false-alarm rate."""

    @property
    def needs_target_errors(self) -> bool:
        """True if point errors of targets have a weight in the objective, so that they must be computed."""
        return self.quality_weights.get(TARGETS_QUALITY_NAME, 0.0) > 0.0

    def qualities(self, precision: LayoutPrecision, n_parameters: int) -> dict[str, Floats]:
        """Values (B,) of each quality with a weight in the objective, by name, for B layouts; smaller is better.

        The values are infinite for a layout that leaves unknowns undetermined. The first `n_parameters` rows of the
        information matrices in `precision` belong to instrument parameters, the other rows to effects.
        """
        qualities: dict[str, Floats] = {}
        if self.quality_weights.get(INSTRUMENT_QUALITY_NAME, 0.0) > 0.0:
            qualities[INSTRUMENT_QUALITY_NAME] = self._instrument_quality(
                precision.information_matrices[:, :n_parameters, :n_parameters]
            )
        if self.needs_target_errors:
            qualities[TARGETS_QUALITY_NAME] = precision.weighted_target_rms
        if self.quality_weights.get(DIAGNOSIS_QUALITY_NAME, 0.0) > 0.0:
            qualities[DIAGNOSIS_QUALITY_NAME] = mean_detectable_size(
                precision.information_matrices, n_parameters, self.effects, self.n_diagnosis_variants_by_effect
            )
        return {name: np.where(np.isfinite(value), value, np.inf) for name, value in qualities.items()}

    def objective_values(self, precision: LayoutPrecision, n_parameters: int) -> Floats:
        """Objective (B,) of B layouts: weighted geometric mean of their qualities.

        `n_parameters` is the number of instrument parameters.
        """
        qualities = self.qualities(precision, n_parameters)
        weight_sum = sum(self.quality_weights[name] for name in qualities)
        weighted_logs = [self.quality_weights[name] / weight_sum * np.log(value) for name, value in qualities.items()]
        return np.exp(np.sum(weighted_logs, axis=0))

    def _instrument_quality(self, information: Floats) -> Floats:
        """Optimality criterion (B,) of p instrument parameters in B layouts, from information matrices (B, p, p)."""
        value = np.full(len(information), np.inf)
        is_valid = np.isfinite(information).all(axis=(1, 2))
        if is_valid.any():
            value[is_valid] = CRITERION_FUNCTIONS[self.criterion_name](np.asarray(np.linalg.inv(information[is_valid])))
        return value


def mean_detectable_size(
    information: Floats,
    n_parameters: int,
    effects: Sequence[Effect],
    n_diagnosis_variants_by_effect: Mapping[str, int] | None = None,
) -> Floats:
    """Geometric mean (B,), over the parameters of effects, of minimal detectable size divided by plausible size.

    `information` (B, P, P) are information matrices of B layouts for P parameters: first the `n_parameters` of the
    instrument, then those of `effects`. `n_diagnosis_variants_by_effect` is the number of variants of each effect (in
    station, target or shape parameters) that a diagnosis tests.
    """
    sought = {**Counter(effect.name for effect in effects), **(n_diagnosis_variants_by_effect or {})}
    parameter_block = information[:, :n_parameters, :n_parameters]
    value = np.full(len(information), np.inf)
    is_valid = np.isfinite(information).all(axis=(1, 2))
    if not is_valid.any():
        return value
    carry = information[is_valid, :n_parameters, n_parameters:]
    effect_block = information[is_valid, n_parameters:, n_parameters:] - np.swapaxes(carry, 1, 2) @ np.linalg.solve(
        parameter_block[is_valid], carry
    )
    noncentralities = np.concatenate(
        [[search_noncentrality(len(e.parameters), sought[e.name])] * len(e.parameters) for e in effects]
    )
    strength = np.maximum(np.einsum("bii->bi", effect_block), 1e-12)
    value[is_valid] = np.exp(0.5 * np.mean(np.log(noncentralities / strength), axis=1))
    return value
