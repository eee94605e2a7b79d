"""Selection of the simple causes of a network by forward, backward and exchange steps, with one log evidence.

After each step the network is fitted again with the selected hypotheses, and everything else (outliers, reference
values, other hypotheses) is tested again. Nothing is corrected in advance.
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
"""Smallest gain of log evidence of a selected hypothesis: odds of 20 to 1, strong on the scale of Kass and Raftery
(1995).
"""
AMONG_MISFIT = 30.0
"""Smallest gain of log evidence of a hypothesis if all readings scatter more than declared.

A misfit of the model varies smoothly, so that neighbouring readings repeat the same information: about a tenth of the
gain is real.
"""
LARGEST_GAIN = 1e30
"""Log evidence that replaces an infinite one, of a hypothesis without which there is no network."""
MOST = 8
"""Largest number of selected hypotheses."""
BEYOND_DOUBT = 7.0
"""Log evidence of a cause (odds of 1000 to 1) from which the whole network is adjusted with it."""
SHARED = ("constant-offset", "scale-error", "orientation", "reflector-radius")
"""Kinds of causes that all readings of one observable, or of one set-up, share."""
WRONG_PLACE = 0.1
"""Misclosure of a reference value [m] above which a network that uses it may not converge."""
TRIED = 4
"""Number of hypotheses that are fitted in a step, in the order of their approximate gains."""
LARGE = 1500
"""Number of pointings from which a network that agrees as a whole is not searched place by place (5 s of processor
time).
"""
COMPUTED = 1e-6
"""Ratio of chi-square to degrees of freedom below which readings count as computed: a thousandth of
the declared noise.
"""
FEW = 0.01
"""Largest fraction of outliers at which a large network counts as consistent if the global test accepts it at
`FAMILY_LEVEL`.
"""
FAR_AMONG = 3
"""Ratio of all reference values to those far off from which the latter are omitted at the beginning: a majority."""
AFTER_ALL = 0.5
"""Fraction of its approximate gain that a hypothesis must reach from the present state; otherwise it is fitted from the
start.
"""
BENDS = 50.0
"""Log evidence of a shift of ten standard deviations; a smaller shift hardly changes the converged state."""
FULFILLED = 0.8
"""Fraction of the approximate gain reached by the first hypothesis from which the approximate gains of the others are
trusted.
"""


@dataclass(frozen=True)
class Choice:
    """Selected hypothesis, its gain of log evidence given the others, and the alternatives fitted in its place."""

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
    """Network with the simple causes that the readings support.

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
        """True if the network must be adjusted with the selected hypotheses from the start to be consistent.

        An error that all readings of a set-up or target share, or a reference value that is far off, prevents all other
        tests. Single motions and reference values have separate tests.
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
        """Motions beyond doubt, the surest of each station, for an adjustment without the other hypotheses."""
        sure = [c.hypothesis.change for c in self.choices if c.gain > BEYOND_DOUBT]
        motions: dict[tuple[str, ...], Motion] = {}
        for effect in (change.effect for change in sure if isinstance(change, Shift)):
            motion = SuddenMotion(effect.stations, time=effect.time) if isinstance(effect, StationBump) else effect
            if isinstance(motion, Motion):
                motions.setdefault(motion.stations, motion)
        return tuple(motions.values())

    @property
    def explains(self) -> bool:
        """True if the network is consistent with the selected hypotheses and none of them is doubtful.

        Excluded are set-ups in another unit or sense (their rows are read again), noise smaller than declared (its
        outliers may be none), and larger noise with remaining outliers. Reference values and tripods over marks have
        more specific tests.
        """
        changes = [c.hypothesis.change for c in self.choices]
        quieter = any(isinstance(change, NoiseFactor) and change.guess < 1.0 for change in changes)
        others = any(isinstance(change, Omission) for change in changes) or any(self.fit.problem.marks.names)
        doubtful = quieter or others or (_misfit(self.fit) and bool(self.fit.outliers.any()))
        sure = all(c.gain > BEYOND_DOUBT and c.hypothesis.kind != "unit" for c in self.choices)
        return bool(changes) and sure and not doubtful and self.fit.adjustment.p_value > FAMILY_LEVEL


LARGE_MOTION = 1000.0
"""Smallest size of a station's motion, in its standard deviations, at which other moments are fitted: a smaller one
does not distort the network.
"""
Looked = tuple[Fit, list[tuple[Hypothesis, Fit]]]
"""Fit, and the hypotheses that were fitted in addition to its own."""


@single_threaded
def select(network: Network, least: float = LEAST_GAIN) -> Selection:
    """Selection of the simple causes of a recording.

    Parameters
    ----------
    network : Network
    least : float
        Smallest gain of log evidence.

    Raises
    ------
    NetworkError
        If the readings determine no network with any hypothesis.
    """
    fit = beginning = _beginning(network)
    last: Looked | None = None
    required: list[Hypothesis] = []
    while len(fit.hypotheses) < MOST and not _agrees(fit):
        tried = _fitted(fit)
        needed = least if not _misfit(fit) else AMONG_MISFIT
        if not tried or tried[0][1].log_evidence < fit.log_evidence + needed:
            break
        best = _at_best_moment(tried[0][1])
        chosen = _without_needless(best, least, len(beginning.hypotheses), required)
        last = (fit, tried) if chosen is tried[0][1] else None
        fit = chosen
    return _judged_again(fit, least, beginning, last, required)


def _at_best_moment(fit: Fit) -> Fit:
    """Fit with the best moment of a station's motion that was accepted last, if any.

    The score of a moment is linear. A large motion distorts the network in which it is computed, so that the moment
    with the best score may be several pointings off; the readings between would then look like further causes.
    """
    *others, last = fit.hypotheses
    change = last.change
    if not isinstance(change, Shift) or not isinstance(change.effect, StationBump) or fit.length(last) < LARGE_MOTION:
        return fit
    first, bumps = change.effect, StationBump.candidates(fit.adjustment.sightings)
    bumps = [bump for bump in bumps if bump.stations == first.stations]
    now, step = int(np.argmin([abs(bump.time - first.time) for bump in bumps])), max(len(bumps) // 4, 1)
    while step:
        for at in (now - step, now + step):
            if not 0 <= at < len(bumps):
                continue
            moved = replace(last, change=replace(change, effect=bumps[at]))
            try:
                made = Fit.of(fit.network, (*others, moved), replace(fit.state, extra_parameters=np.zeros(0)))
            except LtsimError:
                continue
            if made is not None and made.log_evidence > fit.log_evidence:
                fit, now = made, at
                break
        else:
            step //= 2
    return fit


def _misfit(fit: Fit) -> bool:
    """True if all readings scatter more than declared, so that residuals may come from a misfit of the model."""
    general = (h.change for h in fit.hypotheses if not h.stations and not h.targets)
    return any(isinstance(change, NoiseFactor) and change.guess > 1.0 for change in general)


def _agrees(fit: Fit) -> bool:
    """True if a large network, or one of computed readings, is consistent as a whole, so that no place is searched.

    In a network of `LARGE` pointings an error at one place has little influence on the others.
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
    """Simple causes of a recording, by default with instrument errors in the model; None if it is no network.

    NetworkError where it holds too many pointings.
    """
    recording.require_at_most(ADJUSTED_POINTINGS, "an adjustment")
    try:
        return select(Network(recording, construction or declared_construction(recording), prior))
    except LtsimError:
        return None


def _beginning(network: Network) -> Fit:
    """Initial fit with corrected units and senses of set-ups, and without reference values that are far off.

    These would distort the network too much for any other test.
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
    """Fitted hypotheses with the largest approximate gains (at least `at_least`), the best first.

    If the first reaches its approximate gain, only hypotheses that may explain the same readings are fitted too,
    because the order of causes at different places has no influence.
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
    """Fit with one more hypothesis, from the present state, or from the start if its gain is too small."""
    best: Fit | None = None
    near = fit.adjustment.sightings
    for start in (replace(fit.state, extra_parameters=np.zeros(0)), None):
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
    """Fit without hypotheses that are no longer needed.

    Of the `first` hypotheses, with which the fit started, only omitted reference values may be removed, because without
    the others there is no network. Hypotheses in `required` also remain; any that prove to be necessary are added to
    it.
    """
    for i, h in enumerate(fit.hypotheses[:-1]):
        if (i < first and not isinstance(h.change, Omission)) or not h.competes(fit.hypotheses[-1]):
            continue
        rest = _less(fit, h, required)
        if rest is not None and rest.log_evidence > fit.log_evidence - least:
            fit = rest
    return fit


def _less(fit: Fit, hypothesis: Hypothesis, required: list[Hypothesis]) -> Fit | None:
    """Fit without one of its hypotheses; None, and an entry in `required`, if there is no network without it."""
    if any(h is hypothesis for h in required):
        return None
    others = tuple(h for h in fit.hypotheses if h is not hypothesis)
    try:
        rest = Fit.of(fit.network, others, replace(fit.state, extra_parameters=np.zeros(0)))
    except LtsimError:
        rest = None
    if rest is None:
        required.append(hypothesis)
    return rest


def _judged_again(fit: Fit, least: float, beginning: Fit, last: Looked | None, required: list[Hypothesis]) -> Selection:
    """Selection in which every chosen hypothesis is compared again with its alternatives, given the others.

    Without those of the `beginning` there is no network. `last` are the hypotheses that were fitted in place of the
    last one.
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
