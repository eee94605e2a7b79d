"""Selection of the simple causes that a network supports: forward, backward and exchange, by one log evidence.

After each step the network is fitted anew with what was chosen, and everything is looked at again beside it: outliers,
reference values, the other hypotheses. Nothing is corrected before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ltsim.adjustment.identification.fit import Fit, Network
from ltsim.adjustment.identification.hypothesis import Exchange, Hypothesis, NoiseFactor, Omission, Shift
from ltsim.adjustment.identification.library import conventions, exchanges, omissions_of
from ltsim.adjustment.identification.screen import looks
from ltsim.adjustment.prior import ParameterPrior
from ltsim.adjustment.significance import FAMILY_LEVEL, NOT_EXCLUDED
from ltsim.adjustment.snooping import LARGEST_ERROR
from ltsim.adjustment.station_motions import Motion, SuddenMotion
from ltsim.core.arrays import Floats
from ltsim.core.errors import LtsimError, NetworkError
from ltsim.core.limits import ADJUSTED_POINTINGS
from ltsim.physics.effects.station_bump import StationBump
from ltsim.physics.model.construction import Construction, declared_construction
from ltsim.recordings.recording import Recording
from ltsim.solve.threads import single_threaded

LEAST_GAIN = 3.0
"""Log evidence that a hypothesis must gain: odds of 20 to 1, on the scale of Kass and Raftery (1995) strong."""
AMONG_MISFIT = 30.0
"""Log evidence that a hypothesis must gain where all readings scatter more than declared.

A misfit of the model varies smoothly, so that its readings count several times: a tenth of this is what they tell.
"""
LARGEST_GAIN = 1e30
"""Log evidence in place of an infinite one: of a hypothesis without which there is no network."""
MOST = 8
"""Hypotheses that are chosen at most: a network with more simple causes is measured again."""
BEYOND_DOUBT = 7.0
"""Log evidence of a cause, odds of 1000 to 1, from which the whole network is adjusted with it."""
SHARED = ("constant-offset", "scale-error", "orientation", "reflector-radius")
"""Kinds of causes that all readings of one observable, or of one set-up, share."""
WRONG_PLACE = 0.1
"""[m] Miss of a reference value from which a network that is adjusted with it may not converge."""
TRIED = 4
"""Hypotheses that are fitted in a step, in the order of what they promise."""
LARGE = 1500
"""Pointings from which a network that agrees as a whole is not looked at place by place: 5 s of processor time."""
COMPUTED = 1e-6
"""Chi-square over degrees of freedom below which readings are computed: a thousandth of the declared noise."""
FEW = 0.01
"""Share of outliers below which a large network agrees, if the global test accepts it at `FAMILY_LEVEL`."""
FAR_AMONG = 3
"""Reference values among which one may be far off and omitted at the beginning: of more no majority tells which."""
AFTER_ALL = 0.5
"""Share of its promise that a hypothesis must gain from where the network stands; else it is fitted from the start."""
BENDS = 50.0
"""Log evidence of a shift of ten standard deviations; a smaller shift hardly changes where a network converges."""
FULFILLED = 0.8
"""Share of its promise, a quadratic form at the present state, from which the look at the others may be trusted too."""


@dataclass(frozen=True)
class Choice:
    """A chosen hypothesis, the log evidence that it gains beside the others, and what was fitted in its place."""

    hypothesis: Hypothesis
    gain: float
    alternatives: tuple[tuple[Hypothesis, float], ...]

    @property
    def probabilities(self) -> Floats:
        """Posterior probabilities (2 + k,) of the hypothesis, of its k alternatives, and of none of them."""
        gains = np.minimum([self.gain, *(gain for _, gain in self.alternatives), 0.0], LARGEST_GAIN)
        return np.asarray(np.exp(gains - np.logaddexp.reduce(gains)))


@dataclass(frozen=True)
class Selection:
    """A network with the causes that it supports.

    Attributes
    ----------
    fit : Fit
    choices : tuple of Choice
        Shifts first, then noise; of each the surest first.
    """

    fit: Fit
    choices: tuple[Choice, ...]

    @property
    def leads(self) -> bool:
        """True if the network must be adjusted with the selected hypotheses from the start, because they make it agree.

        With an error that all readings of a set-up or a target share, or a reference value that is far off, nothing
        else of a network can be judged. Single motions and reference values are left to their own tests.
        """
        sure = [c.hypothesis for c in self.choices if c.gain > BEYOND_DOUBT]
        shared = [h for h in sure if h.kind in SHARED]
        values = [h for h in sure if h.kind == "reference-value" and h.acts_on != "mark"]
        far = [h for h in values if self.fit.displacement(h) > WRONG_PLACE]
        exchanged = any(isinstance(h.change, Exchange) for h in sure)
        gross = exchanged or any(self.fit.displacement(h) > LARGEST_ERROR for h in shared) or len(far) == 1
        noisy = any(isinstance(c.hypothesis.change, NoiseFactor) for c in self.choices)
        return gross or (bool(shared) and not noisy and self.fit.adjustment.p_value > FAMILY_LEVEL)

    @property
    def motions(self) -> tuple[Motion, ...]:
        """Motions of stations beyond doubt, for an adjustment that is not made with all selected hypotheses."""
        sure = [c.hypothesis.change for c in self.choices if c.gain > BEYOND_DOUBT]
        effects = [change.effect for change in sure if isinstance(change, Shift)]
        sudden = (SuddenMotion(e.stations, time=e.time) if isinstance(e, StationBump) else e for e in effects)
        return tuple(motion for motion in sudden if isinstance(motion, Motion))

    @property
    def explains(self) -> bool:
        """True if the network agrees with the selected hypotheses and none of these is in doubt.

        A set-up in another unit or sense is no such choice, for its rows are to be read anew; nor is noise that is
        less than declared, for what it makes outliers of may be none; nor more noise where outliers remain. Reference
        values and tripods over marks have tests that know more about them.
        """
        changes = [c.hypothesis.change for c in self.choices]
        quieter = any(isinstance(change, NoiseFactor) and change.guess < 1.0 for change in changes)
        others = any(isinstance(change, Omission) for change in changes) or any(self.fit.problem.marks.names)
        doubtful = quieter or others or (_misfit(self.fit) and bool(self.fit.outliers.any()))
        sure = all(c.gain > BEYOND_DOUBT and c.hypothesis.kind != "unit" for c in self.choices)
        return bool(changes) and sure and not doubtful and self.fit.adjustment.p_value > FAMILY_LEVEL


Looked = tuple[Fit, list[tuple[Hypothesis, Fit]]]
"""A fit, and the hypotheses that were fitted beside its own."""


@single_threaded
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
    fit = beginning = _beginning(network)
    last: Looked | None = None
    required: list[Hypothesis] = []
    while len(fit.hypotheses) < MOST and not _agrees(fit):
        tried = _fitted(fit)
        needed = least if not _misfit(fit) else AMONG_MISFIT
        if not tried or tried[0][1].log_evidence < fit.log_evidence + needed:
            break
        chosen = _without_needless(tried[0][1], least, len(beginning.hypotheses), required)
        last = (fit, tried) if chosen is tried[0][1] else None
        fit = chosen
    return _judged_again(fit, least, beginning, last, required)


def _misfit(fit: Fit) -> bool:
    """True if all readings scatter more than declared, so that residuals may come from a misfit of the model."""
    general = (h.change for h in fit.hypotheses if not h.stations and not h.targets)
    return any(isinstance(change, NoiseFactor) and change.guess > 1.0 for change in general)


def _agrees(fit: Fit) -> bool:
    """True if a large network, or one of computed readings, agrees as a whole, so that no place is searched.

    In a network of `LARGE` pointings what one place hides is small for all others.
    """
    if fit.solution.cost < COMPUTED * fit.problem.dof:
        return True
    if len(fit.recording) < LARGE:
        return False
    return (
        fit.adjustment.p_value > FAMILY_LEVEL and not fit.hypotheses and fit.outliers.sum() < FEW * fit.whole.use.sum()
    )


def identified(
    recording: Recording, construction: Construction | None = None, prior: ParameterPrior | None = None
) -> Selection | None:
    """The simple causes of a recording, by default beside the errors of its instrument; None where it is no network.

    NetworkError where it holds too many pointings.
    """
    recording.require_at_most(ADJUSTED_POINTINGS, "an adjustment")
    try:
        return select(Network(recording, construction or declared_construction(recording), prior))
    except LtsimError:
        return None


def _beginning(network: Network) -> Fit:
    """The fit with the units and senses of set-ups whose shape shows them, without reference values that are far off.

    With these a network bends so far that nothing else of it can be seen.
    """
    corrections = conventions(network.recording)
    far, count = Fit.far_references(network, corrections)
    if any(value.kind == "point" for value in far) and (names := exchanges(network.recording)):
        corrections = [*corrections, *names]
        far, count = Fit.far_references(network, corrections)
    omitted = omissions_of(network.recording, far) if FAR_AMONG * len(far) <= max(count, FAR_AMONG) else []
    fit = Fit.of(network, (*corrections, *omitted))
    if fit is None and (corrections or omitted):
        fit = Fit.of(network)
    if fit is None:
        raise NetworkError("the observations contradict each other so far that no network fits them")
    return fit


def _fitted(fit: Fit, at_least: float = 0.0, instead_of: Hypothesis | None = None) -> list[tuple[Hypothesis, Fit]]:
    """The hypotheses that promise most, `at_least` so much log evidence, fitted beside the others; the best first.

    Where the first keeps its promise, only what may explain the same readings is fitted beside it: the order in which
    causes at different places are chosen does not matter.
    """
    first, attempts = 0.0, 0
    tried: list[tuple[Hypothesis, Fit]] = []
    places = {h.place for h in fit.hypotheses if isinstance(h.change, NoiseFactor)}
    places |= {instead_of.place} if instead_of is not None else set()
    for promised, hypothesis in looks(fit):
        best = max((made.log_evidence for _, made in tried), default=-np.inf) - fit.log_evidence
        if promised <= max(at_least, 0.0) or attempts >= TRIED or best > promised:
            break
        if hypothesis.place in places or any(hypothesis.place == h.place for h, _ in tried):
            continue
        if tried and best > FULFILLED * first and not hypothesis.competes(tried[0][0]):
            continue
        first, attempts = promised if not attempts else first, attempts + 1
        made = refitted(fit, hypothesis, promised)
        if made is not None:
            tried.append((hypothesis, made))
    return sorted(tried, key=lambda pair: -pair[1].log_evidence)


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
        disappoints = best is None or best.log_evidence - fit.log_evidence < AFTER_ALL * promised
        if not disappoints or promised < BENDS:
            break
    return best


def _without_needless(fit: Fit, least: float, first: int, required: list[Hypothesis]) -> Fit:
    """The fit without hypotheses that the last one leaves nothing to explain.

    Of the `first`, with which the fit began, only omitted reference values are tried: without the others is no network.
    Nor is one without those `required`, to which each hypothesis is added that shows to be such.
    """
    for i, h in enumerate(fit.hypotheses[:-1]):
        if (i < first and not isinstance(h.change, Omission)) or not h.competes(fit.hypotheses[-1]):
            continue
        rest = _less(fit, h, required)
        if rest is not None and rest.log_evidence > fit.log_evidence - least:
            fit = rest
    return fit


def _less(fit: Fit, hypothesis: Hypothesis, required: list[Hypothesis]) -> Fit | None:
    """The fit without one of its hypotheses; None, and an entry in `required`, where there is no network without it."""
    if any(h is hypothesis for h in required):
        return None
    others = tuple(h for h in fit.hypotheses if h is not hypothesis)
    try:
        rest = Fit.of(fit.network, others, replace(fit.state, extra=np.zeros(0)))
    except LtsimError:
        rest = None
    if rest is None:
        required.append(hypothesis)
    return rest


def _judged_again(fit: Fit, least: float, beginning: Fit, last: Looked | None, required: list[Hypothesis]) -> Selection:
    """Every chosen hypothesis beside the others: what it gains, and what in its place would; the better one stays.

    Those of the `beginning` have no network without them. `last` is what was fitted beside all but the last one.
    """
    choices = [Choice(h, np.inf, ()) for h in fit.hypotheses if h in beginning.hypotheses]
    for h in fit.hypotheses[len(choices) :]:
        is_last = last is not None and h is fit.hypotheses[-1] and last[0].hypotheses == fit.hypotheses[:-1]
        rest = last[0] if last is not None and is_last else _less(fit, h, required)
        if rest is None:
            choices.append(Choice(h, np.inf, ()))
            continue
        gain = fit.log_evidence - rest.log_evidence
        tried = last[1] if last is not None and is_last else _fitted(rest, gain + float(np.log(NOT_EXCLUDED)), h)
        others = [(other, made) for other, made in tried if other.place != h.place]
        if others and others[0][1].log_evidence > fit.log_evidence + least:
            return _judged_again(others[0][1], least, beginning, None, required)
        gains = tuple((other, made.log_evidence - rest.log_evidence) for other, made in others)
        choices.append(Choice(h, gain, gains))
    # Noise beside a shift is what the shift leaves, for nests or times that are not exactly as declared.
    return Selection(fit, tuple(sorted(choices, key=lambda c: (isinstance(c.hypothesis.change, NoiseFactor), -c.gain))))
