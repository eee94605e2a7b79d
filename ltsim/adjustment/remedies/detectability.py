"""Minimal detectable size of every known physical effect (the catalogue of effects) in a network.

An effect is detectable if the noncentrality of its change of the residuals reaches the noncentrality at which the test
has a power of 80 % (`reliability.noncentrality`). A diagnosis tests each effect in many variants: at all stations,
targets or instruments where it may act, and with all values of its shape parameters (periods, onset times). The
false-alarm rate is divided equally among the effects, and then equally among the variants of each effect.

References
----------
Baarda, A testing procedure for use in geodetic networks (1968); Teunissen, Testing theory (2006), chapter 4; Gross and
Vitells, Trial factors for the look elsewhere effect, Eur. Phys. J. C 70 (2010) 525.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TypeVar

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.reliability import noncentrality
from ltsim.adjustment.residual_space import ResidualSpace, orthonormal_columns
from ltsim.adjustment.significance import GLOBAL_TEST_LEVEL, MIN_EQUIVALENT_SQUARED_CORRELATION
from ltsim.core.arrays import Floats, Ints, batches
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE, SQRT_MACHINE_EPSILON
from ltsim.physics.effects import CATALOGUE, ORDINARY_CALIBRATION_EFFECTS
from ltsim.physics.effects.effect import Blunder, Effect, NoiseEffect, Parameter

VariantT = TypeVar("VariantT")
"""Type of the elements of a sequence of variants of an effect (stations, targets, shape parameters)."""
MAX_EXAMINED_VARIANTS = 150
"""Largest number of variants of one effect (stations, targets, shape parameters) that are examined. Of more variants,
evenly spaced ones in the list are examined."""


@cache
def search_noncentrality(dof: int, n_variants: int) -> float:
    """Noncentrality at which a diagnosis detects an effect with `dof` parameters in 80 % of cases.

    The false-alarm rate is divided among all physical effects that are known (an unknown cause counts as one more), and
    among the `n_variants` variants of the effect: stations and targets where it acts, and values of its shape
    parameters.
    """
    return noncentrality(
        dof, alpha=GLOBAL_TEST_LEVEL, n_tests=n_variants * (len(CATALOGUE) - len(ORDINARY_CALIBRATION_EFFECTS) + 1)
    )


@dataclass(frozen=True)
class MinimalDetectableSize:
    """Size of one parameter of an effect that a diagnosis detects in 80 % of cases, over all variants of the effect."""

    effect: str
    """Name of the effect."""
    parameter: str
    """Name of the parameter."""
    unit: str
    """Display unit of the parameter."""
    best_size: float
    """Smallest of the detectable sizes [SI] over all variants (stations, targets, shape parameters) of the effect."""
    median_size: float
    """Median of the detectable sizes [SI] over all variants of the effect."""
    worst_size: float
    """Largest of the detectable sizes [SI] over all variants of the effect; infinite if unknowns absorb a variant."""
    plausible_size: float
    """Plausible size of the parameter [SI]."""
    residual_fraction: float
    """Fraction of the change of the readings (sum of squares) that remains in the residuals; median over variants."""
    worst_variant: str
    """Text with the stations, targets and shape parameters of the variant with the largest detectable size."""


def subsample_evenly(variants: Sequence[VariantT]) -> list[VariantT]:
    """Evenly spaced selection of at most `MAX_EXAMINED_VARIANTS` elements of `variants`."""
    if len(variants) <= MAX_EXAMINED_VARIANTS:
        return list(variants)
    return [
        variants[i] for i in np.unique(np.linspace(0, len(variants) - 1, MAX_EXAMINED_VARIANTS).round().astype(int))
    ]


@dataclass(frozen=True)
class EffectDetectability:
    """Detectability of an effect in a network, in each of its variants (stations, targets, shape parameters)."""

    name: str
    """Name of the effect."""
    parameters: tuple[tuple[Parameter, ...], ...]
    """Parameters of the effect in each variant (stations, targets, shape parameters)."""
    variant_texts: tuple[str, ...]
    """Text with the stations, targets and shape parameters of each variant."""
    minimal_detectable_sizes: tuple[Floats, ...]
    """Minimal detectable size [SI] of each parameter in each variant; infinite if unknowns absorb the effect."""
    visible_fractions: tuple[float, ...]
    """Fraction of the change of the readings (sum of squares) that remains in the residuals, in each variant."""
    projected_basis: tuple[Floats, ...]
    """Orthonormal basis (m, rank) of the changes of the m residuals that the effect can cause, for each variant.

    The basis is empty for effects on the noise, and for effects whose parameters the adjustment estimates."""

    def table(self) -> list[MinimalDetectableSize]:
        """Minimal detectable sizes of the parameters of the effect, one entry per parameter."""
        table_rows = []
        for law in dict.fromkeys(self.parameters):
            at = [k for k, parameters in enumerate(self.parameters) if parameters == law]
            visible = float(np.median([self.visible_fractions[k] for k in at]))
            for j, p in enumerate(law):
                size = np.array([self.minimal_detectable_sizes[k][j] for k in at])
                typical = float(np.quantile(size, 0.5, method="higher"))
                worst = self.variant_texts[at[int(np.argmax(size))]]
                row = (self.name, p.name, p.unit, float(size.min()), typical, float(size.max()), p.prior_sigma)
                table_rows.append(MinimalDetectableSize(*row, visible, worst))
        return table_rows


def _noise_effect_information(residual_space: ResidualSpace, variants: Sequence[NoiseEffect]) -> list[Floats]:
    """Information matrices of the parameters of effects on the noise, one per effect in `variants`.

    Element (i, j) is half the trace of P D_i P D_j. P is the projector onto the residual space, D_i the diagonal matrix
    of the derivatives of the whitened variances by parameter i, by differences over a tenth of its plausible size.
    """
    problem, changes = residual_space.adjustment.problem, []
    for effect in variants:
        steps = np.diag([0.1 * p.prior_sigma for p in effect.parameters])
        for step in steps:
            upper = effect.variance(residual_space.sightings, problem.reading_sigmas, step)
            changes.append(
                ((upper - problem.reading_sigmas**2) / (problem.reading_sigmas**2 * step.sum()))[
                    problem.is_used_reading
                ]
            )
    stack = np.array(changes)
    n_parameters = stack.shape[1]
    spread = np.empty_like(stack)
    for part in batches(n_parameters, residual_space.n_equations):
        units = np.eye(residual_space.n_equations, part.stop - part.start, -part.start)
        spread[:, part] = stack @ residual_space.project(units)[:n_parameters] ** 2
    edges = np.cumsum([0, *(len(effect.parameters) for effect in variants)])
    return [0.5 * stack[a:b] @ spread[a:b].T for a, b in pairwise(edges)]


def detectability_of_variants(residual_space: ResidualSpace, variants: Sequence[Effect]) -> EffectDetectability | None:
    """Detectability of one effect in its `variants` (places, shape parameters); None if none changes the residuals."""
    selected_variants = subsample_evenly(variants)
    noises = [effect for effect in selected_variants if isinstance(effect, NoiseEffect)]
    visible_effects: list[tuple[Effect, Floats, float, int, Floats]] = []
    informations = _noise_effect_information(residual_space, noises) if noises else []
    visible_effects += [
        (effect, information, 1.0, len(information), np.zeros((0, 0)))
        for effect, information in zip(noises, informations, strict=True)
    ]
    for effect in () if noises else selected_variants:
        whole = residual_space.whitened_design(effect)
        if np.isfinite(whole).all() and whole.any():
            norm = np.linalg.norm(whole, axis=0)
            scaled = residual_space.project(whole / np.where(norm > 0, norm, 1.0))
            basis = orthonormal_columns(scaled, np.ones(len(norm)))
            information, share, rank = visible_information(scaled.T @ scaled, norm, NORMAL_EQUATIONS_TOLERANCE)
            visible_effects.append((effect, information, float(share), int(rank), basis))
    return effect_detectability(visible_effects, len(variants)) if visible_effects else None


def effect_detectability(
    visible_effects: Sequence[tuple[Effect, Floats, float, int, Floats]], n_variants: int
) -> EffectDetectability:
    """Detectability of one effect, from that part of its changes of the readings which remains in the residuals.

    Each element of `visible_effects` contains a variant of the effect, the information matrix of its parameters, the
    fraction of the change that remains in the residuals, the rank of the matrix, and an orthonormal basis of the change
    of the residuals. `n_variants` is the number of variants that a diagnosis tests.
    """
    effects, information, visible, spent, columns = zip(*visible_effects, strict=True)
    noncentralities = [search_noncentrality(max(dof, 1), n_variants) for dof in spent]
    minimal_detectable_sizes = tuple(map(_minimal_detectable_sizes, information, noncentralities))
    names, laws = tuple(map(_variant_text, effects)), tuple(effect.parameters for effect in effects)
    return EffectDetectability(effects[0].name, laws, names, minimal_detectable_sizes, visible, columns)


def visible_information(
    gram_matrices: Floats, column_norms: Floats, min_visible_fraction: float
) -> tuple[Floats, Floats, Ints]:
    """Information matrices (..., q, q) of effects with q parameters, visible fractions (...), and ranks (...).

    The visible fraction of an effect is the part of its change of the readings (sum of squares) that remains in the
    residuals. The design columns of the effects had the lengths `column_norms` (..., q) before they were scaled to unit
    length and projected onto the residual space. `gram_matrices` (..., q, q) are the inner products after the
    projection. Eigenvalues and squared lengths below `min_visible_fraction` count as rounding errors.
    """
    share = np.einsum("...ii->...i", gram_matrices)
    visible_norms = np.where(share < min_visible_fraction, 0.0, column_norms)
    rank = np.sum(np.linalg.eigvalsh(gram_matrices) > min_visible_fraction, axis=-1)
    return gram_matrices * visible_norms[..., :, None] * visible_norms[..., None, :], np.mean(share, axis=-1), rank


def _minimal_detectable_sizes(information: Floats, noncentrality: float) -> Floats:
    """Minimal detectable sizes (q,) of q parameters, each acting alone, from their information matrix (q, q).

    A size is infinite without information on the parameter. `noncentrality` is that at which an effect is detected.
    """
    diagonal = np.diag(information)
    minimal_detectable_sizes = np.full(len(diagonal), np.inf)
    minimal_detectable_sizes[diagonal > 0] = np.sqrt(noncentrality / diagonal[diagonal > 0])
    return minimal_detectable_sizes


def _variant_text(effect: Effect) -> str:
    """Text with the stations, targets and shape parameters of an effect."""
    names = [*effect.stations, *effect.targets]
    for shape in type(effect).shape_parameters:
        value = getattr(effect, shape.name, None)
        if isinstance(value, float):
            names.append(f"{shape.name} {value:.3g}")
    return " ".join(names)


def calibrated_effect_detectability(adjustment: Adjustment, effect: Effect) -> EffectDetectability:
    """Detectability of an effect whose parameters the adjustment estimates as instrument parameters.

    A diagnosis does not test such an effect. Its minimal detectable size is that at which the estimate differs
    significantly from zero in 80 % of cases.
    """
    indices = [adjustment.construction.parameter_index(p.name) for p in effect.parameters]
    block, prior = (
        adjustment.first_instrument_covariance[np.ix_(indices, indices)],
        adjustment.problem.prior.sigma[0][indices],
    )
    information: Floats = np.asarray(np.linalg.inv(block) - np.diag(1.0 / prior**2), dtype=np.float64)
    information[np.diag(information) * prior**2 < SQRT_MACHINE_EPSILON] = 0.0
    minimal_detectable_sizes = _minimal_detectable_sizes(information, noncentrality(len(information)))
    return EffectDetectability(effect.name, (effect.parameters,), ("",), (minimal_detectable_sizes,), (1.0,), ())


def explained_fraction(first_detectability: EffectDetectability, second_detectability: EffectDetectability) -> float:
    """Fraction of the change of the residuals by a first effect that a second effect explains.

    The second effect is taken in the variant that explains most, as in a diagnosis. The result is the median over the
    variants of the first effect.
    """
    if not any(b.shape[1] for b in second_detectability.projected_basis):
        return 0.0
    rivals = np.hstack([b for b in second_detectability.projected_basis if b.shape[1]])
    starts = np.cumsum([0, *(b.shape[1] for b in second_detectability.projected_basis if b.shape[1])])[:-1]
    shares = []
    for columns in first_detectability.projected_basis:
        if columns.shape[1]:
            overlap = (rivals.T @ columns) ** 2
            shares.append(float(np.add.reduceat(overlap.sum(axis=1), starts).max()) / columns.shape[1])
    return float(np.median(shares)) if shares else 0.0


@dataclass(frozen=True)
class CatalogueDetectability:
    """Detectability, in one network, of all physical effects of a list (catalogue)."""

    effects: tuple[EffectDetectability, ...]
    """Detectability of each effect that changes the residuals, or whose parameters the adjustment estimates."""
    undetectable_effects: tuple[str, ...]
    """Names of effects that do not change the residuals, or that depend on data which the recording lacks; without
    blunders such as exchanged names, which separate tests identify."""
    detectable_effects: tuple[str, ...]
    """Names of the e effects that change the residuals."""
    explained_fractions: Floats
    """Fractions (e, e) of the change of the residuals by effect i that effect j explains, for the e
    `detectable_effects`."""

    def table(self) -> list[MinimalDetectableSize]:
        """Minimal detectable sizes of the parameters of all effects, one entry per parameter."""
        return [row for effect_report in self.effects for row in effect_report.table()]

    def confusable_pairs(self) -> list[tuple[str, str, float]]:
        """Pairs of effects that are hard to distinguish: names, and fraction of the first that the second explains.

        The pair with the largest fraction is first.
        """
        first, second = np.nonzero(
            (self.explained_fractions > MIN_EQUIVALENT_SQUARED_CORRELATION)
            & ~np.eye(len(self.detectable_effects), dtype=bool)
        )
        effect_pairs = [
            (self.detectable_effects[i], self.detectable_effects[j], float(self.explained_fractions[i, j]))
            for i, j in zip(first, second, strict=True)
        ]
        return sorted(effect_pairs, key=lambda pair: -pair[2])


def catalogue_detectability(
    adjustment: Adjustment, catalogue: Sequence[type[Effect] | Effect]
) -> CatalogueDetectability:
    """Detectability of all physical effects of the list `catalogue` in an adjusted or planned network.

    Effects whose parameters the adjustment estimates are treated as estimated, all others as tested by a diagnosis.
    """
    space = ResidualSpace.from_adjustment(adjustment)
    estimated_names = set(adjustment.construction.parameter_names)
    reports: list[EffectDetectability] = []
    silent: list[str] = []
    for entry in catalogue:
        kind = entry if isinstance(entry, type) else type(entry)
        if issubclass(kind, Blunder):
            continue
        if kind.parameters and {p.name for p in kind.parameters} <= estimated_names:
            reports.append(calibrated_effect_detectability(adjustment, kind()))
            continue
        effect_report = detectability_of_variants(space, kind.candidates(adjustment.sightings))
        if effect_report is None or not any(np.isfinite(size).any() for size in effect_report.minimal_detectable_sizes):
            silent.append(kind.name)
        if effect_report is not None:
            reports.append(effect_report)
    signed_reports = [effect_report for effect_report in reports if any(b.size for b in effect_report.projected_basis)]
    similarity = np.array([[explained_fraction(a, b) for b in signed_reports] for a in signed_reports]).reshape(
        len(signed_reports), -1
    )
    return CatalogueDetectability(tuple(reports), tuple(silent), tuple(s.name for s in signed_reports), similarity)
