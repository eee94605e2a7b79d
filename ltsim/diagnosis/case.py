"""The recording under examination, and what is known of it so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.refit import Refit, refit
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Bools, Floats
from ltsim.diagnosis.evidence import WIDE
from ltsim.diagnosis.hypotheses import Found
from ltsim.diagnosis.instruments import Contradiction
from ltsim.diagnosis.noise import NoiseBank, NoiseHypothesis, most_likely, noise_hypotheses
from ltsim.diagnosis.probe import TRIALS
from ltsim.diagnosis.search import Searcher
from ltsim.physics.effects.signature import Signature, Tunable
from ltsim.physics.model.measurement import State
from ltsim.recordings.recording import Recording

REWEIGHTINGS = 2
"""Adjustments in which the sizes of the noise settle."""


@dataclass
class Case:
    """A recording with its mistakes mended, the changes of its noise found so far, and a search beside them.

    `baseline` is its ordinary adjustment, where all others begin, `use` (n, 3) the readings that they take, `sigma`
    (n, 3) their standard deviations, `trials` the simulated recordings by which the search is judged.
    """

    baseline: Adjustment
    use: Bools
    seed: int
    trials: int = TRIALS
    ordinary: bool = True
    """Constants are tried against their prior too."""
    sigma: Floats = field(init=False)
    noise: list[NoiseHypothesis] = field(default_factory=list)
    space: ResidualSpace = field(init=False)
    bank: NoiseBank = field(init=False)
    _searcher: Searcher | None = None
    _scored: Searcher | None = None

    def __post_init__(self) -> None:
        self.sigma = self.recording.sigma()
        self.weigh(self.baseline)

    @property
    def searcher(self) -> Searcher:
        """The search in the residual space; everything is scored when it is asked for first."""
        if self._searcher is None:
            before = self._scored
            cards = None if before is None else before.cards.reweighted(before.space, self.space)
            trials = self.trials if before is None else 0
            self._scored = None
            self._searcher = Searcher(self.space, self.seed, trials, cards=cards, ordinary=self.ordinary)
        return self._searcher

    @property
    def empty(self) -> Found:
        """The set of no findings."""
        return Found((), (), (), self.space.residual)

    @property
    def recording(self) -> Recording:
        """Recording as it was measured, with its mistakes corrected."""
        return self.baseline.recording

    def refit(self, effects: Sequence[Tunable], sigma: Floats) -> Refit:
        """The exact refit with some effects; without any the ordinary adjustment.

        Parameters are held to `WIDE` times their plausible size: some combinations of them may leave no residual.
        """
        if not (effects or self.noise):
            return Refit(self.baseline, (), ())
        old = self.baseline
        adjusted = partial(
            adjust, self.recording, old.construction, sigma=sigma, use=self.use, held_to=WIDE, prior=old.problem.prior
        )

        def with_causes(effects: Sequence[Signature] = (), start: State | None = None) -> Adjustment:
            """The adjustment with effects before the causes of the baseline."""
            return adjusted(effects=(*effects, *old.effects), start=start)

        return refit(with_causes if old.effects else adjusted, effects, start=old.state)

    def free(self, constants: Sequence[Contradiction]) -> None:
        """Let constants that contradict what is known of them be whatever the readings say."""
        old = self.baseline
        freed = np.zeros(old.state.instrument.shape, dtype=bool)
        for one in constants:
            owners = [self.recording.instruments.index(name) for name in one.instruments]
            freed[owners, old.construction.names.index(one.parameter.name)] = True
        prior = old.problem.prior.widened(freed)
        self.baseline = adjust(
            self.recording,
            old.construction,
            effects=old.effects,
            sigma=self.recording.sigma(),
            use=self.use,
            start=old.state,
            prior=prior,
        )
        self.weigh(self.refit((), self.sigma).adjustment)

    def weigh(self, adjustment: Adjustment) -> None:
        """Look at what another adjustment leaves; what was scored before is let go."""
        self.space, self._scored, self._searcher = ResidualSpace.of(adjustment), self._searcher or self._scored, None
        quieter = not any(getattr(one.effect, "repeating", "") for one in self.noise)
        tried = noise_hypotheses(self.space.sightings, self.recording.instruments)
        self.bank = NoiseBank.of(self.space, tried, quieter=quieter)

    def noises(self, found: Found) -> list[tuple[float, NoiseHypothesis]]:
        """Every change of the noise beside a set, the likeliest of each family first, with its evidence."""
        redundancy = self.space.redundancy - np.sum(found.extension**2, axis=1)
        return self.bank.ranked(found.residual, redundancy, found.extension)

    def add_noise(self, further: NoiseHypothesis) -> None:
        """Take in a further change of the noise; one of the same kind at the same place is made larger."""
        for i, one in enumerate(self.noise):
            if one.effect == further.effect:
                values = tuple(a + b for a, b in zip(one.values, further.values, strict=True))
                self.noise[i] = replace(one, values=values, drop=one.drop + further.drop)
                break
        else:
            self.noise.append(further)
        self.sigma = self._weighted(self.noise)

    def settle_noise(self, beside: Sequence[Tunable]) -> Adjustment:
        """Adjust with the noise found until its sizes settle, mean effects `beside` it taken out.

        This ends at the restricted maximum likelihood (Foerstner 1979).
        """
        for _ in range(REWEIGHTINGS):
            space = ResidualSpace.of(self.refit((), self.sigma).adjustment).beside(beside)
            for i, one in enumerate(self.noise):
                stated = self._weighted([*self.noise[:i], *self.noise[i + 1 :]])
                self.noise[i] = replace(most_likely(space, stated, one), drop=one.drop)
            self.sigma = self._weighted(self.noise)
        return self.refit((), self.sigma).adjustment

    def settle_with(self, beside: Sequence[Tunable]) -> None:
        """Settle the noise beside some effects, without changes of it that these leave no reason for."""
        space = ResidualSpace.of(self.settle_noise(beside)).beside(beside)
        told = [most_likely(space, self._weighted([n for n in self.noise if n is not one]), one) for one in self.noise]
        self.noise = [n for n, one in zip(self.noise, told, strict=True) if 0.5 * one.drop + one.log_prior > 0.0]
        self.sigma = self._weighted(self.noise)
        self.weigh(self.settle_noise(beside))

    def _weighted(self, noise: Sequence[NoiseHypothesis]) -> Floats:
        """Standard deviations (n, 3) with some changes of the noise."""
        sigma, sightings = self.recording.sigma(), self.baseline.sightings
        for one in noise:
            sigma = np.sqrt(one.effect.variance(sightings, sigma, np.array(one.values)))
        return sigma
