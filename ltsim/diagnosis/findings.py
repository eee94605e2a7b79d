"""Findings from what a search found: where, how large, how sure, in which words."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ltsim.adjustment.prior import prior_sigmas
from ltsim.adjustment.refit import Refit
from ltsim.core.arrays import Floats
from ltsim.core.notation import number
from ltsim.diagnosis.blind import distortion
from ltsim.diagnosis.case import Case
from ltsim.diagnosis.curve import curve_of
from ltsim.diagnosis.detect import Detection
from ltsim.diagnosis.evidence import posterior, shown_in
from ltsim.diagnosis.hypotheses import Found, Hypothesis, Ranking
from ltsim.diagnosis.instruments import TINY
from ltsim.diagnosis.noise import NoiseHypothesis
from ltsim.diagnosis.outside import log_likeness
from ltsim.diagnosis.prior import NOISY, PLAIN, SAME_OBSERVABLE
from ltsim.diagnosis.schema import Equivalent, Estimate, Evidence, Finding, Where
from ltsim.diagnosis.separate import separating_measurement
from ltsim.diagnosis.words import LIKELY, card_sentence, law_sentence, outside_sentence, without_clock
from ltsim.physics.effects import BASELINE
from ltsim.physics.effects.effect import Effect, NoiseEffect, SlotEffect
from ltsim.physics.effects.signature import Tunable, constants_of
from ltsim.physics.laws.law import Law
from ltsim.physics.laws.places import trackers_of
from ltsim.physics.laws.regressors import words_of
from ltsim.physics.laws.variance import VarianceFunction
from ltsim.physics.laws.words import AT_EACH_SET_UP, describe
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings

MOST_EQUIVALENTS = 3
"""Equivalents that are stated at most."""
MOST_ESTIMATES = 12
"""Sizes of one change of the noise that are told: of each of many targets or set-ups, the largest."""
NOT_EXCLUDED = 0.01
"""Probability above which another effect is stated as an equivalent."""
FEW_READINGS, MOSTLY = 4, 0.8
"""Readings that are named where so few carry such a share of what a finding explains."""
SURE = 2.0
"""Standard deviations from which a size is beyond doubt."""
BASELINE_KINDS = tuple(type(effect) for effect in BASELINE)
"""Constants of the ordinary calibration: they are findings where they are beyond what was stated of them."""
IMPLAUSIBLE = 5.0
"""Times a bad but plausible size from which a size is remarked upon."""


@dataclass(frozen=True)
class Explained:
    """Explanation of a recording, searched and refitted, from which its findings are reported."""

    case: Case
    detection: Detection
    found: Found
    refit: Refit
    besides: bool = False
    """True where findings are reported in addition to the members."""

    def _ranking(self, member: int) -> Ranking:
        """All that could stand in a member's place: changes of the noise among it, and a cause that nobody listed."""
        searcher, found = self.case.searcher, self.found
        others = searcher.without(found, member)
        noises = [Hypothesis(one.effect, 0.0, value, one.effect.name) for value, one in self.case.noises(others)]
        effect, spread = self.refit.effects[member], found.members[member].spread
        mean = posterior(*searcher.exact.moments([effect], others)[0], spread)[0]
        redundancy = searcher.space.redundancy - np.sum(found.extension**2, axis=1)
        shift = searcher.space.signature(effect) @ mean
        likeness = log_likeness(searcher.space, shift, found.residual, redundancy)
        return searcher.rank(others).beside(noises).doubted(likeness)

    def probability(self, member: int) -> float:
        """Probability of a member's name; of what has none, that it acts on the same observables."""
        hypothesis, ranking = self.found.members[member], self.rankings[member]
        if hypothesis.known:
            return ranking.probabilities().get(hypothesis.name, 0.0)
        acts = set(hypothesis.effect.observables)
        same = ranking.share(lambda h: not h.known and set(h.effect.observables) == acts)
        return same + SAME_OBSERVABLE * ranking.unlisted

    @cached_property
    def rankings(self) -> list[Ranking]:
        """All that could stand in the place of each member."""
        return [self._ranking(i) for i in range(len(self.found.members))]

    @cached_property
    def shown(self) -> list[float]:
        """Probability that each member acts on this, here, and follows this, whatever it is called."""
        return [self._shown(i) for i in range(len(self.found.members))]

    @cached_property
    def gains(self) -> list[Floats]:
        """By how much each member, beside the others, takes the squares (m,) of what is left down."""
        without = (self.case.searcher.without(self.found, i) for i in range(len(self.found.members)))
        return [others.residual**2 - self.found.residual**2 for others in without]

    @cached_property
    def untold(self) -> tuple[str, ...]:
        """Keys of members of little chance: they are modelled; what explains most is told where nothing else is."""
        members, gains = self.found.members, [gain.sum() for gain in self.gains]
        doubtful = [self.chance(i) < LIKELY and (self.besides or gains[i] < max(gains)) for i in range(len(members))]
        return tuple(one.key for one, doubt in zip(members, doubtful, strict=True) if doubt)

    def chance(self, member: int) -> float:
        """Probability of a member, whatever it is called, if it has a size and no more constants than readings carry.

        Coefficients of a law may each be in doubt where the law is not; one of no known form, at no place and in no
        observable, says nothing beside others.
        """
        effect, gain = self.refit.effects[member], self.gains[member]
        sizes = [one for one in self.refit.told[member] if one.parameter in effect.parameters]
        together = len(sizes) > 1 and float(gain.sum()) > SURE**2 * constants_of(effect)
        sized = isinstance(effect, Law) or together or any(abs(one.value) > SURE * one.sigma for one in sizes)
        shown = self.shown[member]
        says = self._where(effect) != Where(covariates=words_of(effect.covariates)) or shown >= LIKELY
        # so many readings alike would carry the gain (participation ratio)
        carried = float(gain.sum() ** 2 / max(float(np.sum(gain**2)), TINY))
        return max(self.probability(member), shown) if sized and says and carried >= constants_of(effect) else 0.0

    def finding(self, member: int) -> Finding:
        """The finding of a member, a mean shift, beside the others."""
        searcher, found, ranking = self.case.searcher, self.found, self.rankings[member]
        space, others = searcher.space, searcher.without(found, member)
        hypothesis = replace(found.members[member], effect=self.refit.effects[member])
        effect, name = hypothesis.effect, hypothesis.name
        probability, rivals = self.probability(member), among(ranking.probabilities(), name)[1]
        shown = self.shown[member]
        gain = self.gains[member]
        mean = posterior(*searcher.exact.moments([effect], others)[0], hypothesis.spread)[0]
        signature, rows = space.signature(effect), int(space.use.sum())
        done = signature @ mean
        left = searcher.with_members([hypothesis]).left[0] @ mean
        where = self._where(effect, shown_in(space.use, done[:rows], left[:rows]))
        told = self._estimates(member, hypothesis, others)
        more: dict[str, Any] = {}
        sentence = ""
        if isinstance(effect, Law):
            more = {
                "carrier": effect.carrier.name,
                "driver": describe(effect.driver, clock=self.case.recording.has_clock),
            }
            more["curve"] = curve_of(effect, space.sightings, *searcher.coefficients(effect, others))
            law = law_words(effect, more["driver"])
            sentence = law_sentence(where, told, shown, law)
            more["formula"] = "" if hypothesis.known else law
        elif isinstance(effect, Effect):
            beside = [e for k, e in enumerate(self.refit.effects) if k != member]
            names = [rival.effect for rival in rivals]
            more["separate_by"] = separating_measurement(self.case.baseline, name, names, beside)
        if hypothesis.known:
            doubt = self._doubt(effect, told)
            sentence = card_sentence(name, where, told, probability, shown=shown) + doubt
        more["moves_targets_um"] = moved = distortion(space, done)
        touched = max(int(np.count_nonzero(signature.any(axis=1))), 1)
        felt = number(np.sqrt(max(float(gain.sum()), 0.0) / touched), 2)
        sentence += f" Not modelled, it leaves {felt} sigma rms in the readings that it acts on"
        sentence += f" and moves the targets by {number(moved, 2)} um rms.{self._readings(gain)}"
        return Finding(
            effect=name,
            known=hypothesis.known,
            where=where,
            parameters=told,
            evidence=Evidence(
                chi2_drop=float(gain.sum()),
                parameters=found.extension.shape[1] - others.extension.shape[1],
                p_value=self.detection.chance(ranking.total),
                probability=probability,
                shown=shown,
            ),
            sentence=sentence,
            equivalents=rivals,
            **_told(more),
        )

    def _readings(self, gain: Floats) -> str:
        """A sentence on the readings that carry a gain (m,), where they are few."""
        use, recording = self.case.searcher.space.use, self.case.recording
        own = gain[: int(use.sum())]
        worst = np.argsort(-own)
        count = int(np.searchsorted(np.cumsum(own[worst]), MOSTLY * max(float(gain.sum()), TINY))) + 1
        if count > FEW_READINGS:
            return ""
        at = [
            (int(row), int(kind)) for row, kind in zip(*(part[worst[:count]] for part in np.nonzero(use)), strict=True)
        ]
        station, target = recording.stations, recording.targets
        told = (
            f"{OBSERVABLES[k]} from {station[recording.station[i]]} to {target[recording.target[i]]} (row {i + 1})"
            for i, k in at
        )
        return f" Most of it lies in the {', the '.join(told)}."

    def _shown(self, member: int) -> float:
        """Probability of all explanations that act on the same as a member, at its place, and follow the same.

        A target may be off as one that moved, sat badly or was read wrongly: what acts on it alone is the same change.
        """
        effect = self.found.members[member].effect

        def seen(one: Tunable) -> Where:
            where = self._where(one)
            if where.targets and not isinstance(effect, Law):
                return Where(targets=where.targets)
            return where.model_copy(update={"observables": tuple(sorted(one.observables))})

        own = seen(effect)
        return self.rankings[member].share(lambda h: seen(h.effect) == own)

    def _where(self, effect: Tunable, carried: tuple[str, ...] = ()) -> Where:
        """Scope of an effect; the set-ups of one of several instruments are that instrument."""
        where = where_of(effect, carried)
        for tracker in trackers_of(self.case.searcher.space.sightings, self.case.recording.instruments):
            if set(where.stations) == set(tracker.stations) and isinstance(effect, SlotEffect):
                return where.model_copy(update={"stations": (), "instruments": tracker.instruments})
        return where

    def _doubt(self, effect: Tunable, told: Sequence[Estimate]) -> str:
        """A sentence where a constant is beyond what was stated of it, or a size hardly plausible for its cause."""
        recording = self.case.recording
        if isinstance(effect, BASELINE_KINDS):
            name = recording.instruments[self._instrument(effect)]
            prior = recording.setup.instrument_named(name).prior
            stated = ((p.sigma_from(prior) / p.factor, p.unit) for p in effect.parameters)
            said = ", ".join(f"{number(sigma, 2)} {unit}" for sigma, unit in stated)
            return f" It was stated to be zero with a standard deviation of {said}."
        implausible = " Such a size is hardly plausible for this cause: check it, and think of others."
        return implausible if _implausible(effect, told) else ""

    def _constants(self, effect: Tunable) -> tuple[Estimate, ...]:
        """Constants of an instrument as the readings alone have them, each beside the priors of the others."""
        adjustment, which = self.case.baseline, self._instrument(effect)
        prior = prior_sigmas(self.case.recording, adjustment.construction)[which]
        variance = np.diag(adjustment.instrument_covariance_of(which))
        wider = 1.0 / np.maximum(1.0 - variance / prior**2, TINY)
        value, sigma = adjustment.state.instrument[which] * wider, np.sqrt(variance * wider)
        at = (adjustment.construction.names.index(p.name) for p in effect.parameters)
        return tuple(Estimate.of(p, value[k], sigma[k]) for p, k in zip(effect.parameters, at, strict=True))

    def _instrument(self, effect: Tunable) -> int:
        """The instrument at whose set-ups an effect acts."""
        recording = self.case.recording
        at = recording.stations.index(effect.stations[0]) if effect.stations else int(recording.station[0])
        return int(recording.instrument[recording.station == at][0])

    def _estimates(self, member: int, hypothesis: Hypothesis, others: Found) -> tuple[Estimate, ...]:
        """The sizes of a member, by rows where the recording has no clock."""
        refitted = [Estimate.of(*one) for one in self.refit.told[member] if np.isfinite(one.sigma)]
        if isinstance(hypothesis.effect, BASELINE_KINDS):
            return self._constants(hypothesis.effect)
        told = self.case.searcher.estimates(hypothesis, others, refitted)
        return told if self.case.recording.has_clock else tuple(without_clock(e) for e in told)


def noise_finding(hypothesis: NoiseHypothesis, sightings: Sightings, detection: Detection) -> Finding:
    """The finding of a change of the noise, in the observables in which it is beyond doubt."""
    effect, sizes = hypothesis.effect, zip(hypothesis.values, hypothesis.sigma, strict=True)
    probability = hypothesis.probability * (NOISY if any(v > SURE * s for v, s in sizes) else PLAIN)
    where = where_of(effect, _scattering(hypothesis, sightings))
    every = zip(effect.parameters, hypothesis.values, hypothesis.sigma, strict=True)
    rows = [Estimate.of(*told) for told in every if np.isfinite(told[2])]
    more, sentence = {}, ""
    if isinstance(effect, VarianceFunction):
        more = {"formula": effect.law, "carrier": effect.carrier, "driver": effect.driver}
        most = ""
        if effect.each:
            rows = sorted(rows, key=lambda e: -e.value)[:MOST_ESTIMATES]
            sure = [e for e in rows if e.value > SURE * e.sigma] or rows
            worst = {e.name.partition(" at ")[2]: number(np.sqrt(1.0 + e.value), 2) for e in reversed(sure)}
            told = [f"{name} ({times})" for name, times in reversed(worst.items())][:2]
            most = f", most at {' and '.join(told)}, in times the stated deviation"
        sentence = outside_sentence(where, effect.law + most)
    return Finding(
        effect=effect.name,
        known=not isinstance(effect, VarianceFunction),
        where=where,
        parameters=tuple(rows),
        evidence=Evidence(
            chi2_drop=hypothesis.drop,
            parameters=len(rows),
            p_value=detection.chance(hypothesis.evidence),
            probability=probability,
        ),
        sentence=sentence or card_sentence(effect.name, where, rows, probability),
        equivalents=hypothesis.equivalents,
        **_told(more),
    )


def _scattering(hypothesis: NoiseHypothesis, sightings: Sightings) -> tuple[str, ...]:
    """The observables whose noise is beyond doubt larger than stated, or smaller where that is what was found."""
    sizes = hypothesis.effect.spread
    found = np.array(hypothesis.values) / sizes
    sure = found * np.sign(found[np.argmax(np.abs(found))]) > SURE * np.array(hypothesis.sigma) / sizes
    one = np.ones((len(sightings), len(OBSERVABLES)))
    acts = (hypothesis.effect.variance(sightings, one, np.where(sure, sizes, 0.0)) != one).any(axis=0)
    return tuple(name for name, act in zip(OBSERVABLES, acts, strict=True) if act)


def among(chances: Mapping[str, float], name: str) -> tuple[float, tuple[Equivalent, ...]]:
    """The probability of a name, and the likeliest others that are not excluded."""
    others = [Equivalent(effect=n, probability=p) for n, p in chances.items() if n != name and p > NOT_EXCLUDED]
    return chances.get(name, 0.0), tuple(sorted(others, key=lambda other: -other.probability)[:MOST_EQUIVALENTS])


def where_of(effect: Tunable, carried: tuple[str, ...] = ()) -> Where:
    """Scope of an effect; `carried`: observables that a law, or a change of the noise, does not specify."""
    observables, stations = tuple(effect.observables), effect.stations
    if isinstance(effect, NoiseEffect | VarianceFunction):
        observables = carried or observables
    instruments = effect.instruments if isinstance(effect, Law | VarianceFunction) else ()
    if isinstance(effect, Law):
        stations = () if effect.each else stations
        observables = effect.carrier.observables or carried or observables
    return place_of(
        observables=() if set(observables) == set(OBSERVABLES) else observables,
        stations=() if instruments else stations,
        targets=effect.targets,
        instruments=instruments,
        covariates=words_of(effect.covariates),
    )


def law_words(law: Law, driver: str) -> str:
    """A law and its driver in a line: ``distance correction follows cos(3 azimuth)``."""
    what = f"{law.carrier.name} correction" if law.carrier.kind == "reading" else law.carrier.name
    own = AT_EACH_SET_UP if law.each else ""
    return f"{what} differs{own}" if law.driver.kind == "constant" else f"{what} follows {driver}{own}"


def place_of(**confined: tuple[str, ...]) -> Where:
    """A place that says of each kind whether it is confined to some of it."""
    return Where(**dict.fromkeys(Where.model_fields, ()) | confined)


def _told(more: Mapping[str, Any]) -> dict[str, Any]:
    """Entries with a value, the empty ones left out."""
    return {key: value for key, value in more.items() if value}


def _implausible(effect: Tunable, estimates: Sequence[Estimate]) -> bool:
    """Whether some size is far beyond a bad but plausible one, or negative where none can be."""
    sizes = zip(effect.parameters, effect.spread.tolist(), strict=True)
    told = [(e, p, size) for p, size in sizes for e in estimates if e.name == p.name]
    large = any(abs(e.value) - 2 * e.sigma > IMPLAUSIBLE * size / p.factor for e, p, size in told)
    return large or any(p.positive and e.value + 2 * e.sigma < 0.0 for e, p, _ in told)
