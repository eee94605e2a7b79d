"""Hypotheses: observable, place, prior probability, and change of the network's model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ltsim.adjustment.reference_values import ReferenceValue
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.physics.effects.signature import Signature
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
    "orientation",
    "reflector-radius",
    "reference-value",
    "reference-scale",
    "names",
    "unit",
    "height",
    "noise-level",
    "centring",
]
"""Kind of a simple cause of disagreement between readings and model."""


@dataclass(frozen=True)
class ReadingShiftChange:
    """Shift of readings: a signature with estimated parameters, and the start values of their estimation."""

    effect: Signature
    start_values: tuple[float, ...] = ()


@dataclass(frozen=True)
class ReferenceOmission:
    """Rejection of a reference value."""

    reference_value: ReferenceValue


@dataclass(frozen=True)
class RowCorrection:
    """Correction of wrongly recorded rows: correct readings (k, 3), targets and faces (k,)."""

    rows: Ints
    readings: Floats
    target_indices: Ints
    faces: Ints


@dataclass(frozen=True)
class NoiseFactor:
    """Common factor on the declared standard deviations of some readings (n, 3).

    The estimation starts from a guess, because with the declared noise many readings would be outliers.
    """

    reading_mask: Bools
    start_factor: float = 1.0


@dataclass(frozen=True)
class CoordinateExchange:
    """Exchange of the reference coordinates of two targets."""

    target_names: tuple[str, str]


@dataclass(frozen=True)
class CentringChange:
    """Centring errors of some targets: a random displacement of the reflector at each of their occupations."""

    centring: CentringUncertainty


ModelChange = ReadingShiftChange | ReferenceOmission | RowCorrection | NoiseFactor | CoordinateExchange | CentringChange
"""Change of the network's model by a hypothesis."""


@dataclass(frozen=True)
class Hypothesis:
    """A simple cause of disagreement between readings and model.

    Attributes
    ----------
    kind : Kind
    acts_on : str
        Observable, `position`, `reference value` or `noise`.
    stations, targets : tuple of str
        Names of the stations and targets where the cause acts; empty for all.
    log_prior : float
        Log prior odds of this hypothesis at its place, relative to no cause.
    model_change
        Change of the model by the cause.
    name : str
        Further name of the place: of a reference value or a wrong entry.
    rows : tuple of int
        Rows, from 1, that it is about, where these are few.
    """

    kind: CauseKind
    """Kind of the cause."""
    acts_on: str
    """Observable or reference value that the cause changes."""
    stations: tuple[str, ...]
    """Names of the stations at which the cause acts; empty for all."""
    targets: tuple[str, ...]
    """Names of the targets at which the cause acts; empty for all."""
    log_prior: float
    """Logarithm of the prior odds."""
    model_change: ModelChange
    """Change of the model by the cause."""
    name: str = ""
    rows: tuple[int, ...] = ()
    """Row numbers of the affected pointings."""

    @property
    def place_key(self) -> tuple[object, ...]:
        """Key of the place; hypotheses with equal keys are equivalent and differ only in time and guess."""
        return self.kind, self.acts_on, self.stations, self.targets, self.rows

    def competes_with(self, rival: Hypothesis) -> bool:
        """True if both may explain the same readings: equal station or target, or one of them acts everywhere."""
        places = [(*h.stations, *h.targets) for h in (self, rival)]
        return not all(places) or not set(places[0]).isdisjoint(places[1])
