"""From a recording to a verdict: detect, locate, name, model, show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ltsim.adjust import Adjustment, adjust
from ltsim.adjust.residual_space import ResidualSpace
from ltsim.arrays import Bools, Floats
from ltsim.diagnose.bank import Bank, Hypothesis
from ltsim.diagnose.blind import sight_of
from ltsim.diagnose.detect import Detection, detect, noise_prior
from ltsim.diagnose.diagnosis import Diagnosis, Estimate, Finding, Fit
from ltsim.diagnose.evidence import carried_by
from ltsim.diagnose.findings import doubted, equivalents_of, gross_finding, mean_finding, noise_finding
from ltsim.diagnose.gross import GrossFinding, explain_gross
from ltsim.diagnose.held_out import (
    held_out_rms,
    pair_folds,
    pointing_folds,
    station_target_folds,
)
from ltsim.diagnose.noise import NoiseBank, NoiseHypothesis, pattern_hypotheses, remeasured
from ltsim.diagnose.refit import Refit, refit
from ltsim.diagnose.search import EffectSet, Searcher
from ltsim.diagnose.separate import separating_measurement
from ltsim.diagnose.stations import mend_faces, mend_stations
from ltsim.diagnose.terms import flexible_hypotheses
from ltsim.diagnose.words import summarise, without_clock
from ltsim.effects import BASELINE, CATALOGUE
from ltsim.effects.effect import NoiseEffect
from ltsim.effects.signature import Tunable
from ltsim.model.construction import Construction, stated_construction
from ltsim.model.measurement import State, sightings_of
from ltsim.recording.recording import Recording
from ltsim.scene.sightings import Sightings
from ltsim.solve.threads import in_one_thread
from ltsim.units import FACTOR

MOST_ROUNDS = 3
REWEIGHTINGS = 2
NEXT_LEVEL = 0.01
"""Chance that a further finding is added to a recording that holds no more than those found."""


def catalogue_hypotheses(sightings: Sightings) -> list[Hypothesis]:
    """Every effect of the catalogue beyond the ordinary calibration, at every place and shape."""
    ordinary = {type(effect) for effect in BASELINE}
    return [
        Hypothesis(kind.name, effect)
        for kind in CATALOGUE
        if kind not in ordinary and not issubclass(kind, NoiseEffect)
        for effect in kind.candidates(sightings)
    ]


def noise_hypotheses(sightings: Sightings) -> list[NoiseHypothesis]:
    """Every change of the noise that is tried, with a grid of sizes."""
    known = [
        NoiseHypothesis(kind.name, effect, values)
        for kind in CATALOGUE
        if issubclass(kind, NoiseEffect)
        for effect in kind.candidates(sightings)
        for values in effect.size_grid()
    ]
    return [*known, *pattern_hypotheses(sightings)]


@dataclass
class _Case:
    """The recording under examination and what is known of it so far."""

    recording: Recording
    construction: Construction
    use: Bools
    sigma: Floats
    start: State
    noise: list[NoiseHypothesis]

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


@in_one_thread
def diagnose(recording: Recording, *, seed: int = 0, level: float = 0.05) -> Diagnosis:
    """Diagnose a recording.

    Parameters
    ----------
    recording : Recording
    seed : int
        Root seed of the simulated null distribution.
    level : float
        False-alarm rate of the whole search.

    Returns
    -------
    Diagnosis
        Verdict, findings in the order of their strength, fit before and after, what cannot be seen.
    """
    construction = stated_construction(recording)
    converted, wrong = mend_stations(recording)
    faced, confused = mend_faces(converted)
    first = adjust(faced, construction)
    mended, use, gross = explain_gross(first)
    gross = [*wrong, *confused, *gross]
    case = _Case(mended, construction, use, mended.sigma(), first.state, [])
    baseline = case.adjustment() if gross else first
    case.start = baseline.state
    space, searcher, noise = _prepare(baseline)
    detection = detect(searcher, noise, seed)
    found, mismatch = searcher.empty, detection.p_value < level
    if mismatch:
        found, searcher = _explain(case, searcher, noise, detection)
    return _assemble(case, baseline, space, searcher, detection, found, gross, mismatch)


def _prepare(adjustment: Adjustment) -> tuple[ResidualSpace, Searcher, NoiseBank]:
    space = ResidualSpace.of(adjustment)
    hypotheses = [
        *catalogue_hypotheses(space.sightings),
        *flexible_hypotheses(space.sightings),
    ]
    return (
        space,
        Searcher(space, Bank.of(space, hypotheses)),
        NoiseBank.of(space, noise_hypotheses(space.sightings)),
    )


def _explain(case: _Case, searcher: Searcher, noise: NoiseBank, detection: Detection) -> tuple[EffectSet, Searcher]:
    """Mean shifts and changes of the noise in turn, whichever explains more first."""
    threshold = max(detection.threshold(1.0 - NEXT_LEVEL), 2.0)
    found = searcher.search(threshold, something=True)
    for _ in range(MOST_ROUNDS):
        prior = noise_prior(noise)
        alone = noise.log_likelihood_ratio(searcher.space.residual)
        beside = noise.log_likelihood_ratio(found.residual)
        alone_best = float(np.max(noise.family_evidence(alone) + prior, initial=-np.inf))
        beside_best = float(np.max(noise.family_evidence(beside) + prior, initial=-np.inf))
        noise_first = alone_best > found.score
        if max(alone_best if noise_first else -np.inf, beside_best) < threshold and (case.noise or not noise_first):
            break
        ratio = alone if noise_first else beside
        residual = searcher.space.residual if noise_first else found.residual
        hypothesis = noise.best(searcher.space, ratio, prior, residual)
        case.noise = _joined(case.noise, hypothesis)
        case.sigma = case.weighted(case.noise)
        _, searcher, noise = _prepare(_reweighted(case, () if noise_first else found.hypotheses))
        found = searcher.search(threshold, something=False)
    return found, searcher


def _joined(known: Sequence[NoiseHypothesis], further: NoiseHypothesis) -> list[NoiseHypothesis]:
    """Noise found so far with a further change of it; one of the same kind at the same place is made larger."""
    for i, one in enumerate(known):
        if one.effect == further.effect:
            more = tuple(a + b for a, b in zip(one.values, further.values, strict=True))
            merged = replace(one, values=more, drop=one.drop + further.drop)
            return [*known[:i], merged, *known[i + 1 :]]
    return [*known, further]


def _reweighted(case: _Case, beside: Sequence[Hypothesis]) -> Adjustment:
    """Adjust with the noise found until its sizes settle, mean effects `beside` it taken out; updates the case."""
    for _ in range(REWEIGHTINGS):
        space = ResidualSpace.of(case.adjustment())
        if beside:
            space = space.extended(np.hstack([space.signature(h.effect) for h in beside]))
        for i, one in enumerate(case.noise):
            stated = case.weighted([*case.noise[:i], *case.noise[i + 1 :]])
            case.noise[i] = remeasured(space, stated, one)
        case.sigma = case.weighted(case.noise)
    return case.adjustment()


def _with_effects(case: _Case, effects: Sequence[Tunable], sigma: Floats) -> Refit:
    """The exact refit with some effects; the plain adjustment without any."""
    if effects:
        return refit(case.recording, case.construction, list(effects), start=case.start, sigma=sigma, use=case.use)
    plain = adjust(case.recording, case.construction, sigma=sigma, use=case.use, start=case.start)
    return Refit(plain, (), ())


def _refitted(
    case: _Case, baseline: Adjustment, searcher: Searcher, detection: Detection, found: EffectSet
) -> tuple[EffectSet, Refit]:
    """The exact refit with what was found, without members that it does not need.

    The search works in first order: what a large effect leaves to second order can look like another one beside it.
    """

    def fit(members: Sequence[Hypothesis]) -> Refit:
        if not members and not case.noise:
            return Refit(baseline, (), ())
        return _with_effects(case, [h.effect for h in members], case.sigma)

    fitted = fit(found.hypotheses)
    threshold = detection.threshold(1.0 - NEXT_LEVEL)
    while len(found.members) > 1:
        rest = [found.hypotheses[:i] + found.hypotheses[i + 1 :] for i in range(len(found.members))]
        without = [fit(members) for members in rest]
        gains = [
            searcher.worth(m, one.adjustment.chi2 - fitted.adjustment.chi2)
            for m, one in zip(found.members, without, strict=True)
        ]
        least = int(np.argmin(gains))
        if gains[least] >= threshold:
            break
        found, fitted = searcher.with_members(rest[least]), without[least]
    return found, fitted


def _change(searcher: Searcher, hypothesis: Hypothesis, others: EffectSet) -> tuple[Estimate, ...]:
    """The time of a sudden change as an estimate."""
    found = searcher.change_time(hypothesis, others)
    return () if found is None else (Estimate("time", found[0], found[1], "s"),)


WIDER = 1.15
"""Where shapes leave a parameter so many times less certain than the curvature at the optimum, a posterior is told."""


def _widened(
    searcher: Searcher, hypothesis: Hypothesis, others: EffectSet, fitted: Refit, member: int
) -> list[Estimate]:
    """Estimates of a refit; where the shape leaves them less certain, mean and deviation over all shapes."""
    factors = {p.name: p.factor for p in hypothesis.effect.parameters}
    factors |= {s.name: FACTOR[s.unit] for s in type(hypothesis.effect).shape}
    told = fitted.estimates[member]
    spread = {e.name: e.sigma * factors.get(e.name, 1.0) for e in told}
    posterior = searcher.shape_posterior(hypothesis, others, spread)
    if not any(posterior.get(name, (0.0, 0.0))[1] > WIDER * sigma for name, sigma in spread.items()):
        return list(told)
    return [
        replace(e, value=posterior[e.name][0] / factors[e.name], sigma=posterior[e.name][1] / factors[e.name])
        if e.name in posterior
        else e
        for e in told
    ]


def _fit(adjustment: Adjustment, dof: int, predicting: Adjustment | None = None) -> Fit:
    """Chi2 and held-out error; the latter of another adjustment where one is given."""
    space = ResidualSpace.of(predicting or adjustment)
    held_out = {
        "pointings": held_out_rms(space, pointing_folds(space)),
        "station-target pairs": held_out_rms(space, pair_folds(space)),
        "a quarter of a station's targets": held_out_rms(space, station_target_folds(space)),
    }
    return Fit(adjustment.chi2, dof, held_out["station-target pairs"], held_out)


def _in_stated_noise(case: _Case, fitted: Refit) -> Adjustment:
    """A refit with noise no quieter than stated: errors are told in the stated noise, or in what was found above it."""
    stated = case.recording.sigma()
    if not (case.sigma < stated).any():
        return fitted.adjustment
    return _with_effects(case, fitted.effects, np.maximum(case.sigma, stated)).adjustment


def _assemble(
    case: _Case,
    baseline: Adjustment,
    space: ResidualSpace,
    searcher: Searcher,
    detection: Detection,
    found: EffectSet,
    gross: Sequence[GrossFinding],
    mismatch: bool,
) -> Diagnosis:
    """Refit with what was found and put the verdict together."""
    found, fitted = _refitted(case, baseline, searcher, detection, found)
    clock: Callable[[Estimate], Estimate] = (lambda e: e) if case.recording.has_clock else without_clock
    findings = [gross_finding(g, baseline) for g in gross]
    explained: list[tuple[Finding, tuple[str, ...]]] = []
    for i, member in enumerate(found.members):
        effect = fitted.effects[i]
        others = searcher.with_members(found.hypotheses[:i] + found.hypotheses[i + 1 :])
        ranking = searcher.rank(others)
        name = member.hypothesis.effect.name
        rivals = [rival for rival, _ in equivalents_of(ranking, name)[1]]
        beside = [e for k, e in enumerate(fitted.effects) if k != i]
        advice = separating_measurement(baseline, name, rivals, beside) if member.hypothesis.known else ""
        told = [
            *_widened(searcher, replace(member.hypothesis, effect=effect), others, fitted, i),
            *_change(searcher, member.hypothesis, others),
        ]
        finding = mean_finding(
            replace(member.hypothesis, effect=effect),
            [clock(e) for e in told],
            others,
            found,
            ranking,
            detection,
            advice,
        )
        gain = (others.residual**2 - found.residual**2)[: int(searcher.space.use.sum())]
        explained.append((finding, carried_by(searcher.space.use, gain)))
    findings += doubted(explained)
    findings += [noise_finding(h, detection) for h in case.noise]
    findings.sort(key=lambda f: -f.evidence.chi2_drop)
    spent = found.extension.shape[1]
    before = _fit(baseline, baseline.dof)
    after = before
    if found.members or case.noise:
        after = _fit(fitted.adjustment, baseline.dof - spent, _in_stated_noise(case, fitted))
    verdict = "mismatch" if mismatch or gross else "consistent"
    detectable, undetectable = sight_of(space, (h.effect for h in searcher.bank.hypotheses))
    return Diagnosis(
        verdict=verdict,
        summary=summarise(verdict, findings, detection.p_value, before, after),
        statistic=baseline.chi2,
        dof=baseline.dof,
        p_value=detection.chi2_p_value,
        search_p_value=detection.p_value,
        findings=tuple(findings),
        before=before,
        after=after,
        undetectable=undetectable,
        detectable=detectable,
        baseline=baseline,
        adjusted=fitted.adjustment,
    )


__all__ = ["catalogue_hypotheses", "diagnose", "noise_hypotheses"]
