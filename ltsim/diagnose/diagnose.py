"""From a recording to a verdict: detect, locate, name, model, show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ltsim.adjust import Adjustment, adjust
from ltsim.adjust.gross import GrossFinding, explain_gross
from ltsim.adjust.mixed_up import mend_faces, mend_stations
from ltsim.adjust.residual_space import ResidualSpace
from ltsim.arrays import Bools, Floats
from ltsim.calibrate.known import Known
from ltsim.diagnose.averaging import averaged_targets
from ltsim.diagnose.blind import Sight, sight_of
from ltsim.diagnose.detect import Detection, detect
from ltsim.diagnose.diagnosis import Diagnosis
from ltsim.diagnose.findings import equivalents, gross_finding, instrument_finding, mean_finding, noise_finding
from ltsim.diagnose.held_out import held_out_rms, pair_folds
from ltsim.diagnose.history import History
from ltsim.diagnose.instruments import contradictions, instrument_entries
from ltsim.diagnose.noise import NoiseBank, NoiseHypothesis, most_likely, noise_hypotheses
from ltsim.diagnose.refit import Refit, refit
from ltsim.diagnose.schema import Finding, Fit
from ltsim.diagnose.search import Searcher
from ltsim.diagnose.separate import separating_measurement
from ltsim.diagnose.sets import Found, Hypothesis, Ranking
from ltsim.diagnose.words import summarise
from ltsim.effects.effect import Effect
from ltsim.model.construction import Construction, stated_construction
from ltsim.model.measurement import State, sightings_of
from ltsim.recording.recording import Recording
from ltsim.scene.sightings import Sightings
from ltsim.solve.threads import in_one_thread

MOST_ROUNDS = 3
REWEIGHTINGS = 2
NEXT_LEVEL = 0.01
"""Chance that a further finding is added to a recording that holds no more than those found."""
ABSORBED = 10.0
"""How much less than in the readings it is known what an unknown law does to the constants, which absorb most of it."""
LEAST_GAIN = 2.0
"""Log evidence of a further finding: odds of 7 to 1 that there is one."""


@dataclass
class _Case:
    """The recording under examination and what is known of it so far."""

    recording: Recording
    construction: Construction
    use: Bools
    sigma: Floats
    start: State
    seed: int
    noise: list[NoiseHypothesis]
    searcher: Searcher = field(init=False)
    bank: NoiseBank = field(init=False)

    @property
    def sightings(self) -> Sightings:
        """Geometry of the pointings at the first adjustment."""
        return sightings_of(self.recording, self.start)

    def weighted(self, noise: Sequence[NoiseHypothesis]) -> Floats:
        """Standard deviations (n, 3) with some changes of the noise."""
        sigma = self.recording.sigma()
        for one in noise:
            sigma = np.sqrt(one.effect.variance(self.sightings, sigma, np.array(one.values)))
        return sigma

    def adjustment(self) -> Adjustment:
        return adjust(self.recording, self.construction, sigma=self.sigma, use=self.use, start=self.start)

    def search(self, adjustment: Adjustment) -> None:
        """Score everything beside an adjustment; what was scored before is let go."""
        space, cards = ResidualSpace.of(adjustment), None
        if hasattr(self, "searcher"):
            cards = self.searcher.cards.reweighted(self.searcher.space, space)
            del self.searcher
        self.searcher = Searcher(space, self.seed, cards=cards)
        self.bank = NoiseBank.of(space, noise_hypotheses(space.sightings))


@in_one_thread
def diagnose(recording: Recording, *, seed: int = 0, level: float = 0.05, history: Known | None = None) -> Diagnosis:
    """Diagnose a recording.

    Parameters
    ----------
    recording : Recording
    seed : int
        Root seed of the simulated null distribution.
    level : float
        False-alarm rate of the whole search.
    history : Known, optional
        Earlier calibrations that each constant of the instruments is compared with.

    Returns
    -------
    Diagnosis
        Verdict, findings in the order of their strength, fit before and after, what cannot be seen.

    Raises
    ------
    RecordError
        When the history is of other instruments or another construction.
    """
    construction = stated_construction(recording)
    earlier = None if history is None else History.of(history, recording, construction)
    converted, wrong = mend_stations(recording)
    faced, confused = mend_faces(converted)
    first = adjust(faced, construction)
    mended, use, gross = explain_gross(first)
    gross = [*wrong, *confused, *gross]
    use = use & first.problem.use if not gross else use
    case = _Case(mended, construction, use, mended.sigma(), first.state, seed, [])
    baseline = case.adjustment() if gross else first
    case.start = baseline.state
    case.search(baseline)
    sight, detection = sight_of(case.searcher.space, case.searcher.cards), detect(case.searcher, case.bank)
    mismatch = detection.p_value < level
    found = _explain(case, detection) if mismatch else case.searcher.empty
    return _Report(case, baseline, sight, detection, found, tuple(gross), mismatch, earlier).diagnosis()


def _explain(case: _Case, detection: Detection) -> Found:
    """Mean shifts, and changes of the noise beside them, or in place of one or all, until nothing gains."""
    threshold = max(detection.threshold(NEXT_LEVEL), LEAST_GAIN)
    found = case.searcher.search(threshold, something=True)
    for _ in range(MOST_ROUNDS):
        searcher, members = case.searcher, found.members
        kept = [found, *(searcher.without(found, i) for i in range(len(members)))]
        kept += [searcher.empty] if len(members) > 1 else []
        spaces = [_beside(searcher.space, one.members) for one in kept]
        ranked = [case.bank.best(s.residual, s.redundancy) for s in spaces]
        least = threshold + found.misfit
        rest = [min(searcher.rank(found).total, least), *(searcher.rank(one).total for one in kept[1:])]
        lost = [0.0, *rest[1 : len(members) + 1], *(found.score - one.score for one in kept[len(members) + 1 :])]
        gains = [noise[0][0] - less for noise, less in zip(ranked, lost, strict=True)]
        most = int(np.argmax(gains))
        if gains[most] < (least if not most and (case.noise or members) else 0.0):
            break
        likeliest = _with_probability(ranked[most], rest[most])
        case.noise = _joined(case.noise, most_likely(spaces[most], searcher.space.sigma, likeliest))
        case.sigma = case.weighted(case.noise)
        case.search(_reweighted(case, kept[most].members))
        found = case.searcher.search(threshold, something=False)
    return found


def _with_probability(ranked: Sequence[tuple[float, NoiseHypothesis]], rest: float) -> NoiseHypothesis:
    """The first change of the noise, with its probability among all of them and what else was tried."""
    logs = np.array([0.0, rest, *(value for value, _ in ranked)])
    weight = np.exp(logs - logs.max())
    weight /= weight.sum()
    best = ranked[0][1]
    total: dict[str, float] = {}
    for (_, one), w in zip(ranked, weight[2:], strict=True):
        total[one.effect.name] = total.get(one.effect.name, 0.0) + float(w)
    probability = total.pop(best.effect.name)
    return replace(best, probability=probability, equivalents=equivalents(total))


def _joined(known: Sequence[NoiseHypothesis], further: NoiseHypothesis) -> list[NoiseHypothesis]:
    """Noise found so far with a further change of it; one of the same kind at the same place is made larger."""
    for i, one in enumerate(known):
        if one.effect == further.effect:
            more = tuple(a + b for a, b in zip(one.values, further.values, strict=True))
            merged = replace(one, values=more, drop=one.drop + further.drop)
            return [*known[:i], merged, *known[i + 1 :]]
    return [*known, further]


def _reweighted(case: _Case, beside: Sequence[Hypothesis]) -> Adjustment:
    """Adjust with the noise found until its sizes settle, mean effects `beside` it taken out; updates the case.

    This ends at the restricted maximum likelihood (Foerstner 1979).
    """
    for _ in range(REWEIGHTINGS):
        space = _beside(ResidualSpace.of(case.adjustment()), beside)
        for i, one in enumerate(case.noise):
            stated = case.weighted([*case.noise[:i], *case.noise[i + 1 :]])
            case.noise[i] = replace(most_likely(space, stated, one), drop=one.drop)
        case.sigma = case.weighted(case.noise)
    return case.adjustment()


def _beside(space: ResidualSpace, members: Sequence[Hypothesis]) -> ResidualSpace:
    """The space in which some effects are estimated too."""
    return space.extended(np.hstack([space.signature(h.effect) for h in members])) if members else space


@dataclass
class _Report:
    """Everything that a diagnosis is told from."""

    case: _Case
    baseline: Adjustment
    sight: Sight
    detection: Detection
    found: Found
    gross: tuple[GrossFinding, ...]
    mismatch: bool
    history: History | None

    def diagnosis(self) -> Diagnosis:
        """Refit with what was found and put the verdict together."""
        found, fitted = self._refitted()
        self.found = found
        findings = [gross_finding(g, self.baseline) for g in self.gross]
        rankings = [self._ranking(i) for i in range(len(found.members))]
        findings += [self._finding(i, ranking, fitted) for i, ranking in enumerate(rankings)]
        findings += [noise_finding(h, self.detection) for h in self.case.noise]
        settled = fitted.adjustment if fitted.adjustment.solution.converged else self.baseline
        told = self.history.contradictions if self.history else contradictions
        odd = told(settled, LEAST_GAIN + ABSORBED * found.misfit)
        findings += [instrument_finding(c) for c in odd]
        findings.sort(key=lambda f: -f.evidence.chi2_drop)
        before = _fit(self.baseline, self.baseline.dof)
        after = before
        if found.members or self.case.noise:
            dof = self.baseline.dof - found.extension.shape[1]
            after = _fit(fitted.adjustment, dof, self._in_stated_noise(fitted))
        verdict = "mismatch" if self.mismatch or self.gross or odd else "consistent"
        detectable, undetectable = self.sight
        targets = averaged_targets(self.case.searcher, found, rankings, fitted)
        return Diagnosis(
            verdict=verdict,
            summary=summarise(verdict, findings, self.detection.p_value, before, after),
            statistic=self.baseline.chi2,
            dof=self.baseline.dof,
            p_value=self.detection.chi2_p_value,
            search_p_value=self.detection.p_value,
            findings=tuple(findings),
            before=before,
            after=after,
            undetectable=undetectable,
            detectable=detectable,
            instruments=instrument_entries(settled),
            targets=targets,
            baseline=self.baseline,
            adjusted=fitted.adjustment,
        )

    def _with_effects(self, found: Found, sigma: Floats) -> Refit:
        """The exact refit with a set; the plain adjustment without any."""
        case = self.case
        if not found.members:
            if not case.noise:
                return Refit(self.baseline, (), ())
            plain = adjust(case.recording, case.construction, sigma=sigma, use=case.use, start=case.start)
            return Refit(plain, (), ())
        effects = [h.effect for h in found.members]
        return refit(case.recording, case.construction, effects, start=case.start, sigma=sigma, use=case.use)

    def _refitted(self) -> tuple[Found, Refit]:
        """The exact refit with what was found, without members that it does not need.

        The search works in first order: what a large effect leaves to second order can look like another one beside it.
        """
        found = self.found
        fitted = self._with_effects(found, self.case.sigma)
        while len(found.members) > 1:
            rest = [self.case.searcher.without(found, i) for i in range(len(found.members))]
            without = [self._with_effects(one, self.case.sigma) for one in rest]
            gains = [
                0.5 * (one.adjustment.chi2 - fitted.adjustment.chi2) + h.log_prior
                for h, one in zip(found.members, without, strict=True)
            ]
            least = int(np.argmin(gains))
            if gains[least] >= 0.0:
                break
            found, fitted = rest[least], without[least]
        return found, fitted

    def _ranking(self, member: int) -> Ranking:
        """Everything that could stand in a member's place, changes of the noise among it."""
        searcher, bank = self.case.searcher, self.case.bank
        others = searcher.without(self.found, member)
        redundancy = searcher.space.redundancy - np.sum(others.extension**2, axis=1)
        logs = bank.family_evidence(others.residual[:, None], redundancy)[:, 0]
        rivals = [
            Hypothesis(bank.hypotheses[int(np.argmax(bank.family == f))].effect, 0.0, float(v), n.partition(":")[0])
            for f, (n, v) in enumerate(zip(bank.families, logs, strict=True))
        ]
        return searcher.rank(others).beside(rivals)

    def _finding(self, member: int, ranking: Ranking, fitted: Refit) -> Finding:
        hypothesis = replace(self.found.members[member], effect=fitted.effects[member])
        others = self.case.searcher.without(self.found, member)
        rivals = [other.effect for other in equivalents(ranking.probabilities(), hypothesis.name)]
        beside = [e for k, e in enumerate(fitted.effects) if k != member]
        named = isinstance(hypothesis.effect, Effect)
        advice = separating_measurement(self.baseline, hypothesis.name, rivals, beside) if named else ""
        told = self.case.searcher.estimates(hypothesis, others, fitted.estimates[member])
        return mean_finding(
            hypothesis, told, others, self.found, ranking, self.detection, self.case.searcher, advice,
            clock=self.case.recording.has_clock,
        )  # fmt: skip

    def _in_stated_noise(self, fitted: Refit) -> Adjustment:
        """A refit with noise no quieter than stated: errors are told in that, or in what was found above it."""
        stated = self.case.recording.sigma()
        if not (self.case.sigma < stated).any():
            return fitted.adjustment
        return self._with_effects(self.found, np.maximum(self.case.sigma, stated)).adjustment


def _fit(adjustment: Adjustment, dof: int, predicting: Adjustment | None = None) -> Fit:
    """Chi2 and held-out error; the latter of another adjustment where one is given."""
    space = ResidualSpace.of(predicting or adjustment)
    return Fit(chi2=adjustment.chi2, dof=dof, held_out_rms=held_out_rms(space, pair_folds(space)))


__all__ = ["diagnose"]
