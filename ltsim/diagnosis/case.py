"""The recording under examination, and what is known of it so far."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.refit import Refit, refit
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.arrays import Bools, Floats
from ltsim.diagnosis.evidence import WIDE
from ltsim.diagnosis.hypotheses import Found
from ltsim.diagnosis.noise import NoiseBank, NoiseHypothesis, most_likely, noise_hypotheses
from ltsim.diagnosis.probe import TRIALS
from ltsim.diagnosis.search import Searcher
from ltsim.effects.signature import Tunable
from ltsim.recording.recording import Recording

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
    searcher: Searcher = field(init=False)
    bank: NoiseBank = field(init=False)

    def __post_init__(self) -> None:
        self.sigma = self.recording.sigma()
        self.search(self.baseline)

    def copy(self) -> Case:
        """The case as it stands, to go on with another way; what was scored is shared."""
        other = copy(self)
        other.noise = list(self.noise)
        return other

    @property
    def recording(self) -> Recording:
        """What was measured, mended."""
        return self.baseline.recording

    def refit(self, effects: Sequence[Tunable], sigma: Floats) -> Refit:
        """The exact refit with some effects; without any the ordinary adjustment.

        Parameters are held to `WIDE` times their plausible size: some combinations of them may leave no residual.
        """
        if not (effects or self.noise):
            return Refit(self.baseline, (), ())
        adjusted = partial(adjust, self.recording, self.baseline.construction, sigma=sigma, use=self.use, held_to=WIDE)
        return refit(adjusted, effects, start=self.baseline.state)

    def search(self, adjustment: Adjustment) -> None:
        """Score everything beside an adjustment; what was scored before is let go."""
        space, cards, trials = ResidualSpace.of(adjustment), None, self.trials
        if hasattr(self, "searcher"):
            cards, trials = self.searcher.cards.reweighted(self.searcher.space, space), 0
            del self.searcher
        self.searcher = Searcher(space, self.seed, trials, cards=cards, ordinary=self.ordinary)
        quieter = not any(getattr(one.effect, "repeating", "") for one in self.noise)
        tried = noise_hypotheses(space.sightings, self.recording.instruments, quieter=quieter)
        self.bank = NoiseBank.of(space, tried)

    def noises(self, found: Found) -> list[tuple[float, NoiseHypothesis]]:
        """Every change of the noise beside a set, the likeliest of each family first, with its evidence."""
        redundancy = self.searcher.space.redundancy - np.sum(found.extension**2, axis=1)
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

    def _weighted(self, noise: Sequence[NoiseHypothesis]) -> Floats:
        """Standard deviations (n, 3) with some changes of the noise."""
        sigma, sightings = self.recording.sigma(), self.baseline.sightings
        for one in noise:
            sigma = np.sqrt(one.effect.variance(sightings, sigma, np.array(one.values)))
        return sigma
