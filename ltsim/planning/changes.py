"""Which reflector to move, to add or to leave out: every single change of a layout, ranked by what it is worth."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ltsim.arrays import Bools, Floats, Ints
from ltsim.model.construction import Construction
from ltsim.planning.objective import TARGETS, Objective
from ltsim.planning.reflectors import Movable
from ltsim.planning.schema import PlanChange, rounded
from ltsim.planning.site import Site
from ltsim.planning.survey import Survey
from ltsim.units import MICROMETRE, MILLIMETRE

MATERIAL = 0.002
"""Least improvement of the quality, relative, that a change is told for."""
NOTHING = 5e-4
"""Change of the quality, relative, that is none."""
SHOWN = 3
"""Changes of each sort that are told."""

What = Literal["move", "add", "remove"]
SORTS: tuple[What, ...] = get_args(What)
Tried = tuple[float, int | None, int | None, Floats]
"""Factor on the quality, which reflector leaves, which place is taken, the normal matrix then."""


@dataclass(frozen=True)
class Changes:
    """All single changes that were tried."""

    told: tuple[PlanChange, ...]
    """Moves and additions that help, the best first, then what can be left out at the least cost."""
    tried: dict[What, int]
    """How many of each sort."""
    helped: dict[What, int]
    """How many of each made the quality better by more than `MATERIAL`."""

    @property
    def summary(self) -> str:
        """What was tried, and how much of it helps, as a sentence."""
        if not self.tried["move"] + self.tried["add"]:
            return (
                "No other place for a reflector was tried: give candidates as reflectors.on, reflectors.places or "
                "reflectors.surfaces, and say which points of a list may go elsewhere as reflectors.movable."
            )
        return (
            f"Tried one at a time: {self.tried['move']} moves of a reflector ({self.helped['move']} help), "
            f"{self.tried['add']} further places ({self.helped['add']} help); the others gain less than "
            f"{100 * MATERIAL:.1f} %."
        )


def reflector_changes(
    site: Site, survey: Survey, stays: Bools, objective: Objective, construction: Construction
) -> Changes:
    """Try every move, addition and removal of one reflector, but of those that stay (T,); places are the site's."""
    if stays.all() and site.nests is None:
        return Changes((), dict.fromkeys(SORTS, 0), dict.fromkeys(SORTS, 0))
    return _Trial(Movable.of(site, survey, stays, objective, construction), objective, site.reflector_spacing).changes()


class _Trial:
    """A choice of places, the reflectors' own in use."""

    def __init__(self, choice: Movable, objective: Objective, spacing: float) -> None:
        self.choice, self.table, self.objective = choice, choice.table, objective
        self.chosen = np.arange(choice.own)
        self.total = self.table.total(self.chosen)
        self.now = self.table.values(self.total[None], self.chosen[None], objective)[0]
        self.sigma = self._sigma(self.total)
        gap = np.linalg.norm(choice.places[:, None] - choice.places[None], axis=2)
        self.near = gap < spacing

    @property
    def _of_targets(self) -> bool:
        """The goal is targets alone."""
        return not any(weight > 0 for name, weight in self.objective.weights.items() if name != TARGETS)

    def _worth(self, totals: Floats, sets: Ints, common: Ints) -> Floats:
        """Factor (B,) on the objective; with a goal of targets alone on the point error of those that stay."""
        if self._of_targets:
            return self.table.target_rms(totals, common) / self.table.target_rms(self.total[None], common)
        return self.table.values(totals, sets, self.objective) / self.now

    def _sigma(self, total: Floats) -> Floats:
        """Standard deviations of the instrument's parameters in prior sigmas."""
        size = self.table.reducer.construction.size
        information = self.table.information(total[None])[0, :size, :size]
        return np.sqrt(np.diag(np.linalg.inv(information)))

    def _free(self, others: Ints) -> Ints:
        """Places that are not in use and far enough from the reflectors in use."""
        open_ = ~self.near[:, others].any(axis=1)
        open_[self.chosen] = False
        return np.flatnonzero(open_)

    def changes(self) -> Changes:
        """All single changes."""
        terms, chosen = self.table.terms, self.chosen
        found: dict[What, list[Tried]] = {what: [] for what in SORTS}
        tried, helped = dict.fromkeys(SORTS, 0), dict.fromkeys(SORTS, 0)

        def note(what: What, taken: int | None, places: Ints) -> None:
            """One reflector away, one at each of some places instead; of its moves only the best is kept."""
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
            helped[what] += int(np.sum(values < 1 - MATERIAL))
            for k in np.argsort(values)[: 1 if what == "move" else None].tolist():
                place = None if what == "remove" else int(places[k])
                found[what].append((float(values[k]), taken, place, totals[k]))

        for i in range(len(chosen)):
            note("move", i, self._free(np.delete(chosen, i)))
            note("remove", i, chosen[:0])
        note("add", None, self._free(chosen))
        told: list[PlanChange] = []
        for what, made in found.items():
            best = _at_different_places(sorted(made, key=lambda pair: pair[0]))[:SHOWN]
            told += [self._change(what, *one) for one in best if what == "remove" or one[0] < 1 - MATERIAL]
        return Changes(tuple(told), tried, helped)

    def _change(self, what: What, value: float, taken: int | None, place: int | None, total: Floats) -> PlanChange:
        common = self.chosen if taken is None else np.delete(self.chosen, taken)
        before, after = self.table.target_rms(np.stack([self.total, total]), common)
        if self._of_targets:
            now = self.table.target_sigma(self.total, common)
            ratios = {name: s / now[name] for name, s in self.table.target_sigma(total, common).items()}
        else:
            ratio = self._sigma(total) / self.sigma
            ratios = dict(zip(self.table.reducer.construction.names, ratio.tolist(), strict=True))
        serves = (min if what != "remove" else max)(ratios, key=lambda name: ratios[name])
        names, places = self.choice.names, self.choice.places
        made = PlanChange(
            do=what,
            reflector="" if taken is None else names[taken],
            place="" if place is None else names[place],
            position_mm=None if place is None else rounded(places[place] / MILLIMETRE, 1),
            gain_um=float(before - after) / MICROMETRE,
            quality=value,
            serves=serves,
            serves_factor=float(ratios[serves]),
        )
        return made.model_copy(update={"words": _words(made)})


def _words(change: PlanChange) -> str:
    """What to do and what it brings, as a sentence without a stop."""
    if abs(1 - change.quality) < NOTHING:
        return f"{change.deed}: makes no difference"
    better = f"{100 * abs(1 - change.quality):.1f} % {'better' if change.quality <= 1 else 'worse'}"
    other = f"{abs(change.gain_um):.2f} um {'less' if change.gain_um >= 0 else 'more'} error of the other points"
    sigma = 100 * (change.serves_factor - 1)
    most = "hardest on" if change.do == "remove" else "most for"
    return f"{change.deed}: quality {better}, {other}, {most} {change.serves} (sigma {sigma:+.1f} %)"


def _at_different_places(best: list[Tried]) -> list[Tried]:
    """The first for each place; all that take none."""
    kept, places = [], set()
    for one in best:
        if one[2] is None or one[2] not in places:
            kept.append(one)
        places.add(one[2])
    return kept
