"""Refinement of selected hypotheses: times of station motions, and one simpler cause in place of several."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ltsim.adjustment.identification.cause_selection import DISPLACED_REFLECTOR_KINDS
from ltsim.adjustment.identification.fit import NetworkFit
from ltsim.adjustment.identification.hypothesis import CauseHypothesis, ReadingShiftChange, ReferenceOmission
from ltsim.adjustment.identification.hypothesis_library import reference_omissions, shift_candidates
from ltsim.adjustment.reference_snooping import MIN_OTHERS_TO_IDENTIFY_WRONG_VALUE
from ltsim.core.errors import LtsimError
from ltsim.physics.effects.station_bump import StationBump
from ltsim.physics.effects.station_settling import StationSettling
from ltsim.solve.gauss_newton import MAX_DECISION_CHANGES

MIN_MOTION_SIGMAS_FOR_REFINEMENT = 1000.0
"""Limit of the size of a sudden station motion, in its standard deviations. For a larger motion, other times of the
motion are fitted too. A smaller motion distorts the network so little that the linear approximation selects the right
time."""


def refine_motion_time(fit: NetworkFit) -> NetworkFit:
    """Fit with an improved time of a sudden station motion, if this is the hypothesis selected last.

    The time was selected by a linear approximation in the network without the motion. A large motion distorts this
    network, so that the selected time may be several pointings off. The pointings between the selected and the true
    time would then appear as further causes.
    """
    *others, last = fit.hypotheses
    change = last.model_change
    if (
        not isinstance(change, ReadingShiftChange)
        or not isinstance(change.effect, StationBump)
        or fit.estimate_length_in_sigmas(last) < MIN_MOTION_SIGMAS_FOR_REFINEMENT
    ):
        return fit
    first, bumps = change.effect, StationBump.candidates(fit.adjustment.sightings)
    bumps = [bump for bump in bumps if bump.stations == first.stations]
    variants = [(*others, replace(last, model_change=replace(change, effect=bump))) for bump in bumps]
    now, step = int(np.argmin([abs(bump.time - first.time) for bump in bumps])), max(len(bumps) // 4, 1)
    while step:
        neighbours = [at for at in (now - step, now + step) if 0 <= at < len(bumps)]
        better_fits = ((at, better_fit_or_none(fit, variants[at])) for at in neighbours)
        now, better_fit = next(((at, made) for at, made in better_fits if made is not None), (now, None))
        step, fit = (step // 2, fit) if better_fit is None else (step, better_fit)
    return fit


def refine_time_constant(fit: NetworkFit) -> NetworkFit:
    """Fit with an improved time constant of a settling station, if this is the hypothesis selected last.

    The approximate tests of all hypotheses try only a few time constants. The readings of a large motion that another
    time constant does not explain would appear as further causes.
    """
    *others, last = fit.hypotheses
    change = last.model_change
    if not isinstance(change, ReadingShiftChange) or not isinstance(change.effect, StationSettling):
        return fit
    grid = change.effect.shape_parameters[0].grid_values()
    log_step = float(np.log(grid[1] / grid[0]))
    effect = change.effect
    for _ in range(MAX_DECISION_CHANGES):
        log_step *= 0.5
        for sign in (-1.0, 1.0):
            tried = replace(effect, time_constant=effect.time_constant * float(np.exp(sign * log_step)))
            better = better_fit_or_none(fit, (*others, replace(last, model_change=replace(change, effect=tried))))
            if better is not None:
                fit, effect = better, tried
                break
    return fit


def join_displacements(fit: NetworkFit) -> NetworkFit:
    """Fit with one motion of a target in place of several displacements, if its log evidence is larger.

    After a motion the reflector is displaced at all later stations. The stations are selected one after the other, so
    that such a motion may appear as a badly seated reflector at one station and a motion at the next one.
    """
    last = fit.hypotheses[-1]
    joined = [h for h in fit.hypotheses if h.kind in DISPLACED_REFLECTOR_KINDS and h.targets == last.targets]
    if len(joined) < 2 or last not in joined:
        return fit
    others = tuple(h for h in fit.hypotheses if h not in joined)
    displacement = fit.estimate_and_covariance(last)[0]
    candidates = (
        c
        for c in shift_candidates(fit.adjustment.sightings)
        if c.family.kind == "target-moved" and c.place.targets == last.targets
    )
    fits = (better_fit_or_none(fit, (*others, c.make_hypothesis(displacement))) for c in candidates)
    return max((made for made in fits if made is not None), key=lambda made: made.log_evidence, default=fit)


def join_reference_errors(fit: NetworkFit) -> NetworkFit:
    """Fit with one error in place of several errors of reference values and scale, if its log evidence is larger.

    A scale error of all distances contradicts each reference value, and the values with the largest contradictions may
    have been excluded before the scale was tested. Of a few reference values, a right one may have been excluded
    because a wrong one contradicts it; each other single value is then tested in place of all errors.
    """
    wrong = [h for h in fit.hypotheses if _concerns_reference_values(h)]
    if len(wrong) < 2 or fit.hypotheses[-1] not in wrong:
        return fit
    others = tuple(h for h in fit.hypotheses if h not in wrong)
    scales = (c for c in shift_candidates(fit.adjustment.sightings) if c.family.kind == "scale-error")
    single = [c.make_hypothesis(np.zeros(1)) for c in scales if not c.place.stations]
    remaining = reference_omissions(fit)
    if len(remaining) < MIN_OTHERS_TO_IDENTIFY_WRONG_VALUE:
        single += remaining
    fits = (better_fit_or_none(fit, (*others, hypothesis)) for hypothesis in single)
    return max((made for made in fits if made is not None), key=lambda made: made.log_evidence, default=fit)


def _concerns_reference_values(hypothesis: CauseHypothesis) -> bool:
    """True for a wrong reference value, and for a scale error of all reference lengths or of all distances."""
    is_common_scale = hypothesis.kind == "reference-scale" or (
        hypothesis.kind == "scale-error" and not hypothesis.stations
    )
    return is_common_scale or isinstance(hypothesis.model_change, ReferenceOmission)


def better_fit_or_none(fit: NetworkFit, hypotheses: tuple[CauseHypothesis, ...]) -> NetworkFit | None:
    """Fit with other hypotheses, started at the state of `fit`; None if its log evidence is not larger."""
    made = fit_or_none(fit, hypotheses)
    return made if made is not None and made.log_evidence > fit.log_evidence else None


def fit_or_none(fit: NetworkFit, hypotheses: tuple[CauseHypothesis, ...]) -> NetworkFit | None:
    """Fit with other hypotheses, started at the state of `fit`; None if no fit is possible."""
    try:
        return NetworkFit.from_start(fit.fit_input, hypotheses, replace(fit.state, extra_parameters=np.zeros(0)))
    except LtsimError:
        return None
