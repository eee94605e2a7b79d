"""Reflectors at candidate places: selection of all, or evaluation of every change of a single one.

For given stations each reflector adds a separate term to the information (targets are eliminated one by one), so that
an exchange of two places is the difference of two small matrices.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import SetupError
from ltsim.core.units import MICROMETRE
from ltsim.physics.model.construction import Construction
from ltsim.planning.fast import LayoutScorer, Reduced
from ltsim.planning.objective import MIN_IMPROVEMENT, TARGETS, Objective
from ltsim.planning.plan_change import PlanChange, in_millimetres
from ltsim.planning.site import SearchSpace
from ltsim.planning.survey import Survey
from ltsim.scene.visibility import aimed_normals

SWEEPS = 8
"""Largest number of rounds of exchanges."""
SAME_PLACE_M = 1e-3
"""Distance [m] within which a candidate place equals the present place of a reflector."""


@dataclass(frozen=True)
class PlaceTable:
    """Terms of the normal matrix of poses, gauge and parameters for reflectors at candidate places."""

    reducer: LayoutScorer
    base: Floats
    """Normal matrix of fixed targets, reference lengths, priors and datum, (K, K)."""
    terms: Floats
    """Normal matrix of a reflector at each place, (P, K, K)."""
    length: Floats
    """Squared norms of the columns before elimination of targets, with reflectors at all places, (K,)."""
    inverse: Floats
    """Inverse blocks (E, 3, 3) of all targets except the gauge's, fixed ones first, then the places
    (`LayoutScorer.eliminated`).
    """
    weights: Floats
    """Products (E, 3, K) of these inverse blocks and the coupling blocks."""

    @classmethod
    def of(cls, survey: Survey, stays: Bools, places: Floats, visible: Bools, reducer: LayoutScorer) -> PlaceTable:
        """Terms of `places`; `reducer` has the fixed targets first, then the places; `visible` is (S, targets)."""
        count, staying = len(survey.position), int(stays.sum())
        slots = np.arange(count)
        only = visible.copy()
        only[:, staying:] = False
        alone = reducer.blocks(survey.position, survey.yaw, slots, only)
        base, length = (block[0] for block in reducer.eliminated(alone, slots[None])[:2])
        t, x = (part[:, staying:] for part in reducer.rows(survey.position, survey.yaw, slots, visible))
        rows: Floats = np.zeros((len(places), count, t.shape[2], len(base)))
        for s in range(count):
            rows[:, s, :, 6 * s : 6 * s + 6] = x[s, ..., :6]
            rows[:, s, :, len(base) - x.shape[3] + 6 :] = x[s, ..., 6:]
        rows = rows.reshape(len(places), -1, len(base))
        basis = np.linalg.qr(np.swapaxes(t, 0, 1).reshape(len(places), -1, 3))[0]
        projected = rows - basis @ (np.swapaxes(basis, 1, 2) @ rows)
        whole = reducer.blocks(survey.position, survey.yaw, slots, visible)
        _, _, inverse, weights = reducer.eliminated(whole, slots[None])
        length = length + np.sum(rows**2, axis=(0, 1))
        return cls(reducer, base, np.swapaxes(projected, 1, 2) @ projected, length, inverse[0], weights[0])

    def total(self, chosen: Ints) -> Floats:
        """Normal matrix (K, K) with reflectors at the chosen places."""
        return self.base + self.terms[chosen].sum(axis=0)

    def information(self, totals: Floats) -> Floats:
        """Information (B, P, P) on the parameters; NaN for undetermined unknowns."""
        return self.reducer.marginal(totals, np.broadcast_to(self.length, totals.shape[:2]))

    def target_rms(self, totals: Floats, asked: Ints) -> Floats:
        """Root mean square point error (B,) [m] of fixed targets and of reflectors at the places `asked`.

        These are (n,) or (B, n).
        """
        at = self._at(len(totals), asked)
        return self.reducer.target_rms(totals, self.inverse[at], self.weights[at], self.reducer.mesh[at])

    def target_sigma(self, total: Floats, asked: Ints) -> dict[str, float]:
        """Point error [m] of these targets by name, for one normal matrix (K, K)."""
        at, reducer = self._at(1, asked), self.reducer
        variance = reducer.target_variance(total[None], self.inverse[at], self.weights[at], reducer.mesh[at])[0]
        names = [reducer.survey.target_names[t] for t in reducer.asked(reducer.mesh[at])[0]]
        return dict(zip(names, np.sqrt(variance).tolist(), strict=True))

    def _at(self, layouts: int, asked: Ints) -> Ints:
        """Rows of `inverse` for the fixed targets and the places `asked`, (B, fixed + n)."""
        stay = len(self.inverse) - len(self.terms)
        asked = np.broadcast_to(asked, (layouts, np.shape(asked)[-1]))
        return np.concatenate([np.broadcast_to(np.arange(stay), (layouts, stay)), stay + asked], axis=1)

    def values(self, totals: Floats, chosen: Ints, objective: Objective) -> Floats:
        """Objective (B,) for normal matrices (B, K, K) with reflectors at the places `chosen` (B, n)."""
        information = self.information(totals)
        rms, determined = np.full(len(totals), np.nan), np.isfinite(information).all(axis=(1, 2))
        if objective.wants_targets:
            rms[determined] = self.target_rms(totals[determined], chosen[determined])
        return objective.values(Reduced(information, rms), self.reducer.construction.n_parameters)


def with_targets(survey: Survey, stays: Bools, places: Floats, names: tuple[str, ...], visible: Bools) -> Survey:
    """Survey with the fixed targets and with reflectors at `places`."""
    keep = np.flatnonzero(stays)
    count = len(keep) + len(places)
    rank = None if survey.rank is None else np.tile(np.arange(count), (len(survey.position), 1))
    return survey.replace(
        target_names=(*(survey.target_names[k] for k in keep), *names),
        points=np.concatenate([survey.points[keep], places]),
        visible=visible,
        rank=rank,
    )


@dataclass(frozen=True)
class Movable:
    """Places for movable reflectors: their present ones first, then those of the search space."""

    places: Floats
    """Coordinates of the places, (P, 3) [m]."""
    names: tuple[str, ...]
    n_present: int
    """Number of places that are present places of reflectors."""
    visible: Bools
    """Visibility flags of the k fixed targets and of the places, (S, k + P)."""
    table: PlaceTable

    @classmethod
    def of(
        cls, site: SearchSpace, survey: Survey, stays: Bools, objective: Objective, construction: Construction
    ) -> Movable:
        """Visible places for movable reflectors; `stays` (T,) marks the fixed targets."""
        offered = np.zeros((0, 3)) if site.nests is None else site.nests
        places = np.concatenate([survey.points[~stays], offered])
        present = [name for name, stay in zip(survey.target_names, stays, strict=True) if not stay]
        good = _usable(site, survey, places)
        good &= ~np.r_[np.zeros(len(present), bool), _near_points(survey.points[~stays], offered, SAME_PLACE_M)]
        good &= ~np.r_[
            np.zeros(len(present), bool), _near_points(survey.points[stays], offered, site.reflector_spacing)
        ]
        names = tuple(n for n, g in zip((*present, *site.nest_names), good, strict=True) if g)
        places = places[good]
        visible = site.visible(survey.position, np.concatenate([survey.points[stays], places]))
        # What stands already is seen as it is, only new places must be seen with some play.
        now = np.concatenate([survey.visible[:, stays], survey.visible[:, ~stays][:, good[: len(present)]]], axis=1)
        visible[:, : now.shape[1]] = now
        wide = with_targets(survey, stays, places, names, np.ones_like(visible))
        table = PlaceTable.of(survey, stays, places, visible, LayoutScorer(wide, construction, objective.effects))
        return cls(places, names, int(good[: len(present)].sum()), visible, table)


def choose_reflectors(
    site: SearchSpace, survey: Survey, stays: Bools, objective: Objective, construction: Construction
) -> Survey:
    """Survey with its movable reflectors (not `stays` (T,)) at the best of their present and candidate places.

    Raises SetupError if too few places are visible.
    """
    if site.nests is None:
        return survey
    choice, wanted = Movable.of(site, survey, stays, objective, construction), int((~stays).sum())
    places = choice.places
    if len(places) < wanted:
        raise SetupError(
            f"only {len(places)} places for reflectors are visible from the stations, expected {wanted}; "
            "add places or ask for fewer"
        )
    start = _start(places, np.arange(len(places)) < choice.n_present, wanted, site.reflector_spacing)
    chosen = _exchange(choice.table, objective, places, start, site.reflector_spacing)
    columns = np.r_[0 : stays.sum(), stays.sum() + chosen]
    return with_targets(
        survey, stays, places[chosen], tuple(choice.names[i] for i in chosen), choice.visible[:, columns]
    )


def _usable(site: SearchSpace, survey: Survey, places: Floats) -> Bools:
    """Flags (P,) of the places that enough stations see, and at which a fixed nest can be aimed at all of them."""
    good: Bools = site.visible(survey.position, places).sum(axis=0) >= min(site.min_sights, len(survey.position))
    if site.aimed.any():
        good &= aimed_normals(survey.position, places)[1] <= site.limits.acceptance
    return good


def _near_points(points: Floats, places: Floats, within: float) -> Bools:
    """Flags (P,) of the places within a distance [m] of a point."""
    gap = np.linalg.norm(places[:, None] - points[None], axis=2)
    return np.asarray((gap < within).any(axis=1))


def _start(places: Floats, present: Bools, wanted: int, spacing: float) -> Ints:
    """Indices (wanted,) of initial places: the present ones, then those far from all others."""
    chosen: list[int] = np.flatnonzero(present).tolist()
    while len(chosen) < wanted:
        gap = np.linalg.norm(places[:, None] - places[chosen][None], axis=2).min(axis=1, initial=np.inf)
        best = int(np.argmax(gap))
        if gap[best] < spacing:
            raise SetupError(f"fewer than {wanted} places for reflectors lie {spacing:g} m apart; add places")
        chosen.append(best)
    return np.array(chosen, dtype=np.int64)


def _exchange(table: PlaceTable, objective: Objective, places: Floats, chosen: Ints, spacing: float) -> Ints:
    """Indices of places after exchanges of single reflectors until none improves the objective (Fedorov)."""
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
        if value > before * (1 - MIN_IMPROVEMENT):
            break
    return chosen


MIN_GAIN = 0.002
"""Smallest relative improvement of the quality at which a change is reported."""
UNCHANGED_QUALITY = 5e-4
"""Relative change of the quality up to which it counts as unchanged."""
MAX_REPORTED = 3
"""Largest number of reported changes of each kind."""

ChangeKind = Literal["move", "add", "remove"]
CHANGE_KINDS: tuple[ChangeKind, ...] = get_args(ChangeKind)
RankedChange = tuple[float, int | None, int | None, Floats]
"""Factor on the quality, removed reflector, occupied place, and the resulting normal matrix."""


@dataclass(frozen=True)
class Changes:
    """Results of all changes of single reflectors."""

    reported: tuple[PlanChange, ...]
    """Reported changes: useful moves and additions, the best first, then removals with the smallest loss."""
    tried: dict[ChangeKind, int]
    """Number of evaluated changes, by kind."""
    helped: dict[ChangeKind, int]
    """Number of changes that improve the quality by more than `MIN_GAIN`, by kind."""

    @property
    def summary(self) -> str:
        """Sentence on the numbers of evaluated and useful changes."""
        if not self.tried["move"] + self.tried["add"]:
            return (
                "No other place for a reflector was tested: give candidates as reflectors.on, reflectors.places or "
                "reflectors.surfaces, and say which points of a list may go elsewhere as reflectors.movable."
            )
        return (
            f"Tested one at a time: {self.tried['move']} moves of a reflector ({self.helped['move']} help), "
            f"{self.tried['add']} further places ({self.helped['add']} help); the others gain less than "
            f"{100 * MIN_GAIN:.1f} %."
        )


def reflector_changes(
    site: SearchSpace, survey: Survey, stays: Bools, objective: Objective, construction: Construction
) -> Changes:
    """Results of every move, addition and removal of one reflector except the fixed ones (`stays` (T,))."""
    if stays.all() and site.nests is None:
        return Changes((), dict.fromkeys(CHANGE_KINDS, 0), dict.fromkeys(CHANGE_KINDS, 0))
    return _ReflectorTrials(
        Movable.of(site, survey, stays, objective, construction), objective, site.reflector_spacing
    ).changes()


class _ReflectorTrials:
    """Evaluation of changes of a layout, with the reflectors at their present places."""

    def __init__(self, choice: Movable, objective: Objective, spacing: float) -> None:
        self.choice, self.table, self.objective = choice, choice.table, objective
        self.chosen = np.arange(choice.n_present)
        self.total = self.table.total(self.chosen)
        self.now = self.table.values(self.total[None], self.chosen[None], objective)[0]
        self.sigma = self._sigma(self.total)
        gap = np.linalg.norm(choice.places[:, None] - choice.places[None], axis=2)
        self.near = gap < spacing

    @property
    def _of_targets(self) -> bool:
        """True if the goal is the error of targets alone."""
        return not any(weight > 0 for name, weight in self.objective.weights.items() if name != TARGETS)

    def _worth(self, totals: Floats, sets: Ints, common: Ints) -> Floats:
        """Factor (B,) on the objective; for a goal of targets alone, on the point error of the fixed ones."""
        if self._of_targets:
            return self.table.target_rms(totals, common) / self.table.target_rms(self.total[None], common)
        return self.table.values(totals, sets, self.objective) / self.now

    def _sigma(self, total: Floats) -> Floats:
        """Standard deviations of the instrument's parameters in prior sigmas."""
        size = self.table.reducer.construction.n_parameters
        information = self.table.information(total[None])[0, :size, :size]
        return np.sqrt(np.diag(np.linalg.inv(information)))

    def _free(self, others: Ints) -> Ints:
        """Places that are free and far enough from the reflectors in use."""
        open_ = ~self.near[:, others].any(axis=1)
        open_[self.chosen] = False
        return np.flatnonzero(open_)

    def changes(self) -> Changes:
        """Results of all changes of single reflectors."""
        terms, chosen = self.table.terms, self.chosen
        candidates: dict[ChangeKind, list[RankedChange]] = {what: [] for what in CHANGE_KINDS}
        tried, helped = dict.fromkeys(CHANGE_KINDS, 0), dict.fromkeys(CHANGE_KINDS, 0)

        def note(what: ChangeKind, taken: int | None, places: Ints) -> None:
            """Record a change of the reflectors: one removed, or moved to a place; only its best move is stored."""
            others = chosen if taken is None else np.delete(chosen, taken)
            start = self.total if taken is None else self.total - terms[chosen[taken]]
            sets = np.column_stack([np.tile(others, (len(places), 1)), places])
            totals = start + terms[places]
            if what == "remove":
                sets, totals = others[None], start[None]
            if not len(sets):
                return
            values = self._worth(totals, sets, others)
            tried[what] += len(values)
            helped[what] += int(np.sum(values < 1 - MIN_GAIN))
            for k in np.argsort(values)[: 1 if what == "move" else None].tolist():
                place = None if what == "remove" else int(places[k])
                candidates[what].append((float(values[k]), taken, place, totals[k]))

        for i in range(len(chosen)):
            note("move", i, self._free(np.delete(chosen, i)))
            note("remove", i, chosen[:0])
        note("add", None, self._free(chosen))
        reported: list[PlanChange] = []
        for what, made in candidates.items():
            best = _at_different_places(sorted(made, key=lambda pair: pair[0]))[:MAX_REPORTED]
            reported += [self._change(what, *change) for change in best if what == "remove" or change[0] < 1 - MIN_GAIN]
        return Changes(tuple(reported), tried, helped)

    def _change(
        self, what: ChangeKind, value: float, taken: int | None, place: int | None, total: Floats
    ) -> PlanChange:
        common = self.chosen if taken is None else np.delete(self.chosen, taken)
        before, after = self.table.target_rms(np.stack([self.total, total]), common)
        if self._of_targets:
            now = self.table.target_sigma(self.total, common)
            ratios = {name: s / now[name] for name, s in self.table.target_sigma(total, common).items()}
        else:
            ratio = self._sigma(total) / self.sigma
            ratios = dict(zip(self.table.reducer.construction.parameter_names, ratio.tolist(), strict=True))
        serves = (min if what != "remove" else max)(ratios, key=lambda name: ratios[name])
        names, places = self.choice.names, self.choice.places
        made = PlanChange(
            do=what,
            reflector="" if taken is None else names[taken],
            place="" if place is None else names[place],
            position_mm=None if place is None else in_millimetres(places[place]),
            gain_um=float(before - after) / MICROMETRE,
            quality=value,
            serves=serves,
            serves_factor=float(ratios[serves]),
        )
        return made.model_copy(update={"words": _words(made)})


def _words(change: PlanChange) -> str:
    """Sentence on a change and its benefit, without a full stop."""
    if abs(1 - change.quality) < UNCHANGED_QUALITY:
        return f"{change.deed}: makes no difference"
    better = f"{100 * abs(1 - change.quality):.1f} % {'better' if change.quality <= 1 else 'worse'}"
    other = f"{abs(change.gain_um):.2f} um {'less' if change.gain_um >= 0 else 'more'} error of the other points"
    sigma = 100 * (change.serves_factor - 1)
    most = "hardest on" if change.do == "remove" else "most for"
    return f"{change.deed}: quality {better}, {other}, {most} {change.serves} (sigma {sigma:+.1f} %)"


def _at_different_places(best: list[RankedChange]) -> list[RankedChange]:
    """Best change for each place, and all changes that need no place."""
    distinct, places = [], set()
    for change in best:
        if change[2] is None or change[2] not in places:
            distinct.append(change)
        places.add(change[2])
    return distinct
