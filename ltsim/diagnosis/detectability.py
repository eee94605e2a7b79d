"""Detectability of effects in a network, and the measurement that discriminates between explanations."""

from collections.abc import Iterable, Sequence
from itertools import groupby, repeat

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.remedies.detectability import (
    EffectDetectability,
    MinimalSize,
    effect_detectability,
    select_places,
    visible_information,
)
from ltsim.adjustment.remedies.next_measurement import best_explanation, rank_deciding_measurements, residual_space_of
from ltsim.adjustment.remedies.remedy import advice_sentence
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats, batches
from ltsim.core.errors import ModelError
from ltsim.core.rounding import MAX_SOLUTION_ROUNDING_ERROR
from ltsim.diagnosis.catalogue_signatures import CatalogueSignatures
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.schema import Undetectable
from ltsim.geometry.rigid import rigid_motion_design
from ltsim.physics.effects import find_effect
from ltsim.physics.effects.effect import Effect, NoiseEffect
from ltsim.physics.effects.signature import Signature

MAX_DETECTABLE_SIZE_RATIO = 10.0
"""Multiple of a large but plausible size above which a detectable size counts as undetectable."""
DISTORTION_DECIMALS = 6
"""Decimals [um] to which a distortion is rounded."""
DetectabilityReport = tuple[tuple[MinimalSize, ...], tuple[Undetectable, ...]]


def detectability_report(space: ResidualSpace, catalogue_signatures: CatalogueSignatures) -> DetectabilityReport:
    """Detectable effects, and undetectable ones with the target error that they cause, the largest first.

    For an effect with several parameters the parameter with the smallest ratio of detectable to plausible size at a
    median place is reported.

    Parameters
    ----------
    catalogue_signatures : CatalogueSignatures
        All hypotheses of the catalogue.
    """
    detectable, hidden = [], []
    for effects in catalogue_signatures.effects_by_family():
        rows = _detectability_of_effects(space, effects).table()
        times = np.array([row.median_size / row.prior_sigma for row in rows])
        best = int(np.flatnonzero(times <= times.min() * (1.0 + MAX_SOLUTION_ROUNDING_ERROR))[0])
        if times[best] < MAX_DETECTABLE_SIZE_RATIO:
            detectable.append(rows[best])
        else:
            hidden.append(_undetectable_entry(space, effects[(len(effects) - 1) // 2], float(times[best])))
    return tuple(detectable), tuple(sorted(hidden, key=lambda entry: -(entry.undetected_target_error_um or 0.0)))


def _detectability_of_effects(space: ResidualSpace, effects: Sequence[Effect]) -> EffectDetectability:
    """Detectability of an effect at a sample of its places, in double precision."""
    entries: list[tuple[Effect, Floats, float, int, Floats]] = []
    for size, same in groupby(select_places(effects), key=lambda effect: len(effect.parameters)):
        sample = list(same)
        for batch in (sample[part] for part in batches(len(sample), space.n_rows * size)):
            signatures = np.hstack([space.whitened_signature(effect) for effect in batch])
            edges = np.arange(0, signatures.shape[1] + 1, size)
            grams = np.stack(space.projector.gram_matrices(signatures, edges, slice(None)))
            norm = np.linalg.norm(signatures, axis=0).reshape(-1, size)
            unit = np.where(norm > 0, norm, 1.0)
            information, share, rank = visible_information(
                grams / (unit[:, :, None] * unit[:, None, :]), norm, MAX_SOLUTION_ROUNDING_ERROR
            )
            entries += zip(batch, information, share.tolist(), rank.tolist(), repeat(np.zeros((0, 0))))
    return effect_detectability(entries, len(effects))


def _undetectable_entry(space: ResidualSpace, effect: Effect, times: float) -> Undetectable:
    sizes = np.diag([p.prior_sigma for p in effect.parameters])
    hides = round(
        max(target_distortion(space, space.whitened_signature(effect) @ size) for size in sizes), DISTORTION_DECIMALS
    )
    size = f"only from {times:.0f} times its plausible size on" if np.isfinite(times) else "at no size"
    reason = f"absorbed by poses, targets and instrument parameters: it would be detected {size}"
    factor = times if np.isfinite(times) else None
    return Undetectable(
        effect=effect.name,
        reason=reason,
        undetected_target_error_um=hides,
        detectable_at_factor=factor,
        cure=advice_sentence("cause"),
    )


def target_distortion(space: ResidualSpace, shift: Floats) -> float:
    """Distortion of the adjusted targets by a whitened shift (m,) of readings: rms [um] after the best rigid fit."""
    shifts = space.target_shifts(shift).ravel()
    points = space.adjustment.state.target_points
    motion = rigid_motion_design(points, points.mean(axis=0))
    distortion = shifts - motion @ np.linalg.lstsq(motion, shifts, rcond=None)[0]
    return float(1e6 * np.sqrt(3 * np.mean(distortion**2)))


def separating_measurement(
    adjustment: Adjustment, effect: str, equivalents: Iterable[str], with_effects: Sequence[Signature]
) -> str:
    """Sentence on the measurement that discriminates an effect from its equivalents; empty without equivalents.

    Parameters
    ----------
    with_effects : sequence of Signature
        The other findings.
    """
    names = _comparable_effects(effect, equivalents)
    if not names:
        return ""
    space = residual_space_of(adjustment, with_effects)
    try:
        explanations = [best_explanation(space, name) for name in names]
    except ModelError:  # the network absorbs one of them
        return ""
    return rank_deciding_measurements(adjustment, explanations, with_effects, stops_at_first=True).advice_sentence


def ambiguous_explanations(diagnosis: Diagnosis) -> tuple[tuple[str, ...], tuple[Signature, ...]]:
    """Alternative explanations of the first ambiguous finding of a diagnosis, and the other effects of its model."""
    for finding in diagnosis.findings:
        names = (
            _comparable_effects(finding.effect, [other.effect for other in finding.equivalents])
            if finding.is_catalogued
            else ()
        )
        if names:
            return names, tuple(e for e in diagnosis.final_adjustment.effects if e.name != finding.effect)
    return (), ()


def _comparable_effects(effect: str, equivalents: Iterable[str]) -> tuple[str, ...]:
    """An effect and its equivalents that shift readings; empty where there is nothing to compare."""
    remaining = [name for name in equivalents if name != "unknown" and _shifts_readings(name)]
    return (effect, *remaining) if remaining and _shifts_readings(effect) else ()


def _shifts_readings(name: str) -> bool:
    return not issubclass(find_effect(name), NoiseEffect)
