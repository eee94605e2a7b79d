"""Detectability of the catalogue effects, and the measurement that discriminates between possible causes."""

from collections.abc import Iterable, Sequence
from itertools import groupby, repeat

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.remedies.candidates import advice_sentence
from ltsim.adjustment.remedies.detectability import (
    EffectDetectability,
    MinimalDetectableSize,
    effect_detectability,
    subsample_evenly,
    visible_information,
)
from ltsim.adjustment.remedies.explanations import best_explanation, residual_space_of
from ltsim.adjustment.remedies.next_measurement import rank_deciding_measurements
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats, batches
from ltsim.core.errors import ModelError
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.diagnosis.catalogue_designs import CatalogueDesigns
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.schema import UndetectableEntry
from ltsim.geometry.rigid import rigid_motion_jacobian
from ltsim.physics.effects import find_effect
from ltsim.physics.effects.effect import Effect, NoiseEffect
from ltsim.physics.effects.linear_effect import LinearEffect

MAX_DETECTABLE_TO_PLAUSIBLE_SIZE_RATIO = 10.0
"""Limit of the ratio of the smallest detectable size of an effect to its plausible size. An effect with a smaller ratio
is reported as detectable, any other as not detectable."""
TARGET_DISTORTION_UM_DECIMALS = 6
"""Number of decimals of a rounded distortion of the targets [um]."""
DetectabilityReport = tuple[tuple[MinimalDetectableSize, ...], tuple[UndetectableEntry, ...]]
"""Smallest detectable sizes of the detectable effects, and entries of the effects that are not detectable."""


def detectability_report(space: ResidualSpace, catalogue_designs: CatalogueDesigns) -> DetectabilityReport:
    """Detectable catalogue effects, and undetectable effects sorted by decreasing target errors.

    The smallest detectable size of an effect is the median over the stations and targets where it may act. An effect
    with several parameters is reported with the parameter that has the smallest ratio of the detectable to the
    plausible size. `space` is the residual space of the adjustment (whitened observations without the part that the
    unknowns absorb), and `catalogue_designs` contain all effects of the catalogue at all stations and targets.
    """
    detectable, undetectable = [], []
    for effects in catalogue_designs.effects_grouped_by_family():
        rows = _detectability_of_effects(space, effects).table()
        size_ratios = np.array([row.median_size / row.plausible_size for row in rows])
        best = int(np.flatnonzero(size_ratios <= size_ratios.min() * (1.0 + NORMAL_EQUATIONS_TOLERANCE))[0])
        if size_ratios[best] < MAX_DETECTABLE_TO_PLAUSIBLE_SIZE_RATIO:
            detectable.append(rows[best])
        else:
            undetectable.append(_undetectable_entry(space, effects[(len(effects) - 1) // 2], float(size_ratios[best])))
    return tuple(detectable), tuple(sorted(undetectable, key=lambda entry: -(entry.undetected_target_error_um or 0.0)))


def _detectability_of_effects(space: ResidualSpace, effects: Sequence[Effect]) -> EffectDetectability:
    """Detectability of a catalogue effect at a sample of the stations and targets where it may act.

    It is computed in double precision. `effects` are the variants of the effect, one for each combination of stations,
    targets and shape parameters. `space` is the residual space of the adjustment (whitened observations without the
    part that the unknowns absorb).
    """
    visible_effects: list[tuple[Effect, Floats, float, int, Floats]] = []
    for size, same in groupby(subsample_evenly(effects), key=lambda effect: len(effect.parameters)):
        sample = list(same)
        for batch in (sample[part] for part in batches(len(sample), space.n_equations * size)):
            designs = np.hstack([space.whitened_design(effect) for effect in batch])
            edges = np.arange(0, designs.shape[1] + 1, size)
            grams = np.stack(space.projector.gram_matrices(designs, edges, slice(None)))
            norm = np.linalg.norm(designs, axis=0).reshape(-1, size)
            unit = np.where(norm > 0, norm, 1.0)
            information, share, rank = visible_information(
                grams / (unit[:, :, None] * unit[:, None, :]), norm, NORMAL_EQUATIONS_TOLERANCE
            )
            visible_effects += zip(batch, information, share.tolist(), rank.tolist(), repeat(np.zeros((0, 0))))
    return effect_detectability(visible_effects, len(effects))


def _undetectable_entry(space: ResidualSpace, effect: Effect, detectable_size_ratio: float) -> UndetectableEntry:
    """Entry of `diagnosis.json` for an effect that is not detectable.

    `detectable_size_ratio` is the smallest detectable size of the effect divided by its plausible size.
    """
    plausible_changes = np.diag([p.prior_sigma for p in effect.parameters])
    distortion = round(
        max(target_distortion_um(space, space.whitened_design(effect) @ sizes) for sizes in plausible_changes),
        TARGET_DISTORTION_UM_DECIMALS,
    )
    size_text = (
        f"only if its size is at least {detectable_size_ratio:.0f} times the plausible size"
        if np.isfinite(detectable_size_ratio)
        else "at no size"
    )
    reason = f"poses, targets and instrument parameters absorb the effect: it is detected {size_text}"
    factor = detectable_size_ratio if np.isfinite(detectable_size_ratio) else None
    return UndetectableEntry(
        effect=effect.name,
        reason=reason,
        undetected_target_error_um=distortion,
        detectable_at_factor=factor,
        cure=advice_sentence("cause"),
    )


def target_distortion_um(space: ResidualSpace, shift: Floats) -> float:
    """Distortion [um] of the adjusted targets by a whitened `shift` (m,) of m observations.

    It is the rms displacement of the targets after a rigid least-squares fit.
    """
    shifts = space.target_shifts(shift).ravel()
    points = space.adjustment.state.target_points
    motion = rigid_motion_jacobian(points, points.mean(axis=0))
    distortion = shifts - motion @ np.linalg.lstsq(motion, shifts, rcond=None)[0]
    return float(1e6 * np.sqrt(3 * np.mean(distortion**2)))


def separating_measurement_sentence(
    adjustment: Adjustment, effect_name: str, equivalent_names: Iterable[str], other_effects: Sequence[LinearEffect]
) -> str:
    """Sentence on the measurement that discriminates an effect from its equivalents; empty without equivalents.

    `effect_name` and `equivalent_names` are names of catalogue effects. `other_effects` are the effects of the other
    findings, which are estimated in addition.
    """
    names = _names_of_comparable_effects(effect_name, equivalent_names)
    if not names:
        return ""
    space = residual_space_of(adjustment, other_effects)
    try:
        explanations = [best_explanation(space, name) for name in names]
    except ModelError:  # the network absorbs one of the effects
        return ""
    return rank_deciding_measurements(adjustment, explanations, other_effects, stops_at_first=True).advice_sentence


def explanations_of_ambiguous_finding(diagnosis: Diagnosis) -> tuple[tuple[str, ...], tuple[LinearEffect, ...]]:
    """Names of the possible causes of the first finding with several, and the effects of all other findings.

    Both results are empty for a diagnosis in which no finding has several possible causes.
    """
    for finding in diagnosis.findings:
        names = (
            _names_of_comparable_effects(finding.effect, [other.effect for other in finding.equivalents])
            if finding.is_catalogued
            else ()
        )
        if names:
            return names, tuple(e for e in diagnosis.final_adjustment.effects if e.name != finding.effect)
    return (), ()


def _names_of_comparable_effects(effect_name: str, equivalent_names: Iterable[str]) -> tuple[str, ...]:
    """Names of an effect and of its equivalents that shift readings; empty if there are no such equivalents."""
    remaining = [name for name in equivalent_names if name != "unknown" and _shifts_readings(name)]
    return (effect_name, *remaining) if remaining and _shifts_readings(effect_name) else ()


def _shifts_readings(name: str) -> bool:
    """True if the catalogue effect `name` shifts readings, False if it changes only their noise level."""
    return not issubclass(find_effect(name), NoiseEffect)
