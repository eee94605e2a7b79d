"""Possible causes of a misfit, fitted to the residuals of a recording, and the evidence that separates two of them.

The expected evidence between two causes is a difference of chi-square. If the first cause is true, it is the squared
length of that part of its change of the residuals which no variant of the second cause (place, shape parameters)
explains. As the true cause is unknown, the smaller of the two differences is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.remedies.detectability import subsample_evenly
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError
from ltsim.physics.effects import find_effect
from ltsim.physics.effects.effect import Effect, NoiseEffect
from ltsim.physics.effects.linear_effect import LinearEffect


@dataclass(frozen=True)
class PossibleCause:
    """Possible cause of a misfit: the variant of an effect (place, shape parameters) that fits the recording best."""

    effect: Effect
    """Effect with its stations, targets and shape parameters."""
    parameter_values: Floats
    """Estimates of the p parameters of the effect, (p,) [SI]."""


def residual_space_of(adjustment: Adjustment, extra_effects: Sequence[LinearEffect] = ()) -> ResidualSpace:
    """Residual space of an adjustment in which the parameters of `extra_effects` are estimated too.

    The residual space contains the whitened residuals and the projector off the design columns of all unknowns.
    """
    return ResidualSpace.from_adjustment(adjustment).with_effects(extra_effects)


def best_explanation(residual_space: ResidualSpace, name: str) -> PossibleCause:
    """Variant of the effect `name` (place, shape parameters) that fits a recording best, with its size.

    Raises ModelError for an unknown effect, and for an effect that does not change the residuals.
    """
    kind = find_effect(name)
    if issubclass(kind, NoiseEffect):
        raise ModelError(f"{name} changes the noise; only effects that shift readings can be distinguished here")
    best_so_far: PossibleCause | None = None
    least = float(residual_space.whitened_residuals @ residual_space.whitened_residuals)
    for effect in kind.candidates(residual_space.sightings):
        values, sum_of_squares = _best_fitting_parameters(residual_space, effect, residual_space.whitened_residuals)
        if sum_of_squares < least:
            least, best_so_far = sum_of_squares, PossibleCause(effect, values)
    if best_so_far is None:
        raise ModelError(
            f"{name} does not change the residuals of this recording, so its size cannot be estimated from it"
        )
    return best_so_far


def _best_fitting_parameters(residual_space: ResidualSpace, effect: Effect, residual: Floats) -> tuple[Floats, float]:
    """Parameters (p,) [SI] of an effect that fit m whitened residuals (m,) best, and remaining sum of squares.

    The effect has p parameters.
    """
    projected_design = residual_space.project(residual_space.whitened_design(effect))
    if not np.isfinite(projected_design).all() or not projected_design.any():
        return np.zeros(len(effect.parameters)), float(residual @ residual)
    fitted_values = np.asarray(np.linalg.lstsq(projected_design, residual, rcond=1e-6)[0], dtype=np.float64)
    return fitted_values, float(np.sum((residual - projected_design @ fitted_values) ** 2))


@dataclass(frozen=True)
class RivalCauses:
    """Two possible causes of a misfit, with the variants (place, shape parameters) in which one imitates the other."""

    first_explanation: PossibleCause
    """First possible cause."""
    second_explanation: PossibleCause
    """Second possible cause."""
    rival_variants: tuple[list[tuple[float, Effect]], list[tuple[float, Effect]]]
    """Variants of the second cause, each preceded by the chi-square of the first cause that it does not explain.

    The variant with the smallest chi-square is first. In the second element of the tuple the causes are exchanged.
    Further pointings never decrease these values of chi-square, so that only variants with small values must be
    computed again."""

    @classmethod
    def from_explanations(
        cls, residual_space: ResidualSpace, first_explanation: PossibleCause, second_explanation: PossibleCause
    ) -> RivalCauses:
        """Pair of two possible causes, compared in the residuals of a recording."""
        return cls(
            first_explanation,
            second_explanation,
            (
                _variants_with_unexplained_part(residual_space, first_explanation, second_explanation.effect),
                _variants_with_unexplained_part(residual_space, second_explanation, first_explanation.effect),
            ),
        )

    @property
    def present_chi2_difference(self) -> float:
        """Difference of chi-square between the two causes in the present recording."""
        return min(variants[0][0] for variants in self.rival_variants)

    def expected_chi2_difference(self, residual_space: ResidualSpace) -> float:
        """Expected difference of chi-square between two causes in an extended recording.

        The difference is the smaller of two values: first cause true, or second cause true. `residual_space` contains
        the residuals and the projector of the extended recording.
        """
        least = []
        for truth, rival_variants in zip(
            (self.first_explanation, self.second_explanation), self.rival_variants, strict=True
        ):
            residual_change = residual_space.project(
                residual_space.whitened_design(truth.effect) @ truth.parameter_values
            )
            smallest = float(residual_change @ residual_change)
            for before, effect in rival_variants:
                if before >= smallest:
                    break
                smallest = min(smallest, _best_fitting_parameters(residual_space, effect, residual_change)[1])
            least.append(smallest)
        return min(least)


def _variants_with_unexplained_part(
    residual_space: ResidualSpace, true_explanation: PossibleCause, rival: Effect
) -> list[tuple[float, Effect]]:
    """Variants of the effect `rival`, each preceded by the chi-square of the true cause that it does not explain.

    The variant with the smallest chi-square is first.
    """
    residual_change = residual_space.project(
        residual_space.whitened_design(true_explanation.effect) @ true_explanation.parameter_values
    )
    instances = [rival, *subsample_evenly(type(rival).candidates(residual_space.sightings))]
    return sorted(
        ((_best_fitting_parameters(residual_space, effect, residual_change)[1], effect) for effect in instances),
        key=lambda pair: pair[0],
    )
