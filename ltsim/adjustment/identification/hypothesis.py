"""Hypotheses: what each acts on, where, how likely it is beforehand, and what it changes in the model of a network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ltsim.adjustment.reference_values import ReferenceValue
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.physics.effects.signature import Signature

Kind = Literal[
    "outlier",
    "constant-offset",
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
]


@dataclass(frozen=True)
class Shift:
    """A change of readings that is estimated: a signature with free parameters, and where their search begins."""

    effect: Signature
    guess: tuple[float, ...] = ()


@dataclass(frozen=True)
class Omission:
    """A reference value that is not believed."""

    value: ReferenceValue


@dataclass(frozen=True)
class Correction:
    """Rows that were written down wrongly: their readings (k, 3), targets and faces (k,) as they should be."""

    rows: Ints
    readings: Floats
    target: Ints
    face: Ints


@dataclass(frozen=True)
class NoiseFactor:
    """Standard deviations of some readings (n, 3) that differ from the declared ones by a common factor.

    The factor is estimated from a guess on: by the declared noise, readings that only scatter more are outliers.
    """

    readings: Bools
    guess: float = 1.0


@dataclass(frozen=True)
class Exchange:
    """Two targets whose reference coordinates were exchanged."""

    names: tuple[str, str]


Change = Shift | Omission | Correction | NoiseFactor | Exchange


@dataclass(frozen=True)
class Hypothesis:
    """A simple cause of disagreement between readings and model.

    Attributes
    ----------
    kind : Kind
    acts_on : str
        Observable, `position`, `reference value` or `noise`.
    stations, targets : tuple of str
        Where; empty for everywhere.
    log_prior : float
        Of this hypothesis, its place included, against nothing.
    change : Change
        What it changes in the model.
    name : str
        Further words of its place: of a reference value, a slip.
    rows : tuple of int
        Rows, from 1, that it is about, where these are few.
    """

    kind: Kind
    acts_on: str
    stations: tuple[str, ...]
    targets: tuple[str, ...]
    log_prior: float
    change: Change
    name: str = ""
    rows: tuple[int, ...] = ()

    @property
    def place(self) -> tuple[object, ...]:
        """Key by which hypotheses are distinct; they are equivalent if they differ only in moments and guesses."""
        return self.kind, self.acts_on, self.stations, self.targets, self.rows

    def competes(self, other: Hypothesis) -> bool:
        """True if both may explain the same readings: same station or target, or one of them acts everywhere."""
        places = [(*h.stations, *h.targets) for h in (self, other)]
        return not all(places) or not set(places[0]).isdisjoint(places[1])
