"""Reflectors chosen among candidate places, with the stations where they are.

Seen from given stations each reflector adds its own term to the information (targets are eliminated one by one), so
that an exchange of two places is a difference of two small matrices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.arrays import Bools, Floats, Ints
from ltsim.errors import SetupError
from ltsim.model.construction import Construction
from ltsim.planning.fast import Reduced, Reducer
from ltsim.planning.objective import LEAST_IMPROVEMENT, Objective
from ltsim.planning.site import Site
from ltsim.planning.survey import Survey
from ltsim.scene.visibility import aimed_normals

SWEEPS = 8
"""Rounds of exchanges at most."""
TAKEN = 1e-3
"""[m] within which a place is a reflector's own."""


@dataclass(frozen=True)
class PlaceTable:
    """Terms of the normal matrix of poses, gauge and parameters, for given stations."""

    reducer: Reducer
    base: Floats
    """(K, K): targets that stay, known lengths, priors, datum."""
    terms: Floats
    """(P, K, K): what a reflector at each place would add."""
    length: Floats
    """(K,): squared lengths of the columns before targets are eliminated, with reflectors at all places."""
    inverse: Floats
    """(E, 3, 3): of every target but the gauge's, those that stay first, then the places (`Reducer.eliminated`)."""
    weights: Floats
    """(E, 3, K): of the same targets."""

    @classmethod
    def of(cls, survey: Survey, stays: Bools, places: Floats, seen: Bools, reducer: Reducer) -> PlaceTable:
        """Terms of `places`; `reducer` has the staying targets first, then the places; `seen` (S, targets)."""
        count, kept = len(survey.position), int(stays.sum())
        slots = np.arange(count)
        only = seen.copy()
        only[:, kept:] = False
        alone = reducer.blocks(survey.position, survey.yaw, slots, only)
        base, length = (block[0] for block in reducer.eliminated(alone, slots[None])[:2])
        t, x = (part[:, kept:] for part in reducer.rows(survey.position, survey.yaw, slots, seen))
        rows: Floats = np.zeros((len(places), count, t.shape[2], len(base)))
        for s in range(count):
            rows[:, s, :, 6 * s : 6 * s + 6] = x[s, ..., :6]
            rows[:, s, :, len(base) - x.shape[3] + 6 :] = x[s, ..., 6:]
        rows = rows.reshape(len(places), -1, len(base))
        basis = np.linalg.qr(np.swapaxes(t, 0, 1).reshape(len(places), -1, 3))[0]
        left = rows - basis @ (np.swapaxes(basis, 1, 2) @ rows)
        whole = reducer.blocks(survey.position, survey.yaw, slots, seen)
        _, _, inverse, weights = reducer.eliminated(whole, slots[None])
        length = length + np.sum(rows**2, axis=(0, 1))
        return cls(reducer, base, np.swapaxes(left, 1, 2) @ left, length, inverse[0], weights[0])

    def total(self, chosen: Ints) -> Floats:
        """Normal matrix (K, K) with reflectors at the chosen places."""
        return self.base + self.terms[chosen].sum(axis=0)

    def information(self, totals: Floats) -> Floats:
        """Information (B, P, P) of the parameters; NaN where a direction is open."""
        return self.reducer.marginal(totals, np.broadcast_to(self.length, totals.shape[:2]))

    def target_rms(self, totals: Floats, asked: Ints) -> Floats:
        """Point error (B,) [m] of the targets that stay and of reflectors at the places `asked` (n,) or (B, n)."""
        at = self._at(len(totals), asked)
        return self.reducer.target_rms(totals, self.inverse[at], self.weights[at], self.reducer.mesh[at])

    def target_sigma(self, total: Floats, asked: Ints) -> dict[str, float]:
        """Point error [m] of each of them by name, of one normal matrix (K, K)."""
        at, reducer = self._at(1, asked), self.reducer
        variance = reducer.target_variance(total[None], self.inverse[at], self.weights[at], reducer.mesh[at])[0]
        names = [reducer.survey.target_names[t] for t in reducer.asked(reducer.mesh[at])[0]]
        return dict(zip(names, np.sqrt(variance).tolist(), strict=True))

    def _at(self, layouts: int, asked: Ints) -> Ints:
        """(B, staying + n): rows of `inverse` of the targets that stay and of those at the places `asked`."""
        stay = len(self.inverse) - len(self.terms)
        asked = np.broadcast_to(asked, (layouts, np.shape(asked)[-1]))
        return np.concatenate([np.broadcast_to(np.arange(stay), (layouts, stay)), stay + asked], axis=1)

    def values(self, totals: Floats, chosen: Ints, objective: Objective) -> Floats:
        """Objective (B,) of normal matrices (B, K, K) with reflectors at the places `chosen` (B, n)."""
        information = self.information(totals)
        rms, known = np.full(len(totals), np.nan), np.isfinite(information).all(axis=(1, 2))
        if objective.wants_targets:
            rms[known] = self.target_rms(totals[known], chosen[known])
        return objective.values(Reduced(information, rms), self.reducer.construction.size)


def with_targets(survey: Survey, stays: Bools, places: Floats, names: tuple[str, ...], seen: Bools) -> Survey:
    """The survey with the staying targets and reflectors at `places`."""
    keep = np.flatnonzero(stays)
    count = len(keep) + len(places)
    rank = None if survey.rank is None else np.tile(np.arange(count), (len(survey.position), 1))
    return survey.replace(
        target_names=(*(survey.target_names[k] for k in keep), *names),
        points=np.concatenate([survey.points[keep], places]),
        seen=seen,
        rank=rank,
    )


@dataclass(frozen=True)
class Movable:
    """The places among which movable reflectors are chosen: their own first, then the site's."""

    places: Floats
    """(P, 3) [m]."""
    names: tuple[str, ...]
    own: int
    """How many of them are reflectors' own."""
    seen: Bools
    """(S, k + P): of the k targets that stay, then the places."""
    table: PlaceTable

    @classmethod
    def of(cls, site: Site, survey: Survey, stays: Bools, objective: Objective, construction: Construction) -> Movable:
        """The places that are in sight; `stays` (T,) are targets that are no matter of choice."""
        offered = np.zeros((0, 3)) if site.nests is None else site.nests
        places = np.concatenate([survey.points[~stays], offered])
        own = [name for name, stay in zip(survey.target_names, stays, strict=True) if not stay]
        good = _usable(site, survey, places)
        good &= ~np.r_[np.zeros(len(own), bool), _taken(survey.points[~stays], offered, TAKEN)]
        good &= ~np.r_[np.zeros(len(own), bool), _taken(survey.points[stays], offered, site.reflector_spacing)]
        names = tuple(n for n, g in zip((*own, *site.nest_names), good, strict=True) if g)
        places = places[good]
        seen = site.seen(survey.position, np.concatenate([survey.points[stays], places]))
        # What stands already is seen as it is, only new places must be seen with some play.
        now = np.concatenate([survey.seen[:, stays], survey.seen[:, ~stays][:, good[: len(own)]]], axis=1)
        seen[:, : now.shape[1]] = now
        wide = with_targets(survey, stays, places, names, np.ones_like(seen))
        table = PlaceTable.of(survey, stays, places, seen, Reducer(wide, construction, objective.effects))
        return cls(places, names, int(good[: len(own)].sum()), seen, table)


def choose_reflectors(
    site: Site, survey: Survey, stays: Bools, objective: Objective, construction: Construction
) -> Survey:
    """The survey with its movable reflectors (not `stays` (T,)) at the best of the site's places and their own.

    Raises SetupError where too few places are in sight.
    """
    if site.nests is None:
        return survey
    choice, wanted = Movable.of(site, survey, stays, objective, construction), int((~stays).sum())
    places = choice.places
    if len(places) < wanted:
        raise SetupError(
            f"only {len(places)} places for reflectors are in sight of the stations, {wanted} are wanted; "
            "add places or ask for fewer"
        )
    start = _start(places, np.arange(len(places)) < choice.own, wanted, site.reflector_spacing)
    chosen = _exchange(choice.table, objective, places, start, site.reflector_spacing)
    kept = np.r_[0 : stays.sum(), stays.sum() + chosen]
    return with_targets(survey, stays, places[chosen], tuple(choice.names[i] for i in chosen), choice.seen[:, kept])


def _usable(site: Site, survey: Survey, places: Floats) -> Bools:
    """(P,): seen from enough stations; a fixed nest there can be aimed at all of them."""
    good: Bools = site.seen(survey.position, places).sum(axis=0) >= min(site.least, len(survey.position))
    if site.aimed.any():
        good &= aimed_normals(survey.position, places)[1] <= site.limits.acceptance
    return good


def _taken(points: Floats, places: Floats, within: float) -> Bools:
    """(P,): places within a distance [m] of a point."""
    gap = np.linalg.norm(places[:, None] - points[None], axis=2)
    return np.asarray((gap < within).any(axis=1))


def _start(places: Floats, own: Bools, wanted: int, spacing: float) -> Ints:
    """Indices (wanted,): the reflectors' present places, filled up by those far from all others."""
    chosen: list[int] = np.flatnonzero(own).tolist()
    while len(chosen) < wanted:
        gap = np.linalg.norm(places[:, None] - places[chosen][None], axis=2).min(axis=1, initial=np.inf)
        best = int(np.argmax(gap))
        if gap[best] < spacing:
            raise SetupError(f"fewer than {wanted} places for reflectors lie {spacing:g} m apart; add places")
        chosen.append(best)
    return np.array(chosen, dtype=np.int64)


def _exchange(table: PlaceTable, objective: Objective, places: Floats, chosen: Ints, spacing: float) -> Ints:
    """Exchange one reflector at a time for the best free place until no exchange helps (Fedorov)."""
    chosen = chosen.copy()
    total = table.total(chosen)
    value = float(table.values(total[None], chosen[None], objective)[0])
    gap = np.linalg.norm(places[:, None] - places[None], axis=2)
    for _ in range(SWEEPS):
        before = value
        for i in range(len(chosen)):
            others = np.delete(chosen, i)
            free = np.setdiff1d(np.flatnonzero((gap[:, others] >= spacing).all(axis=1)), chosen)
            if not len(free):
                continue
            without = total - table.terms[chosen[i]]
            tried = np.insert(np.tile(others, (len(free), 1)), i, free, axis=1)
            values = table.values(without + table.terms[free], tried, objective)
            best = int(np.argmin(values))
            if values[best] < value:
                chosen[i], value = free[best], float(values[best])
                total = without + table.terms[chosen[i]]
        if value > before * (1 - LEAST_IMPROVEMENT):
            break
    return chosen
