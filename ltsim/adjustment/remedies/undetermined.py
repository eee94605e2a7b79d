"""Combinations of instrument parameters that a recording does not determine, and measurements that determine them.

With the parameters in units of their prior standard deviations, the eigenvalues of the posterior covariance lie between
0 and 1. The gain of a combination (eigenvector) is one minus its eigenvalue: the fraction of its prior variance that
the readings remove. A combination with a gain below one half is undetermined, because its prior is more precise than
the readings.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, combinations
from typing import NamedTuple

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.remedies.candidates import (
    advice_sentence,
    calibrated_length_candidates,
    near_reflector_candidates,
    repeated_setup_candidates,
    second_face_candidate,
)
from ltsim.adjustment.remedies.network import PlannedNetwork
from ltsim.core.arrays import Floats
from ltsim.core.errors import NetworkError
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE, SQRT_MACHINE_EPSILON
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.solve.gauss_newton import MAX_ITERATIONS

MIN_DETERMINED_GAIN = 0.5
"""Smallest gain (fraction of the prior variance that the readings remove) of a determined parameter combination."""
MAX_UNINFORMATIVE_GAIN = 0.01
"""Largest gain of an uninformative combination of parameters. The gain is the fraction of the prior variance that the
readings remove. Uninformative combinations are replaced by linear combinations of each other that contain few
parameters."""
MIN_REPORTED_COEFFICIENT = 0.1
"""Smallest absolute coefficient of a parameter that is reported as part of a combination of parameters."""
MIN_WORTHWHILE_GAIN_INCREASE = 0.25
"""Smallest increase of the gain (fraction of the prior variance that the readings remove) of a parameter combination by
a proposed measurement."""


@dataclass(frozen=True)
class ParameterCombination:
    """Linear combination of parameters in units of their prior standard deviations, and how well it is determined."""

    coefficient_vector: Floats
    """Coefficients (p,) of the p parameters, a unit vector."""
    gain: float
    """Fraction of the prior variance that the readings removed."""

    def coefficients(self, names: Sequence[str]) -> dict[str, float]:
        """Coefficients with absolute values above 0.1, by parameter name; the largest is first and positive."""
        abs_coefficients = np.abs(self.coefficient_vector)
        order = np.argsort(-np.round(abs_coefficients / NORMAL_EQUATIONS_TOLERANCE), kind="stable")
        sign = np.sign(self.coefficient_vector[_index_of_first_largest(abs_coefficients)])
        return {
            names[i]: float(sign * self.coefficient_vector[i])
            for i in order
            if abs_coefficients[i] > MIN_REPORTED_COEFFICIENT
        }


def gains_and_combinations(covariance: Floats, prior_sigma: Floats) -> tuple[Floats, Floats]:
    """Gains (p,) in ascending order, and the combinations of p parameters with these gains, as columns (p, p).

    A gain is 1 minus the ratio of posterior to prior variance. `covariance` (p, p) is the posterior covariance of the
    parameters, `prior_sigma` (p,) are the prior standard deviations, which are the units of the combinations.
    """
    scaled_covariance = covariance / np.outer(prior_sigma, prior_sigma)
    remaining, vectors = np.linalg.eigh(0.5 * (scaled_covariance + scaled_covariance.T))
    return np.clip(1.0 - remaining[::-1], 0.0, 1.0), vectors[:, ::-1]


def undetermined_combinations(covariance: Floats, prior_sigma: Floats) -> list[ParameterCombination]:
    """Combinations of p parameters with a gain below `MIN_DETERMINED_GAIN`, the least determined first.

    The gain is the fraction of the prior variance that the readings remove. `covariance` (p, p) is the posterior
    covariance, `prior_sigma` (p,) the prior standard deviations.
    """
    gain, vectors = gains_and_combinations(covariance, prior_sigma)
    is_silent = gain < MAX_UNINFORMATIVE_GAIN
    vectors = np.concatenate([rotate_to_simple_structure(vectors[:, is_silent]), vectors[:, ~is_silent]], axis=1)
    scaled_covariance = covariance / np.outer(prior_sigma, prior_sigma)
    gain = 1.0 - np.einsum("ij,ik,kj->j", vectors, scaled_covariance, vectors)
    gain = np.where(gain < SQRT_MACHINE_EPSILON, 0.0, gain)
    weak = [ParameterCombination(vectors[:, i], float(gain[i])) for i in np.flatnonzero(gain < MIN_DETERMINED_GAIN)]
    return sorted(
        weak,
        key=lambda d: (round(d.gain / SQRT_MACHINE_EPSILON), _index_of_first_largest(np.abs(d.coefficient_vector))),
    )


def _index_of_first_largest(sizes: Floats) -> int:
    """Index of the first of the `sizes` that equals the largest one up to rounding."""
    return int(np.flatnonzero(sizes >= (1.0 - NORMAL_EQUATIONS_TOLERANCE) * sizes.max())[0])


def rotate_to_simple_structure(vectors: Floats) -> Floats:
    """Orthonormal basis (p, k) of the span of k orthonormal columns `vectors` (p, k) with few large elements (varimax).

    The result depends only on the span of the columns: the rotations of pairs of columns start at a basis that is
    formed by projections of the p parameters, and are iterated until convergence.

    References
    ----------
    Kaiser, The varimax criterion, Psychometrika 23 (1958) 187.
    """
    columns = list(_basis_of_span(vectors).T)
    for _ in range(MAX_ITERATIONS):
        largest = 0.0
        for i, j in combinations(range(len(columns)), 2):
            x, y = columns[i], columns[j]
            u, v = x**2 - y**2, 2.0 * x * y
            sine = 2.0 * (u @ v - u.sum() * v.sum() / len(u))
            cosine = u @ u - v @ v - (u.sum() ** 2 - v.sum() ** 2) / len(u)
            if np.hypot(sine, cosine) > SQRT_MACHINE_EPSILON:
                angle = 0.25 * np.arctan2(sine, cosine)
                columns[i], columns[j] = (
                    np.cos(angle) * x + np.sin(angle) * y,
                    np.cos(angle) * y - np.sin(angle) * x,
                )
                largest = max(largest, abs(angle))
        if largest < SQRT_MACHINE_EPSILON:
            break
    return np.array(columns).reshape(-1, len(vectors)).T


def _basis_of_span(vectors: Floats) -> Floats:
    """Orthonormal basis (p, k) of the span of `vectors` (p, k), by pivoted Cholesky factorisation of its projector."""
    projector, basis = vectors @ vectors.T, np.empty_like(vectors)
    for k in range(vectors.shape[1]):
        i = _index_of_first_largest(np.diag(projector))
        basis[:, k] = projector[:, i] / np.sqrt(projector[i, i])
        projector = projector - np.outer(basis[:, k], basis[:, k])
    return basis


class MeasurementForCombination(NamedTuple):
    """Measurement that determines an undetermined combination of parameters."""

    instruction: str = ""
    """Instruction to the user; empty if no tested measurement determines the combination."""
    sentence: str = ""
    """Sentence with the instruction and the gain, or that no tested measurement determines it; empty without a
    search."""


def measurements_for_undetermined(
    adjustment: Adjustment,
    construction: GeometricErrorModel,
    weak_combinations: Sequence[Sequence[ParameterCombination]],
    suspect_targets: Sequence[str] = (),
) -> list[list[MeasurementForCombination]]:
    """Measurements that determine the undetermined parameter combinations of each instrument, one list per instrument.

    The proposal for a combination is the first measurement that increases its gain (fraction of the prior variance that
    the readings remove) above one half, otherwise the measurement with the largest increase. `weak_combinations` are
    the undetermined combinations of each instrument, `construction` is the error model with their parameters. Targets
    named in `suspect_targets`, which may have moved, are not used as ends of a proposed length.
    """
    if not any(weak_combinations):
        return [[] for _ in weak_combinations]
    network = PlannedNetwork.from_adjustment(adjustment, construction)
    present_gains = _gains_of_combinations(network, weak_combinations)
    cheap = [r for r in (second_face_candidate(network), *calibrated_length_candidates(network, suspect_targets)) if r]
    candidates = chain(
        cheap, repeated_setup_candidates(network, 0.0, [0]), near_reflector_candidates(network)
    )  # the cheapest first
    evaluated = list[tuple[str, list[list[float]]]]()
    open_combinations = {(i, k) for i, combinations in enumerate(weak_combinations) for k in range(len(combinations))}
    for remedy in candidates:
        gains = _gains_of_combinations(remedy.network, weak_combinations)
        evaluated.append((remedy.instruction, gains))
        open_combinations = {(i, k) for i, k in open_combinations if gains[i][k] < MIN_DETERMINED_GAIN}
        if not open_combinations:
            break
    return [
        [
            _measurement_for_combination(d, present_gains[i][k], [(words, gain[i][k]) for words, gain in evaluated])
            for k, d in enumerate(combinations)
        ]
        for i, combinations in enumerate(weak_combinations)
    ]


def _gains_of_combinations(
    network: PlannedNetwork, weak_combinations: Sequence[Sequence[ParameterCombination]]
) -> list[list[float]]:
    """Gain of each combination of each instrument: fraction of its prior variance that the readings remove.

    The gains are zero if the network does not determine all poses.
    """
    try:
        covariance, prior = network.parameter_covariance_and_prior_sigma()
    except NetworkError:
        return [[0.0 for _ in weak] for weak in weak_combinations]
    return [
        [float(1.0 - (d.coefficient_vector / sigma) @ block @ (d.coefficient_vector / sigma)) for d in weak]
        for block, sigma, weak in zip(covariance, prior, weak_combinations, strict=True)
    ]


def _measurement_for_combination(
    combination: ParameterCombination, present_gain: float, candidates_with_gains: Sequence[tuple[str, float]]
) -> MeasurementForCombination:
    """Measurement that determines one combination of parameters.

    `candidates_with_gains` contains the instruction of each candidate measurement and the gain of the combination with
    this measurement (fraction of the prior variance that the readings remove); `present_gain` is the gain without it.
    """
    if present_gain >= MIN_DETERMINED_GAIN > combination.gain:
        instruction = advice_sentence("network method")
        sentence = advice_sentence("determined already", do=instruction, then=100 * present_gain)
        return MeasurementForCombination(instruction, sentence)
    is_sufficient = [pair for pair in candidates_with_gains if pair[1] >= MIN_DETERMINED_GAIN]
    words, then = (
        is_sufficient[0]
        if is_sufficient
        else max(candidates_with_gains, key=lambda pair: pair[1], default=("", present_gain))
    )
    if then - present_gain < MIN_WORTHWHILE_GAIN_INCREASE:
        return MeasurementForCombination(sentence=advice_sentence("not determined"))
    return MeasurementForCombination(
        words, advice_sentence("determined", do=words, now=100 * combination.gain, then=100 * then)
    )
