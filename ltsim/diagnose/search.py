"""Search for the effects that explain a mismatch: several at once, whole sets compared by their evidence.

The score of a set is the log marginal likelihood of all its signatures together, less what each member's place and
shape cost among the alternatives of its family, less what an implausible size costs. A beam of sets grows by one member
at a time; then every member is examined again beside the others, and replaced or dropped where that scores better.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize import minimize_scalar

from ltsim.adjust.residual_space import VISIBLE, ResidualSpace, orthonormal
from ltsim.arrays import Floats, Ints
from ltsim.diagnose.bank import Bank, Hypothesis
from ltsim.diagnose.evidence import log_evidence, log_means, plausibility
from ltsim.diagnose.flexible import FlexibleTerm
from ltsim.diagnose.held_out import held_out_rms, pair_folds
from ltsim.effects.effect import ShapeParameter

BEAM = 4
MOST_MEMBERS = 4
REFINED = 8
MOST_BASINS = 3
MOST_GROWTHS = 3
MOST_STEPS = 8
"""Moves to a neighbour that a refinement makes at most."""
BASIN_DEPTH = 12.0
UNKNOWN_ODDS = 1.0
"""Prior odds of all physics outside the catalogue against one effect of it: a wrong name is worse than none."""
LARGEST = 20.0
"""Sizes are held to so many prior sigmas where a shape leaves hardly anything of an effect to measure it by."""


@dataclass(frozen=True)
class Member:
    """A hypothesis in a set, with its signature (m, q)."""

    hypothesis: Hypothesis
    signature: Floats
    cost: float


@dataclass(frozen=True)
class EffectSet:
    """A set of effects and what it scores.

    Attributes
    ----------
    members : tuple of Member
    extension : (m, e) float
        Orthonormal columns of all members.
    residual : (m,) float
        What they leave.
    score : float
        Log evidence of the set against no effect at all.
    """

    members: tuple[Member, ...]
    extension: Floats
    residual: Floats
    score: float

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """The hypotheses of the members."""
        return tuple(m.hypothesis for m in self.members)


@dataclass(frozen=True)
class Ranking:
    """Families in the order of their evidence beside a set: (family, best hypothesis, log evidence)."""

    entries: tuple[tuple[str, Hypothesis, float], ...]

    def probabilities(self) -> dict[str, float]:
        """Posterior probability of each family; all unknown families are one."""
        logs = np.array([e[2] for e in self.entries])
        weight = np.exp(logs - logs.max())
        total: dict[str, float] = {}
        for (family, _, _), w in zip(self.entries, weight / weight.sum(), strict=True):
            name = family if not family.startswith("unknown") else "unknown"
            total[name] = total.get(name, 0.0) + float(w)
        return total


def estimates(left: Floats, whole: Floats, residual: Floats) -> Floats:
    """Sizes (q,) of signatures of which `left` (m, q) remains of `whole`; what is not visible is estimated as zero.

    Columns are scaled by the whole signature, so units do not decide what is kept.
    """
    norm = np.linalg.norm(whole, axis=0)
    norm[norm == 0] = 1.0
    u, s, vt = np.linalg.svd(left / norm, full_matrices=False)
    seen = s**2 > VISIBLE
    return np.asarray(vt[seen].T @ ((u[:, seen].T @ residual) / s[seen]) / norm)


def _fine(shape: ShapeParameter, now: float, sigma: float, count: int) -> tuple[Floats, Floats]:
    """Values of a shape constant over its bounds, denser within four `sigma` of the estimate, and widths of cells."""

    def even(x: Floats) -> Floats:
        return np.log(x) if shape.logarithmic else (1.0 / x if shape.reciprocal else x)

    low, high = min(shape.low, now), max(shape.high, now)
    grid = np.geomspace(low, high, count) if shape.logarithmic else np.linspace(low, high, count)
    if shape.reciprocal:
        grid = 1.0 / np.linspace(1.0 / low, 1.0 / high, count)
    near = np.clip(now + sigma * np.linspace(-4.0, 4.0, 13), low, high)
    values = np.unique(np.concatenate([grid, near, [now]]))
    edges = even(np.concatenate([values[:1], 0.5 * (values[1:] + values[:-1]), values[-1:]]))
    return values, np.maximum(np.abs(np.diff(edges)), 1e-300)


class Searcher:
    """Search over a bank of hypotheses in one residual space."""

    def __init__(self, space: ResidualSpace, bank: Bank) -> None:
        self.space, self.bank = space, bank
        self._size = np.bincount(bank.family, minlength=len(bank.families))
        unknown = [name.startswith("unknown") for name in bank.families]
        share = UNKNOWN_ODDS / max(sum(unknown), 1)
        self.prior = np.log(np.where(unknown, share, 1.0))
        self.prior -= np.log(np.exp(self.prior).sum())

    @property
    def empty(self) -> EffectSet:
        """The set without members."""
        return EffectSet((), np.zeros((self.space.size, 0)), self.space.residual, 0.0)

    def family_evidence(self, drop: Floats, rank: Ints) -> Floats:
        """Log evidence (families,) with places and shapes averaged, prior odds included."""
        return log_means(log_evidence(drop, rank), self.bank.family, len(self.bank.families)) + self.prior

    def rank(self, base: EffectSet, count: int = REFINED) -> Ranking:
        """The best hypothesis of each family beside a set, shapes refined and sizes weighed for the first ones."""
        drop, rank = self.bank.drops(base.residual, base.extension)
        evidence = log_evidence(drop, rank)
        families = self.family_evidence(drop, rank)
        entries = []
        for f in np.argsort(-families)[: max(count, 1)]:
            members = np.flatnonzero(self.bank.family == f)
            tried = []
            for i in self._basins(members[np.argsort(-evidence[members])], evidence):
                refined, gain = self._refined(self.bank.hypotheses[i], base, float(evidence[i]))
                size = self._plausibility(refined, base)
                tried.append((float(evidence[i]) + gain - refined.tuning + size, refined))
            value, refined = max(tried, key=lambda pair: pair[0])
            top = float(evidence[members].max())
            entries.append((self.bank.families[f], refined, float(families[f]) + value - top))
        return Ranking(tuple(sorted(entries, key=lambda e: -e[2])))

    def _basins(self, members: Ints, evidence: Floats) -> list[int]:
        """The best members of a family that lie in different basins of its shape; the first where it has none.

        `members` come in the order of their evidence. A grid of shapes is coarse: its best point need not lie in the
        basin of the best shape.
        """
        chosen: list[int] = [int(members[0])]
        if not type(self.bank.hypotheses[chosen[0]].effect).shape:
            return chosen
        for i in members[1:]:
            if len(chosen) == MOST_BASINS or evidence[i] < evidence[chosen[0]] - BASIN_DEPTH:
                break
            if all(self._apart(int(i), j) for j in chosen):
                chosen.append(int(i))
        return chosen

    def _apart(self, i: int, j: int) -> bool:
        """Whether two members differ in place, or in a shape constant by more than its refinement reaches."""
        one, other = self.bank.hypotheses[i].effect, self.bank.hypotheses[j].effect
        if (one.stations, one.targets) != (other.stations, other.targets):
            return True
        for shape in type(one).shape:
            low, high = shape.bracket(float(vars(other)[shape.name]))
            if not low <= float(vars(one)[shape.name]) <= high:
                return True
        return False

    def _drop(self, hypothesis: Hypothesis, base: EffectSet) -> tuple[float, int]:
        signature = self.space.signature(hypothesis.effect)
        left = self.space.project(signature)
        left -= base.extension @ (base.extension.T @ left)
        columns = orthonormal(left, signature)
        return float(((columns.T @ base.residual) ** 2).sum()), columns.shape[1]

    def _refined(self, hypothesis: Hypothesis, base: EffectSet, evidence: float) -> tuple[Hypothesis, float]:
        """The hypothesis with its continuous shape moved to the optimum, and the gain in log evidence."""
        best, value = self._nearby(hypothesis, base, evidence)
        if isinstance(best.effect, FlexibleTerm):
            return self._grown(best, base, evidence, value)
        moves = type(hypothesis.effect).ways if value > evidence else 0
        for shape in type(hypothesis.effect).shape:
            now = getattr(best.effect, shape.name)
            if not isinstance(now, float) or shape.steps < 2:
                continue
            bounds = shape.bracket(now)

            def lost(x: float, name: str = shape.name, start: Hypothesis = best) -> float:
                moved = replace(start, effect=start.effect.reshaped(**{name: float(x)}))
                return -self._evidence(moved, base)

            found = minimize_scalar(lost, bounds=bounds, method="bounded", options={"maxiter": 12})
            if -found.fun > value:
                best = replace(best, effect=best.effect.reshaped(**{shape.name: float(found.x)}))
                value, moves = -float(found.fun), moves + 1
        gain = value - evidence
        return replace(best, tuning=0.5 * moves * float(np.log1p(2.0 * gain / max(moves, 1)))), gain

    def _nearby(self, hypothesis: Hypothesis, base: EffectSet, evidence: float) -> tuple[Hypothesis, float]:
        """Uphill over what an effect offers near itself (`Effect.finer`) until nothing there is better."""
        best, value = hypothesis, evidence
        for _ in range(MOST_STEPS):
            before = value
            for effect in best.effect.finer(self.space.sightings):
                near = replace(hypothesis, effect=effect)
                found = self._evidence(near, base)
                if found > value:
                    best, value = near, found
            if value <= before:
                break
        return best, value

    def _grown(
        self, hypothesis: Hypothesis, base: EffectSet, evidence: float, value: float
    ) -> tuple[Hypothesis, float]:
        """A flexible term made richer while that gains more than the choice among its ways costs."""
        best, tuning = hypothesis, 0.5 * float(np.log1p(2.0 * (value - evidence)))
        for _ in range(MOST_GROWTHS):
            effect = best.effect
            assert isinstance(effect, FlexibleTerm)
            richer = [replace(best, effect=e) for e in effect.grown(self.space.sightings)]
            if not richer:
                break
            found = [self._evidence(h, base) for h in richer]
            top, cost = int(np.argmax(found)), float(np.log(len(richer)))
            if found[top] <= value + cost + 1.0:
                break
            best, value, tuning = richer[top], found[top], tuning + cost
            nearby, higher = self._nearby(best, base, value)
            best, value, tuning = nearby, higher, tuning + 0.5 * float(np.log1p(2.0 * (higher - value)))
        return replace(best, tuning=tuning), value - evidence

    def _evidence(self, hypothesis: Hypothesis, base: EffectSet) -> float:
        drop, rank = self._drop(hypothesis, base)
        return float(log_evidence(np.array([drop]), np.array([rank]))[0])

    def change_time(self, hypothesis: Hypothesis, base: EffectSet) -> tuple[float, float] | None:
        """When a sudden change happened and its standard deviation [s], from the evidence of all gaps around it.

        None for effects that do not change suddenly. Within a gap between two pointings any time is as good.
        """
        effects = hypothesis.effect.finer(self.space.sightings)
        if not effects or "time" not in vars(hypothesis.effect):
            return None
        times = np.array([float(vars(effect)["time"]) for effect in effects])
        drops = np.array([self._drop(replace(hypothesis, effect=effect), base)[0] for effect in effects])
        weight = np.exp(0.5 * (drops - drops.max()))
        weight /= weight.sum()
        mean = float(weight @ times)
        gap = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        return mean, float(np.sqrt(weight @ (times - mean) ** 2 + gap**2 / 12.0))

    def shape_posterior(
        self, hypothesis: Hypothesis, base: EffectSet, spread: Mapping[str, float]
    ) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation [SI] of parameters and shape constants over all shapes and near places.

        Shapes on a grid, finer around the estimate (`spread`: standard deviations there), are weighed by their
        likelihood and the room they stand for, neighbours in place (`Effect.finer`) all alike; each brings the
        uncertainty it leaves the parameters. Unlike a curvature at the optimum this holds where a likelihood is flat,
        skew, cut off by bounds, or has two tops. Empty for effects without such constants.
        """
        effect = hypothesis.effect
        shapes = [s for s in type(effect).shape if isinstance(vars(effect)[s.name], float) and s.steps > 1]
        near = effect.finer(self.space.sightings) if hypothesis.known else []
        if not (shapes or near) or len(shapes) > 2:
            return {}
        count = 33 if len(shapes) == 1 and not near else 15
        axes = [_fine(s, float(vars(effect)[s.name]), spread.get(s.name, 0.0), count) for s in shapes]
        prior = np.diag([(LARGEST * p.prior_sigma) ** -2 for p in effect.parameters])
        means, seconds, logs = [], [], []
        for one, *point in product([effect, *near], *(zip(*axis, strict=True) for axis in axes)):
            constants = np.array([value for value, _ in point])
            named = {s.name: float(c) for s, c in zip(shapes, constants, strict=True)}
            left = self.space.project(self.space.signature(one.reshaped(**named)))
            left -= base.extension @ (base.extension.T @ left)
            inverse = np.linalg.inv(left.T @ left + prior)
            score = left.T @ base.residual
            found = inverse @ score
            room = float(np.sum(np.log([width for _, width in point])))
            logs.append(0.5 * float(found @ score) + room)
            means.append(np.concatenate([found, constants]))
            seconds.append(np.concatenate([np.diag(inverse) + found**2, constants**2]))
        weight = np.exp(np.array(logs) - max(logs))
        weight /= weight.sum()
        mean = weight @ np.array(means)
        deviation = np.sqrt(np.maximum(weight @ np.array(seconds) - mean**2, 0.0))
        names = [p.name for p in effect.parameters] + [s.name for s in shapes]
        return {n: (float(m), float(d)) for n, m, d in zip(names, mean, deviation, strict=True)}

    def _plausibility(self, hypothesis: Hypothesis, base: EffectSet) -> float:
        """Log weight of the parameters it would have beside a set."""
        if not hypothesis.known:
            return 0.0
        signature = self.space.signature(hypothesis.effect)
        left = self.space.project(signature)
        left -= base.extension @ (base.extension.T @ left)
        return plausibility(hypothesis.effect.parameters, estimates(left, signature, base.residual))

    def with_members(self, hypotheses: Sequence[Hypothesis]) -> EffectSet:
        """The set of some hypotheses, scored."""
        members = []
        for h in hypotheses:
            f = self.bank.families.index(h.family)
            members.append(
                Member(h, self.space.signature(h.effect), float(np.log(self._size[f]) - self.prior[f]) + h.tuning)
            )
        if not members:
            return self.empty
        whole = np.hstack([m.signature for m in members])
        extension = orthonormal(self.space.project(whole), whole)
        fitted = extension.T @ self.space.residual
        residual = self.space.residual - extension @ fitted
        drop = float((fitted**2).sum())
        score = float(log_evidence(np.array([drop]), np.array([extension.shape[1]]))[0])
        score -= sum(m.cost for m in members)
        made = EffectSet(tuple(members), extension, residual, score)
        return replace(made, score=score + self._set_plausibility(made))

    def worth(self, member: Member, drop: float) -> float:
        """Log evidence that a member brings to a set when chi2 drops by so much for it, its cost taken off."""
        rank = np.array([member.signature.shape[1]])
        return float(log_evidence(np.array([drop]), rank)[0]) - member.cost

    def _set_plausibility(self, made: EffectSet) -> float:
        whole = np.hstack([m.signature for m in made.members])
        values = estimates(self.space.project(whole), whole, self.space.residual)
        total, at = 0.0, 0
        for member in made.members:
            q = member.signature.shape[1]
            if member.hypothesis.known:
                total += plausibility(member.hypothesis.effect.parameters, values[at : at + q])
            at += q
        return total

    def search(self, threshold: float, *, something: bool) -> EffectSet:
        """Find the best set.

        A member is added only where it raises the score by more than `threshold` and does not raise the error on
        readings that the fit did not see; but where the caller knows that
        `something` is missing, the first member is the best there is.
        """
        beam = [self.empty]
        best = self.empty
        for depth in range(MOST_MEMBERS):
            grown: dict[tuple[str, ...], EffectSet] = {}
            for base in beam:
                for _, hypothesis, _ in self.rank(base).entries[:BEAM]:
                    made = self.with_members((*base.hypotheses, hypothesis))
                    key = tuple(sorted(repr(h.effect) for h in made.hypotheses))
                    if key not in grown:
                        grown[key] = made
            beam = sorted(grown.values(), key=lambda s: -s.score)[:BEAM]
            beam[0] = self.reexamined(beam[0])
            earned = beam[0].score >= best.score + threshold and self._held_out(beam[0]) <= self._held_out(best)
            if (depth or not something) and not earned:
                break
            best = beam[0]
        return best

    def _held_out(self, found: EffectSet) -> float:
        """Normalised error on held-out station-target pairs with the members of a set estimated."""
        space = self.space
        if found.members:
            space = space.extended(np.hstack([m.signature for m in found.members]))
        return held_out_rms(space, pair_folds(space))

    def reexamined(self, found: EffectSet) -> EffectSet:
        """Each member replaced by what fits better beside the others, until nothing changes."""
        if len(found.members) < 2:
            return found
        for _ in range(3):
            before = found.score
            for i in range(len(found.members)):
                others = found.hypotheses[:i] + found.hypotheses[i + 1 :]
                base = self.with_members(others)
                for _, hypothesis, _ in self.rank(base, 4).entries[:2]:
                    made = self.with_members((*others, hypothesis))
                    if made.score > found.score + 1e-6:
                        found = made
            if found.score <= before + 1e-6:
                break
        return found
