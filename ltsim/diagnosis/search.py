"""Model selection by forward, backward and exchange steps.

All catalogue effects and laws are screened given the model; the best few are evaluated without approximation, their
shapes integrated on a grid around the optimum, laws compared with short formulas. The best hypothesis is added. Then
each member is tested again given the others, and is replaced or removed if the evidence of the model increases; pairs
are exchanged for a single member.
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
from ltsim.diagnosis.catalogue_signatures import ORDINARY, CatalogueSignatures, catalogue_hypotheses
from ltsim.diagnosis.evidence import SCREENED_TIE, TIE, best_of, posterior, ranked
from ltsim.diagnosis.evidence_calculator import EvidenceCalculator
from ltsim.diagnosis.forms import evaluate_forms
from ltsim.diagnosis.hypotheses import Hypothesis, Model, Ranking, log_odds_repeated
from ltsim.diagnosis.law_batch import LawBatch, ScreenedLaw, scored
from ltsim.diagnosis.null_ensemble import NullEnsemble
from ltsim.diagnosis.prior import log_share
from ltsim.diagnosis.schema import Estimate
from ltsim.diagnosis.shapes import are_distinct, centre_estimates, interpolate, shape_posterior
from ltsim.diagnosis.space import panels
from ltsim.physics.effects.signature import CandidateEffect, ShapeParameter
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.names import catalogue_name
from ltsim.physics.laws.sizes import displayed_sizes

MOST_MEMBERS = 5
"""Largest number of members of a model, and of reported constants of instruments."""
MOST_STIFF = 10
"""Members with more coefficients than a curve in one quantity (`MODES` and a slope) can imitate several effects: the
search then starts again without them."""
REFINED, FEW = 7, 3
"""Number of families, and of laws, evaluated without approximation in a step; in large networks the second (cost)."""
GRID, FINER, ZOOMS = 11, 9, 2
"""Number of grid points over which a shape is integrated (one coarse step to either side), number of points added
around the best one, and number of such refinements, since the peak may be much narrower than a step.
"""
MOST_OPTIMA, MOST_COMPARED, MOST_BEHIND = 3, 40, 10.0
"""Largest number of evaluated local optima of a family, number of its best members among which they are sought, and
largest deficit of log evidence.
"""
MOST_CACHED = 16
"""Number of projected signatures in the cache."""
MOST_LAWS = 400
"""Number of screened laws that stay in a ranking."""
WIDER = 1.15
"""Increase of sigma by marginalisation over shape above which the posterior is reported in place of Laplace's
approximation.
"""


class Screen(NamedTuple):
    """Screening result given a model.

    Log evidence of catalogue effects (h,), and of their families with priors; best laws; the log sum over all, and that
    (trials,) of the null ensemble.
    """

    values: Floats
    families: Floats
    hits: list[ScreenedLaw]
    statistic: float
    null: Floats


class Searcher:
    """Search over catalogue effects and laws in one residual space."""

    def __init__(
        self,
        space: ResidualSpace,
        seed: int,
        trials: int = 0,
        *,
        cards: CatalogueSignatures | None = None,
        ordinary: bool = True,
    ) -> None:
        """Search with `trials` simulated recordings; `cards` are the signatures of a search on the same readings.

        Constants of the `ordinary` calibration are hypotheses unless a history replaces their prior.
        """
        self.space = space
        self.probe = NullEnsemble.of(space, seed, trials)
        self.large = self.probe.gram_is_monte_carlo
        self._most = FEW if self.large else REFINED
        if cards is None:
            every = catalogue_hypotheses(space.sightings, space.adjustment.recording.instruments)
            cards = CatalogueSignatures.of(
                space, [effect for effect in every if ordinary or type(effect) not in ORDINARY]
            )
        self.cards = cards
        self.panels: list[LawBatch] = panels(space, ordinary=ordinary)
        self.empty = Model((), (), (), space.residuals)
        self._ranked: dict[frozenset[str], Ranking] = {}
        self._projected: OrderedDict[str, tuple[Floats, Floats]] = OrderedDict()
        self.exact = EvidenceCalculator(space)
        self.first = self._screened(self.empty)

    def without_rows(self, rows: Ints) -> Searcher:
        """Search without the rows (f,), each of which has a separate error, in the reduced form for large networks.

        Screening uses the Gram matrices of the whole network, evaluation those without the rows; neither depends on the
        readings.
        """
        unit = np.zeros((self.space.n_rows, len(rows)))
        unit[rows, np.arange(len(rows))] = 1.0
        rest = copy(self)
        rest.space, rest.large, rest._most = self.space.with_signatures(unit), True, FEW
        rest.probe = self.probe.with_model(rest.space.residuals, self.empty.basis)
        rest.empty = Model((), (), (), rest.space.residuals)
        rest._ranked, rest._projected = {}, OrderedDict()
        rest.exact = EvidenceCalculator(rest.space)
        rest.first = rest._screened(rest.empty)
        return rest

    def rank(self, base: Model) -> Ranking:
        """Ranking of all hypotheses given a model: screened, the best evaluated without approximation."""
        key = frozenset(h.key for h in base.members)
        if key not in self._ranked:
            self._ranked[key] = self._rank(base)
        return self._ranked[key]

    def _screened(self, base: Model) -> Screen:
        """Screening of all catalogue effects and laws given a model."""
        probe = self.probe.with_model(base.residual, base.basis) if base.members else self.probe
        values, chance = self.cards.score(probe)
        families = self.cards.family_evidence(values) + self._log_family_prior
        hits: list[ScreenedLaw] = []
        statistic, null = log_sum_exp(families), log_sum_exp(chance + self._log_family_prior)
        for hits_here, law_total, law_chance in scored(self.panels, probe):
            hits += hits_here
            statistic, null = np.logaddexp(statistic, law_total), np.logaddexp(null, law_chance)
        return Screen(values, families, hits, float(statistic), null)

    @property
    def _log_family_prior(self) -> float:
        """Log prior of each catalogue family."""
        return log_share("named", len(self.cards.families))

    def _rank(self, base: Model) -> Ranking:
        values, families, hits, _, _ = self._screened(base) if base.members else self.first
        entries = self._laws(hits, base)
        for i, family in enumerate(ranked(families, SCREENED_TIE)):
            entries.append(self._card(int(family), values, float(families[family]), base, refine=i < self._most))
        entries = [replace(h, value=h.value + log_odds_repeated(h, base.members)) for h in entries]
        entries = [entries[i] for i in ranked(np.array([h.value for h in entries]))]
        return Ranking(tuple(entries), float(log_sum_exp(np.array([h.value for h in entries]))))

    def _card(self, family: int, values: Floats, total: float, base: Model, *, refine: bool) -> Hypothesis:
        """Best member of a family with the evidence of the family; evaluated without approximation if `refine`."""
        members = np.flatnonzero(self.cards.family == family)
        members = members[ranked(values[members], SCREENED_TIE)]
        prior = self._log_family_prior - float(np.log(len(members)))
        best = Hypothesis(self.cards.effects[members[0]], prior, total, self.cards.families[family])
        if not refine:
            return best
        for i in self._local_optima(members, values):
            effect, value = self._integrated(self.cards.effects[i], base)
            others = np.delete(values[members], np.flatnonzero(members == i))
            whole = float(log_sum_exp(np.append(others, value))) + prior
            if i == members[0] or value + prior > best.value:
                best = replace(best, effect=effect, value=whole)
        return best

    def _local_optima(self, members: Ints, values: Floats) -> list[int]:
        """Best member of a family, and others nearly as good at a distinct place or shape."""
        chosen = [int(members[0])]
        for i in members[1:MOST_COMPARED]:
            if len(chosen) == MOST_OPTIMA or values[i] < values[chosen[0]] - MOST_BEHIND:
                break
            if all(are_distinct(self.cards.effects[int(i)], self.cards.effects[j]) for j in chosen):
                chosen.append(int(i))
        return chosen

    def _integrated(self, effect: CandidateEffect, base: Model) -> tuple[CandidateEffect, float]:
        """Effect with its shape at the optimum, and log evidence averaged over a cell of the coarse grid."""
        effect, value = self.exact.refine_locally([effect], base)[0]
        for shape in type(effect).shape_parameters:
            now = getattr(effect, shape.name)
            if isinstance(now, float) and shape.n_grid_values > 1:
                effect, value = self._over(effect, shape, base, value)
        return effect, value

    def _over(
        self, effect: CandidateEffect, shape: ShapeParameter, base: Model, value: float
    ) -> tuple[CandidateEffect, float]:
        """Best value of a shape constant, and log mean evidence over its cell by the trapezoidal rule."""
        now = float(getattr(effect, shape.name))
        low, high = shape.neighbouring_grid_interval(now)
        if not low < high:
            return effect, value
        u = np.linspace(-1.0, 1.0, GRID)

        def tried(points: Floats) -> Floats:
            values = (interpolate(shape, low, high, x) for x in points.tolist())
            return self.exact.evidence([effect.with_constants(**{shape.name: value}) for value in values], base)

        logs = tried(u)
        for _ in range(ZOOMS):
            top = best_of(logs)
            near = u[max(top - 1, 0) : top + 2]
            more = np.setdiff1d(np.linspace(near[0], near[-1], FINER), u)
            order = np.argsort(np.concatenate([u, more]))
            u, logs = np.concatenate([u, more])[order], np.concatenate([logs, tried(more)])[order]
        best = effect.with_constants(**{shape.name: interpolate(shape, low, high, float(u[best_of(logs)]))})
        height = np.exp(logs - logs.max())
        return best, float(logs.max() + np.log(max(np.trapezoid(height, u), 1e-300)))

    def _laws(self, hits: Sequence[ScreenedLaw], base: Model) -> list[Hypothesis]:
        """Screened laws: the best ones, and the best of each response and kind of regressor, in all forms.

        Screening is coarser for some kinds than for others: a refined region can have several times the evidence.
        """
        entries, evaluated = [], set[tuple[object, ...]]()
        kinds = set[tuple[str, str, bool]]()
        hits = [hits[i] for i in ranked(np.array([h.value for h in hits]), SCREENED_TIE)[:MOST_LAWS]]
        for hit in hits:
            place, driver = hit.place, hit.driver.centred_on(hit.place.targets)
            law = EmpiricalLaw(place.stations, place.targets, hit.carrier, driver, place.instruments)
            key = (hit.carrier.name, driver.kind, driver.covariate_labels, place.stations, place.targets)
            kind = hit.carrier.name, driver.kind, len(place.targets) == 1
            chosen = len(evaluated) < self._most or kind not in kinds
            if chosen and key not in evaluated and hit.value > _promising(hits[0].value):
                evaluated.add(key)
                kinds.add(kind)
                entries += evaluate_forms(self.exact, law, hit.log_prior, base, pieces=not self.large)
            else:
                entries.append(Hypothesis(law, hit.log_prior, hit.value, catalogue_name(law)))
        return entries

    def estimates(self, hypothesis: Hypothesis, others: Model, refitted: Sequence[Estimate]) -> tuple[Estimate, ...]:
        """Estimates of a refit; posterior means and deviations over all shapes where these are much wider."""
        effect = hypothesis.effect
        if isinstance(effect, EmpiricalLaw):
            sizes = displayed_sizes(effect, self.space.sightings, *self.coefficients(effect, others))
            return (*(Estimate(**size._asdict()) for size in sizes), *centre_estimates(self.exact, effect, others))
        marginal = shape_posterior(self.exact, effect, others, refitted)
        wider = any(marginal[e.name].sigma > WIDER * e.sigma for e in refitted if e.name in marginal)
        rows = [marginal.get(e.name, e) if wider else e for e in refitted]
        if "time" in marginal and all(e.name != "time" for e in rows):
            rows.append(marginal["time"])
        return (*rows, *centre_estimates(self.exact, effect, others))

    def coefficients(self, law: EmpiricalLaw, others: Model) -> tuple[Floats, Floats]:
        """Mean (k,) and covariance (k, k) of a law's coefficients given a model."""
        gram, score = self.exact.moments([law], others)[0]
        return posterior(gram, score, law.size_scales)[:2]

    def with_members(self, members: Sequence[Hypothesis]) -> Model:
        """Model of the given hypotheses."""
        if not members:
            return self.empty
        parts = [self._projected_signature(h) for h in members]
        return Model(tuple(members), tuple(p[0] for p in parts), tuple(p[1] for p in parts), self.space.residuals)

    def without(self, model: Model, member: int) -> Model:
        """Model without a member."""
        return self.with_members(model.members[:member] + model.members[member + 1 :])

    def _projected_signature(self, hypothesis: Hypothesis) -> tuple[Floats, Floats]:
        """Projection of a signature onto the residual space, and lengths of its columns; the last few are cached."""
        key = hypothesis.key
        if key not in self._projected:
            whole = self.exact.signature(hypothesis.effect)
            self._projected[key] = self.space.project(whole), np.linalg.norm(whole, axis=0)
        self._projected.move_to_end(key)
        if len(self._projected) > MOST_CACHED:
            self._projected.popitem(last=False)
        return self._projected[key]

    def search(self, threshold: float, *, something: bool) -> Model:
        """Selected model, in which each additional member increases the log evidence by at least `threshold`.

        A curve with many coefficients can imitate several effects: the search starts again with the best hypothesis of
        few coefficients, and the model with the larger evidence is selected.
        """
        best = self._forward(self.empty, threshold, something=something)
        stiff = [h for h in self.rank(self.empty).entries if len(h.spread) <= MOST_STIFF]
        if stiff and not self.large and any(len(h.spread) > MOST_STIFF for h in best.members):
            made = (best, self._forward(self.with_members(stiff[:1]), threshold, something=True))
            best = max(made, key=lambda s: s.score - threshold * len(s.members))
        return self._relabel(best, threshold)

    def lower_bound(self, threshold: float, rival: float) -> Model:
        """Lower bound of a search: forward steps alone.

        It ends once it exceeds the evidence of a `rival`, or cannot if all further members gain as much as the last.
        """
        return self._forward(self.empty, threshold, something=True, rival=rival)

    def _forward(self, best: Model, threshold: float, *, something: bool, rival: float | None = None) -> Model:
        """Forward selection; earlier members are tested again after each step unless there is a `rival`."""
        again = rival is None
        for depth in range(len(best.members), MOST_MEMBERS):
            ranking, least = self.rank(best), threshold + best.discrepancy_penalty
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

    def _relabel(self, model: Model, threshold: float) -> Model:
        """Model without members that the others explain, each renamed to the most probable effect given the others."""
        for member in model.members[::-1]:
            others = self.without(model, model.members.index(member))
            ranking = self.rank(others)
            if others.members and ranking.total < threshold + others.discrepancy_penalty:
                model = others
            elif (likeliest := ranking.name()) != member.name:
                better = next(h for h in ranking.entries if h.name == likeliest)
                model = self.with_members((*others.members, better))
        return model

    def reexamined(self, model: Model) -> Model:
        """Backward and exchange steps, members replaced, dropped or merged, while the evidence rises."""
        for turn in range(2):
            before = model.score
            for size in (1,) if turn or self.large else (1, 2):
                for dropped in combinations(range(len(model.members)), size):
                    if len(model.members) < 2 or max(dropped) >= len(model.members):
                        continue
                    others = tuple(h for i, h in enumerate(model.members) if i not in dropped)
                    rest = self.with_members(others)
                    made = [self.with_members((*others, h)) for h in self.rank(rest).entries[: 2 if others else 6]]
                    model = _best([model, *made, *([rest] if others else [])])
            if model.score <= before + 1e-6:
                break
        return model


def _best(sets: Sequence[Model]) -> Model:
    """Model with the largest score; the first of equal ones."""
    most = max(model.score for model in sets)
    return next(model for model in sets if model.score >= most - TIE)


def _promising(best: float) -> float:
    """Screened log evidence, relative to the best, from which a law is evaluated in all forms: forms may double it."""
    return 0.5 * best - 5.0
