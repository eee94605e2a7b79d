"""Reported uncertainty: increased if the readings contradict the model, and with the air for long ranges."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from scipy.linalg import block_diag

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.joint import MOST_TARGETS, covariance_csv
from ltsim.adjustment.unmodelled import (
    air_covariance,
    counted_air,
    hidden_displacements,
    joint_air_covariance,
    longest_sight,
)
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.schema import Fit, FittedEffectEntry, ReflectorEntry, StationPose
from ltsim.calibration.uncertainty import HiddenError
from ltsim.core.arrays import Floats
from ltsim.core.probability import AGREEMENT_LEVEL
from ltsim.core.units import ARCSECOND, MICROMETRE, MILLIMETRE
from ltsim.physics.effects.air import air_uncertainty_text

FittedT = TypeVar("FittedT", FittedEffectEntry, ReflectorEntry)
MATTERS = 0.2
"""Smallest displacement, relative to the targets' rms standard deviation, of a reported error without effect on the
readings.
"""


def uncertainty_factor(fit: Fit, *, by_estimate: bool | None = None) -> float:
    """Factor on the standard deviations: sigma0 if it is significantly above 1 and not due to single readings, else 1.

    `by_estimate` is the verdict of the tests; without it the global test decides, at the level `AGREEMENT_LEVEL`.
    """
    if fit.sigma0 is None or fit.sigma0 <= 1.0:
        return 1.0
    rejected = fit.p_value is not None and fit.p_value < AGREEMENT_LEVEL / 2
    return fit.sigma0 if (rejected if by_estimate is None else by_estimate) else 1.0


def reported(calibration: Calibration) -> Calibration:
    """Calibration with the reported standard deviations of its targets, stations and parameters."""
    verdict, adjustment = calibration.verdict, calibration.adjustment
    factor = uncertainty_factor(calibration.fit, by_estimate=verdict.scale_by_sigma0 if verdict.case else None)
    if adjustment is None:
        return calibration
    unknowns = adjustment.problem.unknowns
    covariance = factor**2 * calibration.target_covariance + air_covariance(adjustment, unknowns.target)
    stations = air_covariance(adjustment, unknowns.pose)
    return calibration.with_changes(
        covariance=_scaled_parameters(calibration, factor),
        target_covariance=covariance,
        stations=tuple(_pose(pose, factor, added) for pose, added in zip(calibration.stations, stations, strict=True)),
        effects=tuple(_fitted(effect, factor) for effect in calibration.effects),
        reflectors=tuple(_fitted(reflector, factor) for reflector in calibration.reflectors),
        constants_included=bool(calibration.names) or adjustment.recording.is_corrected,
        uncertainty_factor=factor,
        air=_air_words(adjustment),
        hidden=_hidden(adjustment, covariance),
    )


def joint_csv(calibration: Calibration) -> str | None:
    """Content of `targets.covariance.csv`; None for many targets or without a network."""
    adjustment = calibration.adjustment
    if adjustment is None or len(calibration.targets) > MOST_TARGETS:
        return None
    added = joint_air_covariance(adjustment)
    return covariance_csv(adjustment, factor=calibration.uncertainty_factor, added=added)


def _scaled_parameters(calibration: Calibration, factor: float) -> Floats:
    """Covariance (I p, I p) with the noise of the readings multiplied by a factor and an unchanged prior.

    With C the covariance in prior standard deviations, C^-1 - 1 is the information of the readings: it falls by the
    factor squared.
    """
    covariance, adjustment = calibration.covariance, calibration.adjustment
    free = np.flatnonzero(~calibration.held.ravel())
    if factor == 1.0 or not len(free) or adjustment is None:
        return covariance
    if calibration.method != "network":
        return factor**2 * covariance
    root = block_diag(*adjustment.problem.prior.roots)[np.ix_(free, free)]
    size, basis = np.linalg.eigh(root @ covariance[np.ix_(free, free)] @ root.T)
    size = np.clip(size, np.finfo(np.float64).tiny, 1.0)
    wider = np.linalg.solve(root, basis * np.sqrt(1.0 / (1.0 + (1.0 / size - 1.0) / factor**2)))
    scaled = np.zeros_like(covariance)
    scaled[np.ix_(free, free)] = wider @ wider.T
    return scaled


def _pose(pose: StationPose, factor: float, added: Floats) -> StationPose:
    """Pose with its standard deviations multiplied by a factor, and with the covariance (6, 6) of the air."""
    air = np.sqrt(np.diag(added))
    sizes = {}
    for name, unit, part in (
        ("sigma_position_mm", MILLIMETRE, air[:3]),
        ("sigma_rotation_arcsec", ARCSECOND, air[3:]),
    ):
        sigma = getattr(pose, name)
        if sigma is not None:
            given = np.array([np.nan if value is None else value for value in sigma])
            sizes[name] = tuple(np.hypot(factor * given, part / unit).tolist())
    return pose.with_values(**sizes)


def _fitted(entry: FittedT, factor: float) -> FittedT:
    """Entry of fitted parameters with standard deviations multiplied by a factor."""
    parameters = tuple(p if p.sigma is None else p.with_values(sigma=factor * p.sigma) for p in entry.parameters)
    return entry.with_values(parameters=parameters)


def _hidden(adjustment: Adjustment, covariance: Floats) -> tuple[HiddenError, ...]:
    """Errors without effect on the readings that move targets by more than `MATTERS` of their standard deviation."""
    variance = np.einsum("tii->t", covariance)
    determined = np.isfinite(variance)
    if not determined.any():
        return ()
    usual, sizes = np.sqrt(np.mean(variance[determined])), hidden_displacements(adjustment)
    return tuple(
        HiddenError(source=name, target_error_um=size / MICROMETRE)
        for name, size in sorted(sizes.items(), key=lambda item: -item[1])
        if size > MATTERS * usual
    )


def _air_words(adjustment: Adjustment) -> str:
    """Text of the errors of the air in the standard deviations; empty for short ranges or undeclared air."""
    air = counted_air(adjustment)
    if air is None or not (air.temperature_k or air.gradient_k_per_m or air.turbulence_um2_per_m3):
        return ""
    return air_uncertainty_text(air, longest_sight(adjustment))
