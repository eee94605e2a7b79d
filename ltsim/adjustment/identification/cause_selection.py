"""Selected hypotheses on the causes of a misfit, how commands use them, and an adjustment with them in the model.

References
----------
Teunissen, Testing theory (2006): adaptation of the model follows detection and identification.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.estimate import adjust
from ltsim.adjustment.identification.fit import NetworkFit
from ltsim.adjustment.identification.hypothesis import (
    CauseHypothesis,
    CentringChange,
    CoordinateExchange,
    NoiseFactorChange,
    ReadingShiftChange,
    ReferenceOmission,
)
from ltsim.adjustment.identification.model_changes import apply_corrections_and_omissions
from ltsim.adjustment.significance import FAMILY_WISE_LEVEL, MAX_TRACKER_ERROR, MIN_LOG_EVIDENCE_CERTAIN
from ltsim.adjustment.station_motions import FittedMotion, SuddenMotion
from ltsim.core.arrays import Floats
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.physics.effects.station_bump import StationBump
from ltsim.physics.effects.target_moved import TargetMoved
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.recording import Recording

INFINITE_GAIN_SUBSTITUTE = float(np.finfo(np.float32).max)
"""Finite number that replaces an infinite gain of log evidence, which a hypothesis has if no fit is possible without
it."""
SYSTEMATIC_CAUSE_KINDS = (
    "constant-offset",
    "constant-step",
    "constant-drift",
    "scale-error",
    "orientation",
    "station-settling",
    "reflector-radius",
    "reflector-seating",
    "centring",
)
"""Kinds of causes that change all readings of an observable, of a set-up, or from one set-up to one target."""
MAX_MISCLOSURE_OF_USED_REFERENCE = 0.1
"""Limit of the misclosure [m] of a reference value. A value with a larger misclosure is excluded before an adjustment,
because the adjustment may not converge with it."""
RANGE_CONSTANT_BY_ERROR_KIND = {"constant-offset": "range-offset", "scale-error": "range-scale"}
"""Range constant of an instrument (name of its parameter) that an error of all distances may come from, by the kind of
the error."""
DISPLACED_REFLECTOR_KINDS = ("reflector-seating", "target-moved")
"""Kinds of causes that displace the reflector at one target."""


def largest_displacement(fit: NetworkFit, hypothesis: CauseHypothesis) -> float:
    """Largest displacement [m] of a measured point, or misclosure of a reference value, by the error of a hypothesis.

    The result is 0 for a hypothesis on the size of the noise and for wrongly recorded pointings.
    """
    change, sightings = hypothesis.model_change, fit.adjustment.sightings
    if isinstance(change, ReferenceOmission):
        return float(np.abs(fit.misclosure_of(change.reference_value)).max())
    if isinstance(change, CentringChange):
        return float(np.abs(fit.estimate_and_covariance(hypothesis)[0]).max())
    if not isinstance(change, ReadingShiftChange):
        return 0.0
    displacements = np.abs(change.effect.design(sightings) @ fit.estimate_and_covariance(hypothesis)[0])
    return float(np.max(displacements * sightings.displacement_per_reading))


def has_larger_noise_of_all_readings(fit: NetworkFit) -> bool:
    """True if a fit contains noise of all readings larger than declared, which may conceal an unmodelled error."""
    general = (h.model_change for h in fit.hypotheses if not h.stations and not h.targets)
    return any(isinstance(change, NoiseFactorChange) and change.start_factor > 1.0 for change in general)


@dataclass(frozen=True)
class SelectedHypothesis:
    """Selected hypothesis on a cause of the misfit, its gain of log evidence, and alternatives fitted in its place."""

    hypothesis: CauseHypothesis
    """Hypothesis on a cause of the misfit, as selected by its log evidence."""
    log_evidence_gain: float
    """Log evidence of the fit with all selected hypotheses, minus that of the fit without this hypothesis."""
    alternatives: tuple[tuple[CauseHypothesis, float], ...]
    """Alternative hypotheses, each with the gain of log evidence if it replaces this hypothesis."""

    @property
    def is_certain(self) -> bool:
        """True if the gain of log evidence exceeds `MIN_LOG_EVIDENCE_CERTAIN`, or for a displaced reflector.

        Readings to a displaced reflector are wrong in any case: without this hypothesis they are outliers.
        """
        return self.log_evidence_gain > MIN_LOG_EVIDENCE_CERTAIN or self.hypothesis.kind in DISPLACED_REFLECTOR_KINDS

    @property
    def posterior_probabilities(self) -> Floats:
        """Posterior probabilities (k + 2,): of this hypothesis, of its k alternatives, and of no error at all."""
        every = [self.log_evidence_gain, *(gain for _, gain in self.alternatives), 0.0]
        gains = np.minimum(every, INFINITE_GAIN_SUBSTITUTE)
        return np.asarray(np.exp(gains - np.logaddexp.reduce(gains)))


@dataclass(frozen=True)
class CauseSelection:
    """Result of the identification: network fitted with the selected hypotheses on the causes of its misfit."""

    fit: NetworkFit
    """Network fit with all selected hypotheses in its model."""
    selected_hypotheses: tuple[SelectedHypothesis, ...]
    """Selected hypotheses: first errors of readings and reference values, then hypotheses on the size of the noise and
    on centring errors; in each group the hypothesis with the largest gain of log evidence first."""

    @property
    def _certain_hypotheses(self) -> list[CauseHypothesis]:
        """Selected hypotheses that are certain: with a large gain of log evidence, or on a badly seated reflector."""
        return [c.hypothesis for c in self.selected_hypotheses if c.is_certain]

    @property
    def _certain_effects(self) -> list[LinearEffect]:
        """Effects, such as motions and offsets, of those selected hypotheses that are certain and shift readings."""
        changes = (h.model_change for h in self._certain_hypotheses)
        return [change.effect for change in changes if isinstance(change, ReadingShiftChange)]

    @property
    def requires_adjustment_with_causes(self) -> bool:
        """True if the selected hypotheses must be in the model before other tests of the network are possible.

        Such hypotheses, if their gain of log evidence is large, are errors of all readings of a set-up or target,
        exchanged reference coordinates, and a reference value with a large error. The adjustment itself tests motions
        of stations and other reference values.
        """
        certain = self._certain_hypotheses
        shared = [h for h in certain if h.kind in SYSTEMATIC_CAUSE_KINDS]
        reference_errors = [h for h in certain if h.kind == "reference-value" and h.acts_on != "mark"]
        large_reference_errors = [
            h for h in reference_errors if largest_displacement(self.fit, h) > MAX_MISCLOSURE_OF_USED_REFERENCE
        ]
        exchanged = any(isinstance(h.model_change, CoordinateExchange) for h in certain)
        gross = (
            exchanged
            or any(largest_displacement(self.fit, h) > MAX_TRACKER_ERROR for h in shared)
            or len(large_reference_errors) == 1
        )
        model_changes = [c.hypothesis.model_change for c in self.selected_hypotheses]
        noisy = any(isinstance(change, NoiseFactorChange) and change.start_factor >= 1.0 for change in model_changes)
        return gross or (bool(shared) and not noisy and self.fit.adjustment.p_value > FAMILY_WISE_LEVEL)

    @property
    def has_unit_errors(self) -> bool:
        """True if set-ups or faces were recorded in another unit or convention, which the fit converts."""
        return any(choice.hypothesis.kind == "unit" for choice in self.selected_hypotheses)

    @property
    def wrong_range_constants(self) -> tuple[str, ...]:
        """Range constants (names of instrument parameters) that explain selected errors of all distances.

        The limit of the displacement is `MAX_TRACKER_ERROR`; a larger offset is that of another reflector, a larger
        scale error that of another unit.
        """
        return tuple(
            RANGE_CONSTANT_BY_ERROR_KIND[h.kind]
            for h in (choice.hypothesis for choice in self.selected_hypotheses)
            if h.kind in RANGE_CONSTANT_BY_ERROR_KIND and h.acts_on == "distance"
            if len(h.stations) != 1 and not h.targets and largest_displacement(self.fit, h) < MAX_TRACKER_ERROR
        )

    @property
    def certain_station_motions(self) -> tuple[FittedMotion, ...]:
        """Motions of stations that are certain (large gain of log evidence); for each station only the likeliest."""
        motions: dict[tuple[str, ...], FittedMotion] = {}
        for effect in self._certain_effects:
            motion = SuddenMotion(effect.stations, time=effect.time) if isinstance(effect, StationBump) else effect
            if isinstance(motion, FittedMotion):
                motions.setdefault(motion.stations, motion)
        return tuple(motions.values())

    @property
    def certain_target_motions(self) -> tuple[TargetMoved, ...]:
        """Motions of targets that the model contains, because the hypotheses on them are certain."""
        return tuple(effect for effect in self._certain_effects if isinstance(effect, TargetMoved))

    @property
    def has_shifts_other_than_motions(self) -> bool:
        """True if a selected hypothesis shifts readings in another way than the `certain_station_motions` do."""
        changes = [choice.hypothesis.model_change for choice in self.selected_hypotheses]
        return sum(isinstance(change, ReadingShiftChange) for change in changes) > len(self.certain_station_motions)

    @property
    def larger_noise_hypotheses(self) -> tuple[CauseHypothesis, ...]:
        """Selected hypotheses if all of them are other noise than declared and some of it is larger; otherwise empty.

        They are also empty if they do not explain the misfit.
        """
        chosen = tuple(choice.hypothesis for choice in self.selected_hypotheses)
        is_noise = all(isinstance(h.model_change, NoiseFactorChange) for h in chosen)
        return chosen if self.is_consistent and is_noise and max(self._noise_factors) > 1.0 else ()

    @property
    def _noise_factors(self) -> list[float]:
        """Factors on the declared noise, one for each selected hypothesis on the noise (start values of its fit)."""
        changes = (choice.hypothesis.model_change for choice in self.selected_hypotheses)
        return [change.start_factor for change in changes if isinstance(change, NoiseFactorChange)]

    @property
    def is_consistent(self) -> bool:
        """True if the selected hypotheses explain the misfit: the global test passes and all hypotheses are certain.

        The result is also False for set-ups in another unit or sense of rotation (the recording must be read again),
        noise smaller than declared (outliers may then be errors of the model) unless other noise is larger and no
        outlier remains, larger noise with remaining outliers, and wrong reference values or set-ups over marks (other
        tests are more specific).
        """
        changes = [c.hypothesis.model_change for c in self.selected_hypotheses]
        factors = self._noise_factors
        quieter = min(factors, default=1.0) < 1.0 and (max(factors) <= 1.0 or bool(self.fit.is_outlier.any()))
        omitted = any(isinstance(change, ReferenceOmission) for change in changes)
        others = omitted or any(self.fit.problem.marks.mark_names)
        doubtful = quieter or others or (has_larger_noise_of_all_readings(self.fit) and bool(self.fit.is_outlier.any()))
        causes = self.selected_hypotheses
        sure = all(c.is_certain and c.hypothesis.kind != "unit" for c in causes)
        return bool(changes) and sure and not doubtful and self.fit.adjustment.p_value > FAMILY_WISE_LEVEL


def adjust_with_causes(
    fit: NetworkFit,
    recording: Recording,
    construction: GeometricErrorModel,
    hypotheses: Sequence[CauseHypothesis],
    *,
    effects: Sequence[LinearEffect] = (),
    subtracts_changes: bool = False,
    **options: Any,
) -> Adjustment:
    """Adjustment of a recording with identified errors (hypotheses) in its model, from the start state of a fit.

    Parameters
    ----------
    fit : NetworkFit
        Network fit that contains the hypotheses; its state is the start state.
    recording : Recording
        Recording as it was read from its file.
    construction : GeometricErrorModel
        Geometric error model of the tracker; its parameters are estimated.
    hypotheses : sequence of CauseHypothesis
        Hypotheses of the fit that the model contains: either all or none of the shifts of readings, and any selection
        of the other hypotheses.
    effects : sequence of LinearEffect
        Further effects to estimate; their parameters precede those of the shifts.
    subtracts_changes : bool
        True to subtract the estimated shifts from the readings first, so that only the remaining shifts are estimated,
        from start values of zero. Otherwise the start values are the estimates of the fit.
    **options
        Further keyword arguments of `adjust`.
    """
    changed, shifts, values = (
        apply_corrections_and_omissions(recording, hypotheses),
        tuple[LinearEffect, ...](),
        np.zeros(0),
    )
    if any(isinstance(h.model_change, ReadingShiftChange) for h in hypotheses):
        shifts, values = fit.effects, fit.state.extra_parameters
        if subtracts_changes:
            changed = changed.with_readings(fit.correct_recording(recording, keeps_outliers=True).readings)
            values = np.zeros_like(values)
    instrument = np.zeros((len(recording.instruments), construction.n_parameters))
    if construction.n_parameters == fit.state.instrument_parameters.shape[1]:
        instrument = fit.state.instrument_parameters
    effect_values = np.zeros(sum(len(e.parameters) for e in effects))
    start_state = replace(
        fit.state, instrument_parameters=instrument, extra_parameters=np.concatenate([effect_values, values])
    )
    return adjust(changed, construction, effects=(*effects, *shifts), start_state=start_state, **options)
