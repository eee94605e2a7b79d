"""Hypotheses on errors of a network: kind of error, where it acts, prior probability, and change of the model."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from ltsim.adjustment.reference_values import ReferenceValue
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.recordings.centring_errors import CentringUncertainty

CauseKind = Literal[
    "outlier",
    "constant-offset",
    "constant-step",
    "constant-drift",
    "scale-error",
    "target-moved",
    "station-bump",
    "station-drift",
    "station-settling",
    "orientation",
    "reflector-radius",
    "reflector-seating",
    "reference-value",
    "reference-scale",
    "names",
    "unit",
    "height",
    "noise-level",
    "centring",
]
"""Kind of a cause of a misfit, that is of a disagreement between readings and model."""


@dataclass(frozen=True)
class ReadingShiftChange:
    """Change of the model by an effect that shifts readings, and whose parameters are estimated."""

    effect: LinearEffect
    """Effect that shifts the readings, such as an offset, a drift or a motion."""
    start_values: tuple[float, ...] = ()
    """Start values [SI] of the parameters of the effect; empty for zeros."""


@dataclass(frozen=True)
class ReferenceOmission:
    """Change of the model by the exclusion of a wrong reference value (known point, length, level)."""

    reference_value: ReferenceValue
    """Excluded reference value."""


@dataclass(frozen=True)
class RowCorrection:
    """Change of the model by the correction of k wrongly recorded pointings (wrong name, unit or face)."""

    pointing_indices: Ints
    """Indices (k,) in the recording of the k pointings to correct."""
    readings: Floats
    """Corrected readings (k, 3) [m, rad, rad] of the k pointings."""
    target_indices: Ints
    """Indices (k,) of the correct targets of the k pointings."""
    faces: Ints
    """Correct face of each of the k pointings, (k,), 1 or 2."""


@dataclass(frozen=True)
class NoiseFactorChange:
    """Change of the model by a common factor on the declared standard deviations of some readings."""

    reading_mask: Bools
    """Flags (n, 3), True for those readings of n pointings whose standard deviations are multiplied."""
    start_factor: float = 1.0
    """Start value of the factor. With large noise a fit that starts at 1 would reject many readings as outliers."""


@dataclass(frozen=True)
class CoordinateExchange:
    """Change of the model by the exchange of the reference coordinates of two targets."""

    target_names: tuple[str, str]
    """Names of the two targets."""


@dataclass(frozen=True)
class CentringChange:
    """Change of the model by centring errors: random displacements of the reflector, new ones at each placement."""

    centring_uncertainty: CentringUncertainty
    """Stations and targets with centring errors, and the standard deviation of the displacements."""
    requires_common_length: bool = False
    """True if the change is possible only with displacements of one length: another SMR at a set-up. Without repeated
    pointings displacements of random lengths explain any readings."""


ModelChange = (
    ReadingShiftChange | ReferenceOmission | RowCorrection | NoiseFactorChange | CoordinateExchange | CentringChange
)
"""Change of the model of a network by a hypothesis on an error."""


@dataclass(frozen=True)
class CauseHypothesis:
    """Hypothesis that one cause, at some stations or targets, explains a misfit of readings and model."""

    kind: CauseKind
    """Kind of the cause."""
    acts_on: str
    """Quantity that the cause changes: an observable, `position`, a kind of reference value, or `noise`."""
    stations: tuple[str, ...]
    """Names of the stations where the cause acts; empty for all."""
    targets: tuple[str, ...]
    """Names of the targets where the cause acts; empty for all."""
    log_prior: float
    """Logarithm of the prior odds of this hypothesis relative to no error."""
    model_change: ModelChange
    """Change of the model of the network by the cause."""
    reference_name_or_sentence: str = ""
    """Name of a wrong reference value, or sentence for the user on wrongly recorded pointings; else empty."""
    row_numbers: tuple[int, ...] = ()
    """Row numbers, from 1, of wrongly recorded pointings; empty for other kinds."""

    @property
    def place_key(self) -> tuple[object, ...]:
        """Key from the kind of cause and the stations, targets and rows where it acts.

        Hypotheses with equal keys differ only in their onset time and start values.
        """
        return self.kind, self.acts_on, self.stations, self.targets, self.row_numbers

    def competes_with(self, rival: CauseHypothesis) -> bool:
        """True if this hypothesis and `rival` may explain the same readings.

        This is possible if the hypotheses share a station or target, if one of them acts on the whole recording, or
        if both are wrong reference values: each value is tested by the others.
        """
        if all(isinstance(h.model_change, ReferenceOmission) for h in (self, rival)):
            return True
        places = [(*h.stations, *h.targets) for h in (self, rival)]
        return not all(places) or not set(places[0]).isdisjoint(places[1])


def includes_changed_noise(hypotheses: Iterable[CauseHypothesis]) -> bool:
    """True if any of `hypotheses` changes the noise, so that the noise is estimated from the residuals."""
    return any(isinstance(h.model_change, NoiseFactorChange) for h in hypotheses)
