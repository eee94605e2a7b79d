"""Selection of the simple causes that a network supports: forward, backward and exchange, by one log evidence.

After each step the network is fitted anew with what was chosen, and everything is looked at again beside it: outliers,
reference values, the other hypotheses. Nothing is corrected before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ltsim.errors import LtsimError, NetworkError
from ltsim.identification.fit import Fit, Network
from ltsim.identification.hypothesis import Hypothesis, NoiseFactor
from ltsim.identification.library import conventions
from ltsim.identification.screen import looks
from ltsim.model.construction import Construction, stated_construction
from ltsim.recording.recording import Recording

LEAST_GAIN = 3.0
"""Log evidence that a hypothesis must gain: odds of 20 to 1, on the scale of Kass and Raftery (1995) strong."""
MOST = 8
"""Hypotheses that are chosen at most: a network with more simple causes is measured again."""
TRIED = 4
"""Hypotheses that are fitted in a step, in the order of what they promise."""
AFTER_ALL = 0.5
"""Share of its promise that a hypothesis must gain from where the network stands; else it is fitted from the start."""


@dataclass(frozen=True)
class Choice:
    """A chosen hypothesis, the log evidence that it gains beside the others, and what was fitted in its place."""

    hypothesis: Hypothesis
    gain: float
    alternatives: tuple[tuple[Hypothesis, float], ...]

    @property
    def probability(self) -> float:
        """Posterior probability among what was fitted in its place and that it is absent."""
        gains = np.array([self.gain, *(gain for _, gain in self.alternatives), 0.0])
        return float(np.exp(self.gain - np.logaddexp.reduce(gains)))


@dataclass(frozen=True)
class Selection:
    """A network with the causes that it supports.

    Attributes
    ----------
    fit : Fit
    choices : tuple of Choice
        The surest first.
    """

    fit: Fit
    choices: tuple[Choice, ...]

    @property
    def displaces(self) -> bool:
        """Whether a cause displaces readings or reference values: outliers and noise do not."""
        return any(not isinstance(c.hypothesis.change, NoiseFactor) for c in self.choices)


def select(network: Network, least: float = LEAST_GAIN) -> Selection:
    """Select the simple causes of a recording.

    Parameters
    ----------
    network : Network
    least : float
        Log evidence that each must gain.

    Raises
    ------
    NetworkError
        When the readings determine no network, whatever is wrong.
    """
    fit, before = _beginning(network), list[tuple[Fit, list[tuple[Hypothesis, Fit]]]]()
    while len(fit.hypotheses) < MOST:
        tried = _fitted(fit)
        if not tried or tried[0][1].log_evidence < fit.log_evidence + least:
            break
        chosen = _without_needless(tried[0][1], least)
        before = [(fit, tried)] if chosen is tried[0][1] else []
        fit = chosen
    return _judged_again(fit, least, before)


def identified(recording: Recording, construction: Construction | None = None) -> Selection | None:
    """The simple causes of a recording, by default beside the errors of its instrument; None where it is no network."""
    try:
        return select(Network(recording, construction or stated_construction(recording)))
    except LtsimError:
        return None


def _beginning(network: Network) -> Fit:
    """The fit with the units and senses of set-ups whose shape shows them, and without any other hypothesis.

    Without these a network bends so far that nothing else of it can be seen.
    """
    found = tuple(conventions(network.recording))
    fit = Fit.of(network, found)
    if fit is None and found:
        fit = Fit.of(network)
    if fit is None:
        raise NetworkError("the observations contradict each other so far that no network fits them")
    return fit


def _fitted(fit: Fit, barred: Sequence[Hypothesis] = ()) -> list[tuple[Hypothesis, Fit]]:
    """The hypotheses that promise most, fitted beside the others; the best first."""
    tried: list[tuple[Hypothesis, Fit]] = []
    places = {h.place for h in (*fit.hypotheses, *barred) if isinstance(h.change, NoiseFactor)}
    for promised, hypothesis in looks(fit):
        best = max((made.log_evidence for _, made in tried), default=-np.inf) - fit.log_evidence
        if promised <= 0.0 or len(tried) >= TRIED or best > promised:
            break
        if hypothesis.place in places or any(hypothesis.place == h.place for h, _ in tried):
            continue
        made = refitted(fit, hypothesis, promised)
        if made is not None:
            tried.append((hypothesis, made))
    return sorted(tried, key=lambda one: -one[1].log_evidence)


def refitted(fit: Fit, hypothesis: Hypothesis, promised: float) -> Fit | None:
    """The fit with one more hypothesis, from where the network stands, or anew where that disappoints."""
    best: Fit | None = None
    near = fit.adjustment.sightings
    for start in (replace(fit.state, extra=np.zeros(0)), None):
        try:
            made = Fit.of(fit.network, (*fit.hypotheses, hypothesis), start, None if start else near)
        except LtsimError:
            made = None
        if made is not None and (best is None or made.log_evidence > best.log_evidence):
            best = made
        if best is not None and best.log_evidence - fit.log_evidence > AFTER_ALL * promised:
            break
    return best


def _without_needless(fit: Fit, least: float) -> Fit:
    """The fit without earlier hypotheses that the last one leaves nothing to explain."""
    for h in fit.hypotheses[:-1]:
        rest = _less(fit, h)
        if rest is not None and rest.log_evidence > fit.log_evidence - least:
            fit = rest
    return fit


def _less(fit: Fit, hypothesis: Hypothesis) -> Fit | None:
    """The fit without one of its hypotheses."""
    kept = tuple(h for h in fit.hypotheses if h is not hypothesis)
    try:
        return Fit.of(fit.network, kept, replace(fit.state, extra=np.zeros(0)))
    except LtsimError:
        return None


def _judged_again(fit: Fit, least: float, before: Sequence[tuple[Fit, list[tuple[Hypothesis, Fit]]]] = ()) -> Selection:
    """Every chosen hypothesis beside the others: what it gains, and what in its place would; the better one stays.

    `before` is the fit without the last one, where that is known, with what was fitted beside it.
    """
    choices, beginning = (
        list[Choice](),
        {h.place for h in conventions(fit.network.recording)} if fit.hypotheses else set(),
    )
    for h in fit.hypotheses:
        known = [
            (rest, tried)
            for rest, tried in before
            if rest.hypotheses == fit.hypotheses[:-1] and h is fit.hypotheses[-1]
        ]
        rest = known[0][0] if known else None if h.place in beginning else _less(fit, h)
        if rest is None:  # without it there is no network
            choices.append(Choice(h, np.inf, ()))
            continue
        others = [(other, made) for other, made in (known[0][1] if known else _fitted(rest)) if other.place != h.place]
        if others and others[0][1].log_evidence > fit.log_evidence + least:
            return _judged_again(others[0][1], least)
        gains = tuple((other, made.log_evidence - rest.log_evidence) for other, made in others)
        choices.append(Choice(h, fit.log_evidence - rest.log_evidence, gains))
    return Selection(fit, tuple(sorted(choices, key=lambda c: -c.gain)))
