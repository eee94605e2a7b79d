"""Search for what explains a mismatch: one finding at a time, then all of them together again.

All cards and all laws are scored beside what was found; the best few are computed exactly, their shapes integrated on a
grid around the optimum, laws matched with short formulas. What explains most is added. Then every finding is examined
again beside the others, replaced or dropped where the set as a whole gains, and two are exchanged for one that explains
both.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import Floats, Ints
from ltsim.diagnosis.cards import ORDINARY, Cards, card_hypotheses
from ltsim.diagnosis.evidence import SCREENED_TIE, TIE, best_of, posterior, ranked
from ltsim.diagnosis.exact import Exact
from ltsim.diagnosis.forms import in_all_forms
from ltsim.diagnosis.hypotheses import Found, Hypothesis, Ranking, alike
from ltsim.diagnosis.panel import Hit, Panel
from ltsim.diagnosis.prior import log_share
from ltsim.diagnosis.probe import Probe
from ltsim.diagnosis.schema import Estimate
from ltsim.diagnosis.shapes import apart, between, shape_posterior
from ltsim.diagnosis.space import panels
from ltsim.physics.effects.signature import ShapeParameter, Tunable
from ltsim.physics.laws.law import Law
from ltsim.physics.laws.names import name_of
from ltsim.physics.laws.sizes import sizes_of

MOST_MEMBERS = 5
"""Findings that are told at most, and as many constants of instruments; the tables have all of these."""
FLEXIBLE = 10
"""Coefficients of a curve in one quantity, `MODES` and a slope; what has more can imitate several effects."""
REFINED, FEW = 7, 3
"""Cards, and laws, computed exactly in a round; in a large network, where each costs a solution of the whole."""
GRID, FINER, ZOOMS = 11, 9, 2
"""Points of the grid on which a shape is integrated, from one step of the coarse grid below to one above; points that
are put around the best one, and how often, for the peak may be much narrower than a step."""
BASINS, AMONG, BEHIND = 3, 40, 10.0
"""Members of a family that are computed exactly, among its best ones, and how much log evidence they may be behind."""
KEPT = 16
"""Projected signatures that are kept."""
MOST_LAWS = 400
"""Laws of all panels that are kept beside the ones computed exactly."""
WIDER = 1.15
"""Ratio of a parameter's sigma over all shapes to that by curvature at the optimum; above it a posterior is shown."""


class Screen(NamedTuple):
    """Everything beside a set as it is scored at once.

    Log evidence of cards (h,), and of their families with priors; laws worth a second look; the log sum over all, and
    that (trials,) of simulated recordings, which it is compared with.
    """

    values: Floats
    families: Floats
    hits: list[Hit]
    statistic: float
    null: Floats


class Searcher:
    """Search over cards and laws in one residual space."""

    def __init__(
        self, space: ResidualSpace, seed: int, trials: int = 0, *, cards: Cards | None = None, ordinary: bool = True
    ) -> None:
        """A search, judged by so many simulated recordings; with `cards` of one on the same readings, if there are.

        Constants of the `ordinary` calibration are tried against their prior, but where a history takes its place.
        """
        self.space = space
        self.probe = Probe.of(space, seed, trials)
        self.large = self.probe.sampled
        self._most = FEW if self.large else REFINED
        if cards is None:
            every = card_hypotheses(space.sightings, space.adjustment.recording.instruments)
            cards = Cards.of(space, [effect for effect in every if ordinary or type(effect) not in ORDINARY])
        self.cards = cards
        self.panels: list[Panel] = panels(space, ordinary=ordinary)
        self.empty = Found((), (), (), space.residual)
        self._ranked: dict[frozenset[str], Ranking] = {}
        self._left: OrderedDict[str, tuple[Floats, Floats]] = OrderedDict()
        self.exact = Exact(space)
        self.first = self._screened(self.empty)

    def without_rows(self, rows: Ints) -> Searcher:
        """The search without some rows (f,), each of which has an error of its own; as short as in a large network.

        What the adjustment leaves of everything is taken from the whole network where it is scored at once, and
        computed exactly where it stands out; neither depends on any reading.
        """
        unit = np.zeros((self.space.size, len(rows)))
        unit[rows, np.arange(len(rows))] = 1.0
        rest = copy(self)
        rest.space, rest.large, rest._most = self.space.extended(unit), True, FEW
        rest.probe = self.probe.beside(rest.space.residual, self.empty.extension)
        rest.empty = Found((), (), (), rest.space.residual)
        rest._ranked, rest._left = {}, OrderedDict()
        rest.exact = Exact(rest.space)
        rest.first = rest._screened(rest.empty)
        return rest

    def rank(self, base: Found) -> Ranking:
        """Everything beside a set: scored at once, the best computed exactly."""
        key = frozenset(h.key for h in base.members)
        if key not in self._ranked:
            self._ranked[key] = self._rank(base)
        return self._ranked[key]

    def _screened(self, base: Found) -> Screen:
        """All cards and laws beside a set, scored at once."""
        probe = self.probe.beside(base.residual, base.extension) if base.members else self.probe
        values, chance = self.cards.score(probe)
        families = self.cards.family_evidence(values) + self._of_a_card
        hits: list[Hit] = []
        statistic, null = log_sum_exp(families), log_sum_exp(chance + self._of_a_card)
        for panel in self.panels:
            found, law_total, law_chance = panel.score(probe)
            hits += found
            statistic, null = np.logaddexp(statistic, law_total), np.logaddexp(null, law_chance)
        return Screen(values, families, hits, float(statistic), null)

    @property
    def _of_a_card(self) -> float:
        """Log prior of each family of cards."""
        return log_share("named", len(self.cards.families))

    def _rank(self, base: Found) -> Ranking:
        values, families, hits, _, _ = self._screened(base) if base.members else self.first
        entries = self._laws(hits, base)
        for i, family in enumerate(ranked(families, SCREENED_TIE)):
            entries.append(self._card(int(family), values, float(families[family]), base, refine=i < self._most))
        entries = [replace(h, value=h.value + alike(h, base.members)) for h in entries]
        entries = [entries[i] for i in ranked(np.array([h.value for h in entries]))]
        return Ranking(tuple(entries), float(log_sum_exp(np.array([h.value for h in entries]))))

    def _card(self, family: int, values: Floats, total: float, base: Found, *, refine: bool) -> Hypothesis:
        """The best of a family of cards, with the evidence of the family; computed exactly if it is to be refined."""
        members = np.flatnonzero(self.cards.family == family)
        members = members[ranked(values[members], SCREENED_TIE)]
        prior = self._of_a_card - float(np.log(len(members)))
        best = Hypothesis(self.cards.effects[members[0]], prior, total, self.cards.families[family])
        if not refine:
            return best
        for i in self._basins(members, values):
            effect, value = self._integrated(self.cards.effects[i], base)
            others = np.delete(values[members], np.flatnonzero(members == i))
            whole = float(log_sum_exp(np.append(others, value))) + prior
            if i == members[0] or value + prior > best.value:
                best = replace(best, effect=effect, value=whole)
        return best

    def _basins(self, members: Ints, values: Floats) -> list[int]:
        """The best members of a family, and others nearly as good at another place or shape."""
        chosen = [int(members[0])]
        for i in members[1:AMONG]:
            if len(chosen) == BASINS or values[i] < values[chosen[0]] - BEHIND:
                break
            if all(apart(self.cards.effects[int(i)], self.cards.effects[j]) for j in chosen):
                chosen.append(int(i))
        return chosen

    def _integrated(self, effect: Tunable, base: Found) -> tuple[Tunable, float]:
        """An effect with its shape at the optimum, and its log evidence averaged over a cell of the coarse grid."""
        effect, value = self.exact.uphill([effect], base)[0]
        for shape in type(effect).shape:
            now = getattr(effect, shape.name)
            if isinstance(now, float) and shape.steps > 1:
                effect, value = self._over(effect, shape, base, value)
        return effect, value

    def _over(self, effect: Tunable, shape: ShapeParameter, base: Found, value: float) -> tuple[Tunable, float]:
        """One shape constant: best value and log mean evidence over a cell, by the trapezoidal rule."""
        now = float(getattr(effect, shape.name))
        low, high = shape.bracket(now)
        if not low < high:
            return effect, value
        u = np.linspace(-1.0, 1.0, GRID)

        def tried(some: Floats) -> Floats:
            values = (between(shape, low, high, x) for x in some.tolist())
            return self.exact.evidence([effect.reshaped(**{shape.name: value}) for value in values], base)

        logs = tried(u)
        for _ in range(ZOOMS):
            top = best_of(logs)
            near = u[max(top - 1, 0) : top + 2]
            more = np.setdiff1d(np.linspace(near[0], near[-1], FINER), u)
            order = np.argsort(np.concatenate([u, more]))
            u, logs = np.concatenate([u, more])[order], np.concatenate([logs, tried(more)])[order]
        best = effect.reshaped(**{shape.name: between(shape, low, high, float(u[best_of(logs)]))})
        height = np.exp(logs - logs.max())
        return best, float(logs.max() + np.log(max(np.trapezoid(height, u), 1e-300)))

    def _laws(self, hits: Sequence[Hit], base: Found) -> list[Hypothesis]:
        """Laws worth a second look; the first ones exactly, with the shortest formulas that fit as well."""
        found, seen = [], set[tuple[object, ...]]()
        hits = [hits[i] for i in ranked(np.array([h.value for h in hits]), SCREENED_TIE)[:MOST_LAWS]]
        for hit in hits:
            place, driver = hit.place, hit.driver.centred_on(hit.place.targets)
            law = Law(place.stations, place.targets, hit.carrier, driver, place.instruments)
            key = (hit.carrier.name, driver.kind, driver.covariate_labels, place.stations, place.targets)
            if len(seen) < self._most and key not in seen and hit.value > _promising(hits[0].value):
                seen.add(key)
                found += in_all_forms(self.exact, law, hit.log_prior, base, pieces=not self.large)
            else:
                found.append(Hypothesis(law, hit.log_prior, hit.value, name_of(law)))
        return found

    def estimates(self, hypothesis: Hypothesis, others: Found, told: Sequence[Estimate]) -> tuple[Estimate, ...]:
        """Estimates of a refit; where shapes leave them less certain, mean and deviation over all shapes."""
        effect = hypothesis.effect
        if isinstance(effect, Law):
            sizes = sizes_of(effect, self.space.sightings, *self.coefficients(effect, others))
            return tuple(Estimate(**size._asdict()) for size in sizes)
        found = shape_posterior(self.exact, effect, others, told)
        wider = any(found[e.name].sigma > WIDER * e.sigma for e in told if e.name in found)
        rows = [found.get(e.name, e) if wider else e for e in told]
        if "time" in found and all(e.name != "time" for e in rows):
            rows.append(found["time"])
        return tuple(rows)

    def coefficients(self, law: Law, others: Found) -> tuple[Floats, Floats]:
        """Mean (k,) and covariance (k, k) of a law's coefficients beside a set."""
        gram, score = self.exact.moments([law], others)[0]
        return posterior(gram, score, law.spread)[:2]

    def with_members(self, members: Sequence[Hypothesis]) -> Found:
        """The set of some hypotheses, scored together."""
        if not members:
            return self.empty
        parts = [self._left_of(h) for h in members]
        return Found(tuple(members), tuple(p[0] for p in parts), tuple(p[1] for p in parts), self.space.residual)

    def without(self, found: Found, member: int) -> Found:
        """A set less one of its members."""
        return self.with_members(found.members[:member] + found.members[member + 1 :])

    def _left_of(self, hypothesis: Hypothesis) -> tuple[Floats, Floats]:
        """Projection of a signature onto the residual space, and lengths of its columns; the last few are cached."""
        key = hypothesis.key
        if key not in self._left:
            whole = self.exact.signature(hypothesis.effect)
            self._left[key] = self.space.project(whole), np.linalg.norm(whole, axis=0)
        self._left.move_to_end(key)
        if len(self._left) > KEPT:
            self._left.popitem(last=False)
        return self._left[key]

    def search(self, threshold: float, *, something: bool) -> Found:
        """The best set: each further finding must raise the evidence of all there is by `threshold`.

        A curve with many coefficients can imitate several effects: the search begins again with the best of those that
        have few, and what gains more is told.
        """
        best = self._grown(self.empty, threshold, something=something)
        stiff = [h for h in self.rank(self.empty).entries if len(h.spread) <= FLEXIBLE]
        if stiff and not self.large and any(len(h.spread) > FLEXIBLE for h in best.members):
            made = (best, self._grown(self.with_members(stiff[:1]), threshold, something=True))
            best = max(made, key=lambda s: s.score - threshold * len(s.members))
        return self._renamed(best, threshold)

    def first_look(self, threshold: float, rival: float) -> Found:
        """Lower bound of a search: findings added one at a time, none of them examined again.

        It ends where it is beyond the evidence of a `rival`, or would not be if all others gained as much as the last.
        """
        return self._grown(self.empty, threshold, something=True, rival=rival)

    def _grown(self, best: Found, threshold: float, *, something: bool, rival: float | None = None) -> Found:
        """A set with findings added one at a time, those before examined again beside each if there is no `rival`."""
        again = rival is None
        for depth in range(len(best.members), MOST_MEMBERS):
            ranking, least = self.rank(best), threshold + best.misfit
            if ranking.total < least and (depth or not something):
                break
            grown = _best([self.with_members((*best.members, h)) for h in ranking.entries[:3]])
            grown = self.reexamined(grown) if again and not self.large else grown
            if depth and grown.score < best.score + threshold:
                break
            gain, best = grown.score - best.score, grown
            if rival is not None and not best.score < rival < best.score + gain * (MOST_MEMBERS - 1 - depth):
                break
        return self.reexamined(best) if again and self.large else best

    def _renamed(self, found: Found, threshold: float) -> Found:
        """Members that the others leave nothing to are dropped; the likeliest name beside the others stays."""
        for member in found.members[::-1]:
            others = self.without(found, found.members.index(member))
            ranking = self.rank(others)
            if others.members and ranking.total < threshold + others.misfit:
                found = others
            elif (likeliest := ranking.name()) != member.name:
                better = next(h for h in ranking.entries if h.name == likeliest)
                found = self.with_members((*others.members, better))
        return found

    def reexamined(self, found: Found) -> Found:
        """Members replaced, dropped, or two of them exchanged for one, while the set gains."""
        for turn in range(2):
            before = found.score
            for size in (1,) if turn or self.large else (1, 2):
                for some in combinations(range(len(found.members)), size):
                    if len(found.members) < 2 or max(some) >= len(found.members):
                        continue
                    others = tuple(h for i, h in enumerate(found.members) if i not in some)
                    rest = self.with_members(others)
                    made = [self.with_members((*others, h)) for h in self.rank(rest).entries[: 2 if others else 6]]
                    found = _best([found, *made, *([rest] if others else [])])
            if found.score <= before + 1e-6:
                break
        return found


def _best(sets: Sequence[Found]) -> Found:
    """The set with the largest score; of equal ones the first."""
    most = max(found.score for found in sets)
    return next(found for found in sets if found.score >= most - TIE)


def _promising(best: float) -> float:
    """Log evidence from which a law is computed exactly beside the best: its forms can double it."""
    return 0.5 * best - 5.0
