"""From a recording to a verdict: detect, locate, name, model, show."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import ceil

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.identification import Selection, identified, outcomes
from ltsim.adjustment.refit import Refit
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.singular import refusing_singular
from ltsim.calibration.evidence import log_sum_exp
from ltsim.calibration.known import Known
from ltsim.core.errors import RecordError
from ltsim.diagnosis.adaptation import adapted
from ltsim.diagnosis.averaging import averaged_targets
from ltsim.diagnosis.blind import Sight, sight_of
from ltsim.diagnosis.case import Case
from ltsim.diagnosis.certain import instrument_finding
from ltsim.diagnosis.detect import detect
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.diagnosis.evidence import restricted
from ltsim.diagnosis.findings import Explained, among, noise_finding
from ltsim.diagnosis.held_out import HeldOut, held_out as left_out
from ltsim.diagnosis.history import HistoryExpectation
from ltsim.diagnosis.hypotheses import Found, likeliest
from ltsim.diagnosis.instruments import Contradiction, contradictions, instrument_entries
from ltsim.diagnosis.noise import NoiseHypothesis, most_likely
from ltsim.diagnosis.probe import TRIALS
from ltsim.diagnosis.schema import Finding, Misfit
from ltsim.diagnosis.search import MOST_MEMBERS
from ltsim.diagnosis.words import LIKELY, summarise
from ltsim.physics.effects.noise_level import NoiseLevel
from ltsim.physics.effects.signature import Tunable
from ltsim.physics.laws.law import Law
from ltsim.physics.laws.responses import VARIED, constants_in
from ltsim.physics.model.construction import declared_construction
from ltsim.recordings.recording import Recording
from ltsim.solve.threads import single_threaded

MOST_ROUNDS = 3
"""Times that a change of the noise is looked for beside what was found."""
LEAST_LEVEL = 1e-3
"""Smallest false-alarm rate: it takes one over it simulated recordings to say that none is like the one at hand."""
NEXT_LEVEL = 0.01
"""Chance that a further finding is added to a recording that holds no more than those found."""
LEFT_OF = 0.5
"""Share of a constant's difference that it keeps beside what was found: a law that it had absorbed leaves less."""
MOST_TOLD = 5
"""Findings that are told at most, mistakes and constants first; smaller ones are modelled."""
LEAST_GAIN = 2.0
"""Log evidence of a further finding: odds of 7 to 1 that there is one."""


@refusing_singular
@single_threaded
def diagnose(
    recording: Recording,
    *,
    seed: int = 0,
    level: float = 0.05,
    history: Known | None = None,
    held_out: bool | None = False,
) -> Diagnosis:
    """Diagnose a recording.

    Parameters
    ----------
    recording : Recording
    seed : int
        Root seed of the simulated null distribution.
    level : float
        False-alarm rate of the whole search, `LEAST_LEVEL` at least.
    history : Known, optional
        Earlier calibrations that each constant of the instruments is compared with.
    held_out : bool, optional
        Whether the search is repeated without each fold of the readings, which are then predicted: five more searches
        where something was found. None: in networks with up to `probe.MOST_UNKNOWNS` unknowns.

    Returns
    -------
    Diagnosis
        Verdict, findings in the order of their strength, fit before and after, what cannot be seen.

    Raises
    ------
    RecordError
        When the history is of other instruments or another construction, or the level is none.
    """
    if not LEAST_LEVEL <= level < 1.0:
        raise RecordError(f"level: found {level:g}, expected a false-alarm rate from {LEAST_LEVEL:g} to 1")
    construction = declared_construction(recording)
    compared = (
        contradictions if history is None else HistoryExpectation.of(history, recording, construction).contradictions
    )
    selection = identified(recording, construction)
    if selection is None:
        baseline, mistaken = adjust(recording, construction), list[Finding]()
        use = baseline.problem.use
    else:
        baseline, use, mistaken = adapted(recording, construction, selection)
    trials = max(TRIALS, ceil(1.0 / level))
    case = Case(baseline, use, seed, trials, ordinary=history is None)
    sight, detection = sight_of(case.space, case.searcher.cards), detect(case.searcher, case.bank)
    mismatch = detection.p_value < level
    threshold = max(detection.threshold(NEXT_LEVEL), LEAST_GAIN)
    found = _explain(case, threshold, compared) if mismatch else case.empty
    found, fitted = _refitted(case, found)
    settled = fitted.adjustment if fitted.adjustment.solution.converged else baseline
    apart = _apart(case, found, settled, compared)
    odd = [instrument_finding(c) for c in apart if not _varies(c.parameter.name, found.effects)][:MOST_MEMBERS]
    explained = Explained(case, detection, found, fitted, bool(mistaken or odd or _beyond_level(case.noise)))
    repeated = not case.searcher.large if held_out is None else held_out
    errors = HeldOut() if case.searcher.large and not repeated else _held_out(explained, threshold, repeated)
    return _told(explained, sight, [*mistaken, *odd], settled, errors, selection, mismatch=mismatch)


def _varies(constant: str, effects: Sequence[Tunable]) -> bool:
    """Whether a constant of an instrument is what an effect varies: then it has no value to contradict another."""
    laws = (VARIED.get(e.carrier.name, ()) for e in effects if isinstance(e, Law))
    drifts = (constants_in(getattr(e, "slot", "")) for e in effects)
    own = ([p.name for p in e.parameters] for e in effects)
    return any(constant in varied for varied in (*laws, *drifts, *own))


Compared = Callable[[Adjustment, float], list[Contradiction]]
"""Constants of an adjustment that contradict what is known of them, with so much log evidence at least."""


def _apart(case: Case, found: Found, settled: Adjustment, compared: Compared) -> list[Contradiction]:
    """Constants that contradict what is known of them, with what was found and without it, by much the same."""
    beside = compared(settled, LEAST_GAIN)
    if not found.members:
        return beside
    alone = compared(case.space.adjustment, LEAST_GAIN)
    size = {(one.instruments, one.parameter.name): abs(one.difference) for one in alone}
    return [c for c in beside if abs(c.difference) > LEFT_OF * size.get((c.instruments, c.parameter.name), np.inf)]


def _explain(case: Case, threshold: float, compared: Compared) -> Found:
    """Constants that are not as stated, shifts of the readings and changes of the noise, until nothing gains.

    Whichever explains more alone comes first: a law that is sought while the stated noise is wrong explains noise, and
    noise that is fitted before a law hides it; so with constants.
    """
    noise = case.noises(case.empty)[0][0]
    if noise >= case.searcher.first_look(threshold, noise).score:
        _noise_alone(case, threshold)
        found = _beside_noise(case, threshold)
    else:
        found = case.searcher.search(threshold, something=True)
    apart = compared(case.space.adjustment, LEAST_GAIN)
    if apart and sum(one.evidence for one in apart) > found.score:
        case.free(apart)
        found = case.searcher.search(threshold, something=False)
    return _in_turn(case, found, threshold)


def _noise_alone(case: Case, threshold: float) -> None:
    """Changes of the noise, one after another, while they gain; the first in any case, as something is off."""
    for further in range(MOST_ROUNDS):
        ranked = case.noises(case.empty)
        if further and ranked[0][0] < threshold:
            break
        case.add_noise(most_likely(case.space, case.space.sigma, _with_probability(ranked, 0.0)))
        case.weigh(case.settle_noise(()))


def _beside_noise(case: Case, threshold: float) -> Found:
    """Model of shifts of readings in addition to a change of the noise, if they gain; else the empty model.

    Noise estimated alone hides a shift: it is estimated again with the best shifts, and both together are
    compared with noise alone by their restricted likelihood.
    """
    alone, sigma, adjusted = list(case.noise), case.sigma, case.space.adjustment
    case.settle_with(case.searcher.search(threshold, something=True).effects)
    found, space = case.searcher.search(threshold, something=False), case.space
    factor = (sigma / case.sigma)[space.use] ** 2
    squares, share = (rows[: len(factor)] for rows in (space.residual**2, space.redundancy))
    if found.members and found.score - restricted(squares, share, factor).sum() > threshold:
        return found
    case.noise, case.sigma = alone, sigma
    case.weigh(adjusted)
    return case.empty


def _in_turn(case: Case, found: Found, threshold: float) -> Found:
    """Changes of the noise beside a set, or in place of one or all of it, and what shifts then, until nothing gains."""
    for _ in range(MOST_ROUNDS):
        searcher, members = case.searcher, found.members
        kept = [found, *(searcher.without(found, i) for i in range(len(members)))]
        kept += [searcher.empty] if len(members) > 1 else []
        ranked = [case.noises(one) for one in kept]
        least = threshold + found.misfit
        rest = [min(searcher.rank(found).total, least), *(searcher.rank(one).total for one in kept[1:])]
        lost = [0.0, *rest[1 : len(members) + 1], *(found.score - one.score for one in kept[len(members) + 1 :])]
        gains = [noise[0][0] - less for noise, less in zip(ranked, lost, strict=True)]
        most = int(np.argmax(gains))
        if gains[most] < (least if not most and (case.noise or members) else 0.0):
            break
        told = _with_probability(ranked[most], rest[most])
        beside = case.space.beside(kept[most].effects)
        case.add_noise(most_likely(beside, case.space.sigma, told))
        case.weigh(case.settle_noise(kept[most].effects))
        found = case.searcher.search(threshold, something=False)
    return found


def _with_probability(ranked: Sequence[tuple[float, NoiseHypothesis]], rest: float) -> NoiseHypothesis:
    """The likeliest change of the noise, with its probability among all of them and what else was tried."""
    values = np.array([value for value, _ in ranked])
    weights = np.exp(values - log_sum_exp(np.array([0.0, rest, *values])))
    named: dict[str, float] = {}
    for (_, one), weight in zip(ranked, weights.tolist(), strict=True):
        named[one.effect.name] = named.get(one.effect.name, 0.0) + weight
    name = likeliest(named)
    value, best = next(one for one in ranked if one[1].effect.name == name)
    probability, rivals = among(named, name)
    return replace(best, evidence=value, probability=probability, equivalents=rivals)


def _refitted(case: Case, found: Found) -> tuple[Found, Refit]:
    """The exact refit with what was found, without members that it does not need.

    The search works in first order: what a large effect leaves to second order can look like another one beside it.
    """
    fitted = case.refit(found.effects, case.sigma)
    while len(found.members) > 1:
        rest = [case.searcher.without(found, i) for i in range(len(found.members))]
        without = [case.refit(one.effects, case.sigma) for one in rest]
        gains = [
            0.5 * (one.adjustment.chi2 - fitted.adjustment.chi2) + h.log_prior
            for h, one in zip(found.members, without, strict=True)
        ]
        least = int(np.argmin(gains))
        if gains[least] >= 0.0:
            break
        found, fitted = rest[least], without[least]
    return found, fitted


def _beyond_level(noise: Sequence[NoiseHypothesis]) -> bool:
    """Whether the noise is other than stated beyond its level, which is one line and no finding."""
    return any(not isinstance(one.effect, NoiseLevel) for one in noise)


def _told(
    explained: Explained,
    sight: Sight,
    certain: Sequence[Finding],
    settled: Adjustment,
    errors: HeldOut,
    selection: Selection | None,
    *,
    mismatch: bool,
) -> Diagnosis:
    """The verdict, put together from what the search explains, and findings that are `certain` without it."""
    case, found, detection = explained.case, explained.found, explained.detection
    baseline, adjusted = case.baseline, explained.refit.adjustment
    shifts = [explained.finding(i) for i, one in enumerate(found.members) if one.key not in explained.untold]
    noises = [noise_finding(one, baseline.sightings, detection) for one in case.noise]
    sure = [one for one in (*shifts, *noises) if one.evidence.chance >= LIKELY]
    alone = not certain and all(one.effect == NoiseLevel.name for one in sure)
    likely = (sure + [one for one in shifts if one not in sure] or noises) if alone else sure
    likely = sorted(likely, key=lambda finding: -finding.evidence.chi2_drop)
    room = max(MOST_TOLD - len(certain), 0)
    findings = sorted([*certain, *likely[:room]], key=lambda finding: -finding.evidence.chi2_drop)
    before = after = Misfit(chi2=baseline.chi2, dof=baseline.dof, held_out_rms=errors.before)
    if found.members or case.noise:
        dof = baseline.dof - found.extension.shape[1]
        after = Misfit(chi2=adjusted.chi2, dof=dof, held_out_rms=errors.after)
    verdict = "mismatch" if mismatch or certain else "consistent"
    detectable, undetectable = sight
    return Diagnosis(
        verdict=verdict,
        summary=summarise(
            verdict, findings, detection.p_value, before, after, untold=len(explained.untold) + len(likely[room:])
        ),
        statistic=baseline.chi2,
        dof=baseline.dof,
        p_value=detection.chi2_p_value,
        search_p_value=detection.p_value,
        findings=tuple(findings),
        before=before,
        after=after,
        undetectable=undetectable,
        detectable=detectable,
        instruments=instrument_entries(settled),
        targets=averaged_targets(case.searcher, found, explained.rankings, explained.refit),
        baseline=baseline,
        adjusted=adjusted,
        tests=() if selection is None else outcomes(selection),
    )


def _held_out(explained: Explained, threshold: float, repeated: bool) -> HeldOut:
    """Errors on held-out readings, in the noise as stated, or as found where that is larger.

    The second one where the search is `repeated`, or nothing shifts readings.
    """
    case, stated = explained.case, explained.case.recording.sigma()
    space, seed = case.searcher.space, case.seed
    if (case.sigma < stated).any():
        space = ResidualSpace.of(case.refit((), np.maximum(case.sigma, stated)).adjustment)
    if not explained.found.members:
        before = left_out(space, seed).before
        return HeldOut(before, before)
    return left_out(space, seed, case.searcher, threshold) if repeated else left_out(space, seed)


__all__ = ["diagnose"]
