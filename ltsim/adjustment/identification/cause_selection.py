"""Selected simple causes of a network, and what a verb does with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.adjustment.identification.fit import NetworkFit
from ltsim.adjustment.identification.hypothesis import (
    CentringChange,
    CoordinateExchange,
    Hypothesis,
    NoiseFactor,
    ReadingShiftChange,
    ReferenceOmission,
)
from ltsim.adjustment.identification.signatures import displacement_per_reading
from ltsim.adjustment.significance import FAMILY_LEVEL
from ltsim.adjustment.snooping import MAX_TRACKER_ERROR
from ltsim.adjustment.station_motions import FittedMotion, SuddenMotion
from ltsim.core.arrays import Floats
from ltsim.physics.effects.station_bump import StationBump

MAX_LOG_EVIDENCE_GAIN = 1e30
"""Log evidence that replaces an infinite one, of a hypothesis without which there is no network."""
MIN_LOG_EVIDENCE_CERTAIN = 7.0
"""Log evidence of a cause (odds of 1000 to 1) from which the whole network is adjusted with it."""
SHARED_CAUSE_KINDS = (
    "constant-offset",
    "constant-step",
    "constant-drift",
    "scale-error",
    "orientation",
    "reflector-radius",
    "centring",
)
"""Kinds of causes that all readings of one observable, or of one set-up, share."""
MAX_REFERENCE_MISCLOSURE = 0.1
"""Misclosure of a reference value [m] above which a network that uses it may not converge."""


def largest_displacement(fit: NetworkFit, hypothesis: Hypothesis) -> float:
    """Largest displacement [m] of a reading, or misclosure of a reference value, by a hypothesis in the model."""
    change, sightings = hypothesis.model_change, fit.adjustment.sightings
    if isinstance(change, ReferenceOmission):
        return float(np.abs(fit.misclosure_of(change.reference_value)).max())
    if isinstance(change, CentringChange):
        return float(np.abs(fit.estimate(hypothesis)[0]).max())
    if not isinstance(change, ReadingShiftChange):
        return 0.0
    displacements = np.abs(change.effect.design(sightings) @ fit.estimate(hypothesis)[0])
    return float(np.max(displacements * displacement_per_reading(sightings)))


def has_general_misfit(fit: NetworkFit) -> bool:
    """True if all readings scatter more than declared, so that residuals may come from a misfit of the model."""
    general = (h.model_change for h in fit.hypotheses if not h.stations and not h.targets)
    return any(isinstance(change, NoiseFactor) and change.start_factor > 1.0 for change in general)


@dataclass(frozen=True)
class SelectedHypothesis:
    """Selected hypothesis, its gain of log evidence given the others, and the alternatives fitted in its place."""

    hypothesis: Hypothesis
    log_evidence_gain: float
    alternatives: tuple[tuple[Hypothesis, float], ...]

    @property
    def probabilities(self) -> Floats:
        """Posterior probabilities (2 + k,) of the hypothesis, of its k alternatives, and of none of them."""
        every = [self.log_evidence_gain, *(gain for _, gain in self.alternatives), 0.0]
        gains = np.minimum(every, MAX_LOG_EVIDENCE_GAIN)
        return np.asarray(np.exp(gains - np.logaddexp.reduce(gains)))


@dataclass(frozen=True)
class CauseSelection:
    """Network with the simple causes that the readings support.

    Attributes
    ----------
    fit : NetworkFit
    selected_hypotheses : tuple of SelectedHypothesis
        Selected shifts, then changes of the noise; the most certain first in each group.
    """

    fit: NetworkFit
    selected_hypotheses: tuple[SelectedHypothesis, ...]

    @property
    def requires_initial_causes(self) -> bool:
        """True if the network must be adjusted with the selected hypotheses from the start to be consistent.

        An error that all readings of a set-up or target share, or a reference value that is far off, prevents all other
        tests, also if the noise is smaller than declared. Single motions and reference values have separate tests.
        """
        sure = [c.hypothesis for c in self.selected_hypotheses if c.log_evidence_gain > MIN_LOG_EVIDENCE_CERTAIN]
        shared = [h for h in sure if h.kind in SHARED_CAUSE_KINDS]
        values = [h for h in sure if h.kind == "reference-value" and h.acts_on != "mark"]
        far = [h for h in values if largest_displacement(self.fit, h) > MAX_REFERENCE_MISCLOSURE]
        exchanged = any(isinstance(h.model_change, CoordinateExchange) for h in sure)
        gross = exchanged or any(largest_displacement(self.fit, h) > MAX_TRACKER_ERROR for h in shared) or len(far) == 1
        changes = [c.hypothesis.model_change for c in self.selected_hypotheses]
        noisy = any(isinstance(change, NoiseFactor) and change.start_factor >= 1.0 for change in changes)
        return gross or (bool(shared) and not noisy and self.fit.adjustment.p_value > FAMILY_LEVEL)

    @property
    def certain_motions(self) -> tuple[FittedMotion, ...]:
        """Motions beyond doubt, the surest of each station, for an adjustment without the other hypotheses."""
        certain = (c for c in self.selected_hypotheses if c.log_evidence_gain > MIN_LOG_EVIDENCE_CERTAIN)
        sure = [c.hypothesis.model_change for c in certain]
        motions: dict[tuple[str, ...], FittedMotion] = {}
        for effect in (change.effect for change in sure if isinstance(change, ReadingShiftChange)):
            motion = SuddenMotion(effect.stations, time=effect.time) if isinstance(effect, StationBump) else effect
            if isinstance(motion, FittedMotion):
                motions.setdefault(motion.stations, motion)
        return tuple(motions.values())

    @property
    def has_shifts_other_than_motions(self) -> bool:
        """True if a selected shift is none of `certain_motions`, which an adjustment estimates in any case."""
        changes = [choice.hypothesis.model_change for choice in self.selected_hypotheses]
        return sum(isinstance(change, ReadingShiftChange) for change in changes) > len(self.certain_motions)

    @property
    def is_consistent(self) -> bool:
        """True if the network is consistent with the selected hypotheses and none of them is doubtful.

        Excluded are set-ups in another unit or sense (their rows are read again), noise smaller than declared (its
        outliers may be none), and larger noise with remaining outliers. Reference values and tripods over marks have
        more specific tests.
        """
        changes = [c.hypothesis.model_change for c in self.selected_hypotheses]
        quieter = any(isinstance(change, NoiseFactor) and change.start_factor < 1.0 for change in changes)
        omitted = any(isinstance(change, ReferenceOmission) for change in changes)
        others = omitted or any(self.fit.problem.marks.mark_names)
        doubtful = quieter or others or (has_general_misfit(self.fit) and bool(self.fit.is_outlier.any()))
        causes = self.selected_hypotheses
        sure = all(c.log_evidence_gain > MIN_LOG_EVIDENCE_CERTAIN and c.hypothesis.kind != "unit" for c in causes)
        return bool(changes) and sure and not doubtful and self.fit.adjustment.p_value > FAMILY_LEVEL
