"""Minimal detectable size of every effect in a network.

A test finds what leaves enough: the squared length of what the adjustment leaves of a whitened signature must reach the
noncentrality that the test needs (`reliability.noncentrality`). A diagnosis does not test one effect, it looks for
every effect of the catalogue at all of its places and with all of its shapes, and a single one has to stand out among
as many. Its false-alarm rate is shared out: the families of effects have even odds, and so have the members of a
family.

References
----------
Baarda, A testing procedure for use in geodetic networks (1968); Teunissen, Testing theory (2006), chapter 4; Gross and
Vitells, Trial factors for the look elsewhere effect, Eur. Phys. J. C 70 (2010) 525.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TypeVar

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.reliability import noncentrality
from ltsim.adjustment.residual_space import VISIBLE, ResidualSpace, orthonormal
from ltsim.core.arrays import Floats
from ltsim.physics.effects import BASELINE, CATALOGUE
from ltsim.physics.effects.effect import Effect, NoiseEffect, Parameter

P = TypeVar("P")
ALIKE = 0.9
"""Share of a signature that another effect explains, from which on the two are called alike."""
LEVEL = 0.05
"""False-alarm rate of a whole search."""
BATCH = 512
"""Rows projected at once."""
MOST_PLACES = 150
"""Places and shapes of one effect that are looked at."""


@cache
def search_noncentrality(dof: int, places: int) -> float:
    """Noncentrality that an effect of `dof` parameters, sought at so many `places`, needs to be found by a search.

    It shares the false-alarm rate with all its places and shapes, and with all effects of the catalogue; what is not
    in the catalogue counts as one effect more.
    """
    return noncentrality(dof, level=LEVEL, hypotheses=places * (len(CATALOGUE) - len(BASELINE) + 1))


@dataclass(frozen=True)
class MinimalSize:
    """Minimal detectable size of one parameter of an effect: the size that is detected in 80 % of recordings."""

    effect: str
    parameter: str
    unit: str
    best: float
    typical: float
    worst: float
    """[SI]: at the best, median and worst of its places and shapes; infinite where it leaves no trace."""
    prior_sigma: float
    """[SI]: a plausible size."""
    visible: float
    """Median share of the signature that the adjustment leaves."""
    worst_place: str
    """Station, target or shape of the worst one."""


def thinned(places: Sequence[P]) -> list[P]:
    """At most `MOST_PLACES` of the places, evenly spread."""
    if len(places) <= MOST_PLACES:
        return list(places)
    return [places[i] for i in np.unique(np.linspace(0, len(places) - 1, MOST_PLACES).round().astype(int))]


@dataclass(frozen=True)
class Seen:
    """One effect in a layout: its places and what is left of each."""

    name: str
    parameters: tuple[tuple[Parameter, ...], ...]
    """Parameters of the effect at each place: an effect with several laws has several sets."""
    places: tuple[str, ...]
    sizes: tuple[Floats, ...]
    """(q,) [SI]: minimal detectable sizes at each place; infinite where nothing is left."""
    visible: tuple[float, ...]
    columns: tuple[Floats, ...]
    """(m, r): orthonormal, spanning what is left; empty for noise, and where a diagnosis keeps none."""

    def table(self) -> list[MinimalSize]:
        """One row a parameter."""
        rows = []
        for law in dict.fromkeys(self.parameters):
            at = [k for k, own in enumerate(self.parameters) if own == law]
            visible = float(np.median([self.visible[k] for k in at]))
            for j, p in enumerate(law):
                size = np.array([self.sizes[k][j] for k in at])
                typical = float(np.quantile(size, 0.5, method="higher"))
                worst = self.places[at[int(np.argmax(size))]]
                row = (self.name, p.name, p.unit, float(size.min()), typical, float(size.max()), p.prior_sigma)
                rows.append(MinimalSize(*row, visible, worst))
        return rows


def _noise_information(space: ResidualSpace, places: Sequence[NoiseEffect]) -> list[Floats]:
    """Information (q, q) on the parameters of each noise effect: half the trace of P D_i P D_j.

    P projects off the adjustment; D is the change of the whitened variances per unit, by central differences over a
    tenth of the plausible size.
    """
    problem, changes = space.adjustment.problem, []
    for effect in places:
        steps = np.diag([0.1 * p.prior_sigma for p in effect.parameters])
        for step in steps:
            upper = effect.variance(space.sightings, problem.sigma, step)
            changes.append(((upper - problem.sigma**2) / (problem.sigma**2 * step.sum()))[problem.use])
    stack = np.array(changes)
    count = stack.shape[1]
    spread = np.empty_like(stack)
    for low in range(0, count, BATCH):
        units = np.eye(space.size, min(BATCH, count - low), -low)
        spread[:, low : low + BATCH] = stack @ space.project(units)[:count] ** 2
    edges = np.cumsum([0, *(len(effect.parameters) for effect in places)])
    return [0.5 * stack[a:b] @ spread[a:b].T for a, b in pairwise(edges)]


def examine(space: ResidualSpace, places: Sequence[Effect]) -> Seen | None:
    """Residual signatures of one effect at all places that a search would try; None where the network lacks its needs.

    At most `MOST_PLACES` of the places are examined.
    """
    some = thinned(places)
    noises = [effect for effect in some if isinstance(effect, NoiseEffect)]
    found: list[tuple[Effect, Floats, float, int, Floats]] = []
    told = _noise_information(space, noises) if noises else []
    found += [(effect, own, 1.0, len(own), np.zeros((0, 0))) for effect, own in zip(noises, told, strict=True)]
    for effect in () if noises else some:
        whole = space.signature(effect)
        if np.isfinite(whole).all() and whole.any():
            norm = np.linalg.norm(whole, axis=0)
            scaled = space.project(whole / np.where(norm > 0, norm, 1.0))
            basis = orthonormal(scaled, np.ones(len(norm)))
            found.append((effect, *information_left(scaled.T @ scaled, norm, VISIBLE), basis))
    return seen_from(found, len(places)) if found else None


def seen_from(found: Sequence[tuple[Effect, Floats, float, int, Floats]], sought: int) -> Seen:
    """Residual signatures of one effect by place: information (q, q), visible share, rank, columns (m, r) of each.

    `sought` is the number of places that a search tries.
    """
    kept, information, visible, spent, left = zip(*found, strict=True)
    needed = [search_noncentrality(max(dof, 1), sought) for dof in spent]
    sizes = tuple(map(_smallest, information, needed))
    names, laws = tuple(map(_place, kept)), tuple(effect.parameters for effect in kept)
    return Seen(kept[0].name, laws, names, sizes, visible, left)


def information_left(gram: Floats, norm: Floats, visible: float) -> tuple[Floats, float, int]:
    """Information (q, q), visible share and rank from the Gram matrix of what is left of unit columns.

    `norm` (q,) are the lengths of the columns, `visible` the share of a squared length that is rounding.
    """
    share = np.diag(gram)
    information = gram * np.outer(norm, norm)
    hidden = share < visible
    information[hidden] = information[:, hidden] = 0.0
    return information, float(np.mean(share)), int(np.sum(np.linalg.eigvalsh(gram) > visible))


def _smallest(information: Floats, needed: float) -> Floats:
    """Minimal detectable size (q,) of each parameter alone; infinite without information."""
    own = np.diag(information)
    size = np.full(len(own), np.inf)
    size[own > 0] = np.sqrt(needed / own[own > 0])
    return size


def _place(effect: Effect) -> str:
    """Description for the user of the place and shape of an instance."""
    parts = [*effect.stations, *effect.targets]
    for shape in type(effect).shape:
        value = getattr(effect, shape.name, None)
        if isinstance(value, float):
            parts.append(f"{shape.name} {value:.3g}")
    return " ".join(parts)


def examine_baseline(adjustment: Adjustment, effect: Effect) -> Seen:
    """Minimal detectable size of a term of the ordinary calibration, beside the other terms with their priors.

    It is estimated from the readings, not tested; this is the size its estimate must have to be told from zero.
    """
    at = [adjustment.construction.index(p.name) for p in effect.parameters]
    block, prior = adjustment.instrument_covariance[np.ix_(at, at)], adjustment.problem.prior.sigma[0][at]
    information: Floats = np.asarray(np.linalg.inv(block) - np.diag(1.0 / prior**2), dtype=np.float64)
    sizes = _smallest(information, noncentrality(len(information)))
    return Seen(effect.name, (effect.parameters,), ("",), (sizes,), (1.0,), ())


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

    def confusable(self) -> list[tuple[str, str, float]]:
        """Pairs (effect, what it would be taken for, share explained), the most alike first."""
        first, second = np.nonzero((self.alike > ALIKE) & ~np.eye(len(self.names), dtype=bool))
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
        if seen is None or not any(np.isfinite(size).any() for size in seen.sizes):
            silent.append(kind.name)
        if seen is not None:
            found.append(seen)
    signed = [seen for seen in found if any(b.size for b in seen.columns)]
    alike = np.array([[likeness(a, b) for b in signed] for a in signed]).reshape(len(signed), -1)
    return Detectability(tuple(found), tuple(silent), tuple(s.name for s in signed), alike)
