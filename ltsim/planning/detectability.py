"""What a layout could see of every catalogued effect, and which effects it could not tell apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.arrays import Floats
from ltsim.effects.effect import Effect
from ltsim.remedies.detectability import MinimalSize, Seen, examine, examine_baseline

ALIKE = 0.9
"""Share of a signature that another effect explains, from which on the two are called alike."""


def likeness(first: Seen, second: Seen) -> float:
    """Share of the first effect's visible signature that the second explains: median over the first's places.

    The second may take any of its places and shapes, as it may in a diagnosis.
    """
    if not any(b.shape[1] for b in second.columns):
        return 0.0
    rivals = np.hstack([b for b in second.columns if b.shape[1]])
    starts = np.cumsum([0, *(b.shape[1] for b in second.columns if b.shape[1])])[:-1]
    shares = []
    for own in first.columns:
        if own.shape[1]:
            overlap = (rivals.T @ own) ** 2
            shares.append(float(np.add.reduceat(overlap.sum(axis=1), starts).max()) / own.shape[1])
    return float(np.median(shares)) if shares else 0.0


@dataclass(frozen=True)
class Detectability:
    """Every catalogued effect in one layout."""

    effects: tuple[Seen, ...]
    silent: tuple[str, ...]
    """Effects that leave no trace anywhere in this layout, or need what the layout does not state."""
    names: tuple[str, ...]
    alike: Floats
    """(e, e): row effect explained by column effect, 0 to 1, for those with a signature (`names`)."""

    def table(self) -> list[MinimalSize]:
        """One row a parameter of every effect."""
        return [row for seen in self.effects for row in seen.table()]

    def confusable(self, share: float = ALIKE) -> list[tuple[str, str, float]]:
        """Pairs (effect, what it would be taken for, share explained), the most alike first."""
        first, second = np.nonzero((self.alike > share) & ~np.eye(len(self.names), dtype=bool))
        pairs = [(self.names[i], self.names[j], float(self.alike[i, j])) for i, j in zip(first, second, strict=True)]
        return sorted(pairs, key=lambda pair: -pair[2])


def detectability(adjustment: Adjustment, catalogue: Sequence[type[Effect] | Effect]) -> Detectability:
    """Examine every effect of a catalogue in a layout (at its nominal adjustment).

    Terms that the construction estimates count as such; all others are signatures on top of it.
    """
    space = ResidualSpace.of(adjustment)
    estimated = set(adjustment.construction.names)
    found: list[Seen] = []
    silent: list[str] = []
    for entry in catalogue:
        kind = entry if isinstance(entry, type) else type(entry)
        if kind.parameters and {p.name for p in kind.parameters} <= estimated:
            found.append(examine_baseline(adjustment, kind()))
            continue
        seen = examine(space, kind.candidates(adjustment.sightings))
        if seen is None or not seen.found_anywhere:
            silent.append(kind.name)
        if seen is not None:
            found.append(seen)
    signed = [seen for seen in found if any(b.size for b in seen.columns)]
    alike = np.array([[likeness(a, b) for b in signed] for a in signed]).reshape(len(signed), -1)
    return Detectability(tuple(found), tuple(silent), tuple(s.name for s in signed), alike)
