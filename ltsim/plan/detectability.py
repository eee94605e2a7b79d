"""What a layout could see of every catalogued effect, and which effects it could not tell apart.

A test of q parameters at false-alarm rate 0.1 % finds an effect with probability 80 % when the squared length of what
the adjustment leaves of its whitened signature reaches the noncentrality of Baarda and Teunissen; the size that gives
this length is the minimal detectable one.

References
----------
Baarda, A testing procedure for use in geodetic networks (1968); Teunissen, Testing theory (2006), chapter 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy import optimize, stats

from ltsim.adjust.adjustment import Adjustment
from ltsim.adjust.residual_space import VISIBLE, ResidualSpace
from ltsim.arrays import Floats
from ltsim.effects.effect import Effect, NoiseEffect, Parameter

ALPHA, POWER = 0.001, 0.80
BATCH = 512
"""Rows projected at once."""
MOST_PLACES = 150
"""Places and shapes of one effect that are looked at."""
ALIKE = 0.9
"""Share of a signature that another effect explains, from which on the two are called alike."""


@lru_cache
def noncentrality(parameters: int, alpha: float = ALPHA, power: float = POWER) -> float:
    """Squared length of a signature that a chi-square test of `parameters` detects with `power` at level `alpha`."""
    limit = stats.chi2.isf(alpha, parameters)
    return float(optimize.brentq(lambda size: stats.ncx2.sf(limit, parameters, size) - power, 1e-3, 200.0 + 2 * limit))


@dataclass(frozen=True)
class Detectable:
    """How small one parameter of an effect may be and still be found.

    Attributes
    ----------
    effect, parameter : str
    unit : str
    best, typical, worst : float, [SI]
        Minimal detectable size at the best, median and worst of its places and shapes; infinite where it leaves no
        trace.
    prior_sigma : float, [SI]
        A plausible size.
    visible : float
        Median share of the signature that the adjustment leaves.
    worst_place : str
        Station, target or shape of the worst one.
    """

    effect: str
    parameter: str
    unit: str
    best: float
    typical: float
    worst: float
    prior_sigma: float
    visible: float
    worst_place: str


class ResidualRoom(ResidualSpace):
    """The residual space of a layout, with what it says about the noise."""

    @cached_property
    def _leftover(self) -> Floats:
        """(r, r): squared elements of the projector, for the rows of readings."""
        count = int(self.use.sum())
        leftover = np.empty((count, count))
        for low in range(0, count, BATCH):
            high = min(low + BATCH, count)
            units = np.zeros((self.size, high - low))
            units[np.arange(low, high), np.arange(high - low)] = 1.0
            leftover[:, low:high] = self.project(units)[:count] ** 2
        return leftover

    def noise_information(self, effect: NoiseEffect) -> Floats:
        """Information (q, q) on a noise effect's parameters: half the trace of P D_i P D_j.

        D is the change of the whitened variances per unit, by central differences over a tenth of the plausible size.
        """
        problem = self.adjustment.problem
        sizes = np.array([p.prior_sigma for p in effect.parameters])
        changes = []
        for i, size in enumerate(sizes):
            step = np.zeros(len(sizes))
            step[i] = 0.1 * size
            upper = effect.variance(self.adjustment.sightings, problem.sigma, step)
            changes.append(((upper - problem.sigma**2) / (problem.sigma**2 * step[i]))[problem.use])
        stack = np.array(changes)
        information: Floats = 0.5 * stack @ self._leftover @ stack.T
        return information


def thinned(places: Sequence[Effect]) -> list[Effect]:
    """At most `MOST_PLACES` of the places, evenly spread."""
    if len(places) <= MOST_PLACES:
        return list(places)
    return [places[i] for i in np.unique(np.linspace(0, len(places) - 1, MOST_PLACES).round().astype(int))]


@dataclass(frozen=True)
class Seen:
    """One effect in a layout: its places and what is left of each.

    Attributes
    ----------
    name : str
    parameters : tuple of tuple of Parameter
        Those of each place: an effect with several laws has several sets.
    places : tuple of str
    sizes : tuple of (q,) float, [SI]
        Minimal detectable sizes at each place; infinite where nothing is left.
    visible : tuple of float
    columns : tuple of (m, r) float
        Orthonormal, spanning what is left; empty for noise.
    """

    name: str
    parameters: tuple[tuple[Parameter, ...], ...]
    places: tuple[str, ...]
    sizes: tuple[Floats, ...]
    visible: tuple[float, ...]
    columns: tuple[Floats, ...]

    @property
    def found_anywhere(self) -> bool:
        """Some parameter leaves a trace at some place."""
        return any(bool(np.isfinite(size).any()) for size in self.sizes)

    def table(self) -> list[Detectable]:
        """One row a parameter."""
        return [row for law in dict.fromkeys(self.parameters) for row in self._law_table(law)]

    def _law_table(self, law: tuple[Parameter, ...]) -> list[Detectable]:
        at = [k for k, own in enumerate(self.parameters) if own == law]
        visible = float(np.median([self.visible[k] for k in at]))
        rows = []
        for j, p in enumerate(law):
            size = np.array([self.sizes[k][j] for k in at])
            typical = float(np.quantile(size, 0.5, method="higher"))
            worst = self.places[at[int(np.argmax(size))]]
            row = (self.name, p.name, p.unit, float(size.min()), typical, float(size.max()), p.prior_sigma)
            rows.append(Detectable(*row, visible, worst))
        return rows


def examine(room: ResidualRoom, places: Sequence[Effect]) -> Seen | None:
    """What is left of one effect at each of its places; None where the layout does not say what it needs."""
    kept: list[Effect] = []
    sizes, visible, columns = [], [], []
    for effect in thinned(places):
        if isinstance(effect, NoiseEffect):
            information, share, basis = room.noise_information(effect), 1.0, np.zeros((0, 0))
        else:
            whole = room.signature(effect)
            if not np.isfinite(whole).all() or not whole.any():
                continue
            information, share, basis = _left(room, whole)
        kept.append(effect)
        sizes.append(_smallest(information))
        visible.append(share)
        columns.append(basis)
    if not kept:
        return None
    names = tuple(_place(effect) for effect in kept)
    laws = tuple(effect.parameters for effect in kept)
    return Seen(kept[0].name, laws, names, tuple(sizes), tuple(visible), tuple(columns))


def _left(room: ResidualRoom, whole: Floats) -> tuple[Floats, float, Floats]:
    """Information (q, q), visible share and orthonormal columns of a signature (m, q)."""
    norm = np.linalg.norm(whole, axis=0)
    scaled = room.project(whole / np.where(norm > 0, norm, 1.0))
    basis, singular, _ = np.linalg.svd(scaled, full_matrices=False)
    share = float(np.mean(np.sum(scaled**2, axis=0)))
    information = (scaled.T @ scaled) * np.outer(norm, norm)
    hidden = np.sum(scaled**2, axis=0) < VISIBLE
    information[hidden] = information[:, hidden] = 0.0
    return information, share, basis[:, singular**2 > VISIBLE]


def _smallest(information: Floats) -> Floats:
    """Minimal detectable size (q,) of each parameter alone, by the test of all q; infinite without information."""
    own = np.diag(information)
    size = np.full(len(own), np.inf)
    size[own > 0] = np.sqrt(noncentrality(len(own)) / own[own > 0])
    return size


def _place(effect: Effect) -> str:
    """Where an instance acts and with which shape, for a person."""
    parts = [*effect.stations, *effect.targets]
    for shape in type(effect).shape:
        value = getattr(effect, shape.name, None)
        if isinstance(value, float):
            parts.append(f"{shape.name} {value:.3g}")
    return " ".join(parts)


def baseline_information(adjustment: Adjustment, effect_parameters: Sequence[str]) -> Floats:
    """Information (q, q) on instrument parameters from the readings alone, all others estimated with their priors."""
    problem = adjustment.problem
    at = [adjustment.construction.index(name) for name in effect_parameters]
    block = adjustment.instrument_covariance[np.ix_(at, at)]
    information = np.linalg.inv(block) - np.diag(1.0 / problem.prior_sigma[0][at] ** 2)
    return np.asarray(information, dtype=np.float64)


def examine_baseline(adjustment: Adjustment, effect: Effect) -> Seen:
    """Minimal detectable size of a term of the ordinary calibration, beside the other terms with their priors.

    It is estimated, not tested; this is the size its estimate must have to be told from zero.
    """
    information = baseline_information(adjustment, [p.name for p in effect.parameters])
    return Seen(effect.name, (effect.parameters,), ("",), (_smallest(information),), (1.0,), ())


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
    """Every catalogued effect in one layout.

    Attributes
    ----------
    effects : tuple of Seen
    silent : tuple of str
        Effects that leave no trace anywhere in this layout, or need what the layout does not state.
    alike : (e, e) float
        Row effect explained by column effect, 0 to 1, for those with a signature (`names`).
    """

    effects: tuple[Seen, ...]
    silent: tuple[str, ...]
    names: tuple[str, ...]
    alike: Floats

    def table(self) -> list[Detectable]:
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
    room = ResidualRoom.of(adjustment)
    estimated = set(adjustment.construction.names)
    found: list[Seen] = []
    silent: list[str] = []
    for entry in catalogue:
        kind = entry if isinstance(entry, type) else type(entry)
        if kind.parameters and {p.name for p in kind.parameters} <= estimated:
            found.append(examine_baseline(adjustment, kind()))
            continue
        seen = examine(room, kind.candidates(adjustment.sightings))
        if seen is None or not seen.found_anywhere:
            silent.append(kind.name)
        if seen is not None:
            found.append(seen)
    signed = [seen for seen in found if any(b.size for b in seen.columns)]
    alike = np.array([[likeness(a, b) for b in signed] for a in signed]).reshape(len(signed), -1)
    return Detectability(tuple(found), tuple(silent), tuple(s.name for s in signed), alike)
