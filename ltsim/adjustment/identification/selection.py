"""Selection of hypotheses on the causes of a misfit by log evidence, in forward, backward and exchange steps.

`select_causes` is the loop. Its steps are `_forward_step`, `_backward_step` and `_exchange_step`. After each step the
network is fitted again with the selected hypotheses, and outliers, reference values and all other hypotheses are tested
again. No reading is corrected in advance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ltsim.adjustment.identification.cause_selection import (
    CauseSelection,
    SelectedHypothesis,
    has_larger_noise_of_all_readings,
)
from ltsim.adjustment.identification.evidence import LOG_PRIOR_ODDS_OF_CENTRING, log_prior_of_kind
from ltsim.adjustment.identification.fit import FitInput, NetworkFit
from ltsim.adjustment.identification.hypothesis import (
    CauseHypothesis,
    CentringChange,
    NoiseFactorChange,
    ReadingShiftChange,
    ReferenceOmission,
)
from ltsim.adjustment.identification.hypothesis_library import (
    convention_corrections,
    omissions_of_reference_values,
)
from ltsim.adjustment.identification.motion_refinement import (
    fit_or_none,
    join_displacements,
    join_reference_errors,
    refine_motion_time,
    refine_time_constant,
)
from ltsim.adjustment.identification.reading_shifts import ReadingShift
from ltsim.adjustment.identification.reference_geometry import common_scale_error, reference_point_exchanges
from ltsim.adjustment.identification.screening import MAX_FITTED_HYPOTHESES, screened_hypotheses
from ltsim.adjustment.prior import ParameterPrior
from ltsim.adjustment.significance import FAMILY_WISE_LEVEL, MIN_LOG_EVIDENCE_GAIN, MIN_REPORTED_PROBABILITY
from ltsim.adjustment.snooping import without_copied_rows
from ltsim.core.errors import LtsimError, NetworkError
from ltsim.core.limits import MAX_ADJUSTED_POINTINGS, MAX_ADJUSTED_TARGETS
from ltsim.core.parallel import single_threaded
from ltsim.physics.model.construction import GeometricErrorModel, declared_construction
from ltsim.recordings.recording import Recording

MAX_SELECTED_HYPOTHESES = 8
"""Largest number of hypotheses on causes of a misfit that are selected for one network."""
MAX_CAUSES_COMPARED_WITH_CENTRING = 3
"""Largest number of causes other than centring errors that together are compared with centring errors."""
MIN_POINTINGS_LARGE_NETWORK = 1500
"""Smallest number of pointings of a large network. If a large network passes the global test, no causes are searched,
which saves 5 s of processor time.
"""
MAX_CHI2_RATIO_OF_COMPUTED_READINGS = 1e-6
"""Limit of chi-square divided by the degrees of freedom. Readings with a smaller ratio were computed, not measured:
their residuals are below a thousandth of the declared noise."""
MAX_OUTLIER_FRACTION_OF_CONSISTENT_NETWORK = 0.01
"""Largest fraction of outliers in a consistent large network, which also passes the global test at the level
`FAMILY_WISE_LEVEL`."""
MIN_REFERENCES_PER_WRONG_REFERENCE = 3
"""Limit of the number of all reference values, divided by the number of values with large misclosures. If the ratio is
larger, the values with large misclosures are excluded before the search for other causes, because the remaining values
are a clear majority."""
MIN_GAIN_FRACTION_WITHOUT_RESTART = 0.5
"""Limit of the gain of log evidence by one more hypothesis, divided by the gain that a linear approximation predicts.
If the ratio is smaller, the fit is repeated from new start values."""
MIN_LOG_EVIDENCE_FOR_RESTART = 50.0
"""Smallest gain of log evidence, predicted by a linear approximation, for which a fit may be repeated from new start
values: the gain by a shift of ten standard deviations. A smaller shift hardly changes the converged state."""
MIN_GAIN_FRACTION_FOR_RIVALS_ONLY = 0.8
"""Limit of the gain of log evidence by the first fitted hypothesis, divided by the gain that a linear approximation
predicts. If the ratio is larger, the only further fits are those of its rivals, which may explain the same readings."""
RankedTrialFits = tuple[tuple[CauseHypothesis, NetworkFit], ...]
"""Hypotheses that were added to a fit on trial, each with the resulting fit; the fit with the largest log evidence
first.
"""


@dataclass(frozen=True)
class CauseSelectionState:
    """Selected hypotheses on the causes of a misfit during the selection; each step returns a new state."""

    fit: NetworkFit
    """Network fit with the hypotheses that are selected so far."""
    min_gain: float
    """Smallest gain of log evidence at which a hypothesis is selected."""
    initial_hypotheses: tuple[CauseHypothesis, ...]
    """Hypotheses of the first fit: wrong units, and reference values with large misclosures."""
    indispensable_hypotheses: tuple[CauseHypothesis, ...] = ()
    """Hypotheses without which no fit was possible in an earlier step."""
    fit_before_trial_fits: NetworkFit | None = None
    """Fit before the latest forward step (addition of a hypothesis); None if another step changed the fit since then.
    """
    trial_fits: RankedTrialFits = ()
    """Trial fits of the latest forward step (addition of a hypothesis), the first of which is `fit`; empty if another
    step changed the fit since then."""

    def trial_fits_in_place_of(self, hypothesis: CauseHypothesis) -> tuple[NetworkFit, RankedTrialFits] | None:
        """Fit without `hypothesis`, and trial fits in its place; None unless the latest forward step selected it."""
        hypotheses, before = self.fit.hypotheses, self.fit_before_trial_fits
        is_last = before is not None and hypothesis is hypotheses[-1] and before.hypotheses == hypotheses[:-1]
        return (before, self.trial_fits) if before is not None and is_last else None


@single_threaded
def select_causes(fit_input: FitInput, min_gain: float = MIN_LOG_EVIDENCE_GAIN) -> CauseSelection:
    """Hypotheses on the causes of a misfit that increase the log evidence of the network, and the fit with them.

    Parameters
    ----------
    fit_input : FitInput
    min_gain : float
        Smallest gain of log evidence at which a hypothesis is selected.

    Raises
    ------
    NetworkError
        If the readings determine no network with any hypothesis.
    """
    initial_fit = _initial_fit(fit_input)
    state = CauseSelectionState(initial_fit, min_gain, initial_fit.hypotheses)
    is_growing = True
    while True:
        grown = _forward_step(state) if is_growing else None
        if grown is not None:
            state = _backward_step(grown)
            continue
        is_growing = False
        exchanged = _exchange_step(state)
        if isinstance(exchanged, CauseSelection):
            return exchanged
        state = exchanged


def _forward_step(state: CauseSelectionState) -> CauseSelectionState | None:
    """Selection with one more hypothesis, which increases the log evidence most; None if no increase is large enough.

    Instead of centring errors, several other hypotheses are added if their log evidence is larger.
    """
    fit = state.fit
    if len(fit.hypotheses) >= MAX_SELECTED_HYPOTHESES or _is_consistent_as_a_whole(fit):
        return None
    trial_fits = _fit_best_hypotheses(fit)
    needed = state.min_gain if not has_larger_noise_of_all_readings(fit) else -LOG_PRIOR_ODDS_OF_CENTRING
    if not trial_fits or trial_fits[0][1].log_evidence < fit.log_evidence + needed:
        return None
    best = refine_time_constant(refine_motion_time(trial_fits[0][1]))
    best = join_reference_errors(join_displacements(best))
    if isinstance(trial_fits[0][0].model_change, CentringChange):
        best = max(best, _fit_with_other_causes(fit, needed, best), key=lambda made: made.log_evidence)
    return replace(state, fit=best, fit_before_trial_fits=fit, trial_fits=trial_fits)


def _backward_step(state: CauseSelectionState) -> CauseSelectionState:
    """Selection without those hypotheses whose removal decreases the log evidence by less than its `min_gain`.

    Only hypotheses that may explain the same readings as the hypothesis selected last are tried. Of the initial
    hypotheses only exclusions of reference values may be removed, because no network can be fitted without the other
    initial hypotheses.
    """
    fit, indispensable = state.fit, state.indispensable_hypotheses
    for i, h in enumerate(fit.hypotheses[:-1]):
        is_initial = i < len(state.initial_hypotheses) and not isinstance(h.model_change, ReferenceOmission)
        if is_initial or not h.competes_with(fit.hypotheses[-1]):
            continue
        rest, indispensable = _fit_without_hypothesis(fit, h, indispensable)
        if rest is not None and rest.log_evidence > fit.log_evidence - state.min_gain:
            fit = rest
    is_trial = bool(state.trial_fits) and fit is state.trial_fits[0][1]
    return replace(
        state,
        fit=fit,
        indispensable_hypotheses=indispensable,
        fit_before_trial_fits=state.fit_before_trial_fits if is_trial else None,
        trial_fits=state.trial_fits if is_trial else (),
    )


def _exchange_step(state: CauseSelectionState) -> CauseSelectionState | CauseSelection:
    """Selection with one hypothesis exchanged for a better alternative; without such an alternative, the final result.

    Every hypothesis is compared with its alternatives, given the other hypotheses. The hypotheses of the initial fit
    are not compared, because no network can be fitted without them.
    """
    fit, indispensable = state.fit, state.indispensable_hypotheses
    choices = [SelectedHypothesis(h, np.inf, ()) for h in fit.hypotheses if h in state.initial_hypotheses]
    for h in fit.hypotheses[len(choices) :]:
        rest_and_trials = state.trial_fits_in_place_of(h)
        if rest_and_trials is None:
            rest, indispensable = _fit_without_hypothesis(fit, h, indispensable)
        else:
            rest = rest_and_trials[0]
        if rest is None:
            choices.append(SelectedHypothesis(h, np.inf, ()))
            continue
        gain = fit.log_evidence - rest.log_evidence
        trial_fits = (
            _fit_best_hypotheses(rest, gain + float(np.log(MIN_REPORTED_PROBABILITY)), h)
            if rest_and_trials is None
            else rest_and_trials[1]
        )
        others = [(other, made) for other, made in trial_fits if other.place_key != h.place_key]
        if others and others[0][1].log_evidence > fit.log_evidence + state.min_gain:
            return CauseSelectionState(others[0][1], state.min_gain, state.initial_hypotheses, indispensable)
        gains = tuple((other, made.log_evidence - rest.log_evidence) for other, made in others)
        choices.append(SelectedHypothesis(h, gain, gains))
    # Random errors come after shifts: they may be remainders of a shift whose nests or times are not exactly known.
    random_errors = NoiseFactorChange | CentringChange
    choices.sort(key=lambda c: (isinstance(c.hypothesis.model_change, random_errors), -c.log_evidence_gain))
    return CauseSelection(fit, tuple(choices))


def _fit_with_other_causes(fit: NetworkFit, min_gain_needed: float, rival: NetworkFit) -> NetworkFit:
    """Fit with up to `MAX_CAUSES_COMPARED_WITH_CENTRING` more causes, instead of the fit `rival` with centring errors.

    Centring errors also fit the sum of several other causes. Each additional cause must gain at least
    `min_gain_needed`.
    """
    for n_remaining in range(MAX_CAUSES_COMPARED_WITH_CENTRING, 0, -1):
        smallest = (rival.log_evidence - fit.log_evidence) / n_remaining
        tried = _fit_best_hypotheses(fit, smallest, excluded_change_types=(CentringChange, NoiseFactorChange))
        if not tried or tried[0][1].log_evidence < fit.log_evidence + min_gain_needed:
            break
        fit = tried[0][1]
    return fit


def _is_consistent_as_a_whole(fit: NetworkFit) -> bool:
    """True if no search for causes is necessary: the readings are computed, or a large network passes the global test.

    In a network with `MIN_POINTINGS_LARGE_NETWORK` pointings an error at one station or target has little influence on
    other stations and targets.
    """
    if fit.solution.sum_of_squares < MAX_CHI2_RATIO_OF_COMPUTED_READINGS * fit.problem.dof:
        return True
    if len(fit.recording) < MIN_POINTINGS_LARGE_NETWORK:
        return False
    return (
        fit.adjustment.p_value > FAMILY_WISE_LEVEL
        and not fit.hypotheses
        and fit.is_outlier.sum()
        < MAX_OUTLIER_FRACTION_OF_CONSISTENT_NETWORK * fit.problem_with_all_readings.is_used_reading.sum()
    )


def identify_causes(
    recording: Recording, construction: GeometricErrorModel | None = None, prior: ParameterPrior | None = None
) -> CauseSelection | None:
    """Identified causes of the misfit of a recording, as selected hypotheses; None if no network can be fitted.

    `construction` is the geometric error model, by default that of the declared instrument; `prior` is the prior of its
    parameters. Raises NetworkError for a recording with too many pointings.
    """
    recording.require_at_most(MAX_ADJUSTED_POINTINGS, MAX_ADJUSTED_TARGETS, "an adjustment")
    recording, _ = without_copied_rows(recording)
    try:
        return select_causes(FitInput(recording, construction or declared_construction(recording), prior))
    except LtsimError:
        return None


def _initial_fit(fit_input: FitInput) -> NetworkFit:
    """Initial fit, with corrected units and senses of rotation of set-ups, and without clearly wrong reference values.

    These errors would distort the network too much for other tests.
    """
    corrections = convention_corrections(fit_input.recording)
    if not corrections and (scaled_fit := _fit_with_common_scale(fit_input)) is not None:
        return scaled_fit
    far, count, state = NetworkFit.references_with_large_residuals(fit_input, corrections)
    if any(value.kind == "point" for value in far) and (names := reference_point_exchanges(fit_input.recording)):
        corrections = [*corrections, *names]
        far, count, state = NetworkFit.references_with_large_residuals(fit_input, corrections)
    omitted = (
        omissions_of_reference_values(fit_input.recording, far)
        if MIN_REFERENCES_PER_WRONG_REFERENCE * len(far) <= max(count, MIN_REFERENCES_PER_WRONG_REFERENCE)
        else []
    )
    fit = NetworkFit.from_start(fit_input, (*corrections, *omitted), robust_state=None if omitted else state)
    if fit is None and (corrections or omitted):
        fit = NetworkFit.from_start(fit_input)
    if fit is None:
        fit = _fit_with_distance_constant(fit_input)
    if fit is None:
        raise NetworkError("no network fits the observations, because they contradict each other too much")
    return fit


def _fit_with_common_scale(fit_input: FitInput) -> NetworkFit | None:
    """Fit with a scale error of all distances that the lengths show; None without such an error.

    Without this hypothesis, no network fits distances in another unit and reference coordinates.
    """
    prior, construction = fit_input.prior, fit_input.construction
    parameters = (
        np.zeros((len(fit_input.recording.instruments), construction.n_parameters)) if prior is None else prior.mean
    )
    scale_error = common_scale_error(fit_input.recording, parameters)
    return None if scale_error is None else NetworkFit.from_start(fit_input, scale_error[:1], scale_error[1])


def _fit_with_distance_constant(fit_input: FitInput) -> NetworkFit | None:
    """Fit with a constant error of all distances; None if most pointings contradict it.

    Without this hypothesis, no network fits distances with a constant error of decimetres.
    """
    change = ReadingShiftChange(ReadingShift("distance"))
    prior = log_prior_of_kind("constant-offset", 1)
    fit = NetworkFit.from_start(fit_input, (CauseHypothesis("constant-offset", "distance", (), (), prior, change),))
    return fit if fit is not None and 2 * np.count_nonzero(fit.is_outlier.any(axis=1)) < len(fit.recording) else None


def _fit_best_hypotheses(
    fit: NetworkFit,
    min_approximate_gain: float = 0.0,
    replaced_hypothesis: CauseHypothesis | None = None,
    *,
    excluded_change_types: tuple[type, ...] = (),
) -> RankedTrialFits:
    """Fits with one more hypothesis, for those hypotheses with the largest approximate gains of log evidence.

    The gains by a linear approximation exceed `min_approximate_gain`. If the fit of the first hypothesis nearly reaches
    its approximate gain, only hypotheses that may explain the same readings are fitted too; later steps select causes
    at other stations or targets. `replaced_hypothesis` and the types of model changes `excluded_change_types` are left
    out.
    """
    first, undetermined = 0.0, 0
    tried: list[tuple[CauseHypothesis, NetworkFit]] = []
    places = {h.place_key for h in fit.hypotheses if isinstance(h.model_change, NoiseFactorChange)}
    places |= {replaced_hypothesis.place_key} if replaced_hypothesis is not None else set()
    for promised, hypothesis in screened_hypotheses(fit):
        best = max((made.log_evidence for _, made in tried), default=-np.inf) - fit.log_evidence
        if (
            promised <= max(min_approximate_gain, 0.0)
            or max(len(tried), undetermined) >= MAX_FITTED_HYPOTHESES
            or best > promised
        ):
            break
        if isinstance(hypothesis.model_change, excluded_change_types):
            continue
        if hypothesis.place_key in places or any(hypothesis.place_key == h.place_key for h, _ in tried):
            continue
        if tried and best > MIN_GAIN_FRACTION_FOR_RIVALS_ONLY * first and not hypothesis.competes_with(tried[0][0]):
            continue
        made = refit_with_hypothesis(fit, hypothesis, promised)
        if made is None:
            undetermined += 1
            continue
        first = first if tried else promised
        tried.append((hypothesis, made))
    return tuple(sorted(tried, key=lambda pair: -pair[1].log_evidence))


def refit_with_hypothesis(fit: NetworkFit, hypothesis: CauseHypothesis, approximate_gain: float) -> NetworkFit | None:
    """Fit with one more hypothesis, started at the present state, and at new start values if its gain is too small.

    The gain of log evidence is compared with `approximate_gain`, which a linear approximation predicts. The result is
    None if no fit is possible.
    """
    best_fit: NetworkFit | None = None
    near = fit.adjustment.sightings
    for start in (replace(fit.state, extra_parameters=np.zeros(0)), None):
        try:
            made = NetworkFit.from_start(fit.fit_input, (*fit.hypotheses, hypothesis), start, None if start else near)
        except LtsimError:
            made = None
        if made is not None and (best_fit is None or made.log_evidence > best_fit.log_evidence):
            best_fit = made
        disappoints = (
            best_fit is None
            or best_fit.log_evidence - fit.log_evidence < MIN_GAIN_FRACTION_WITHOUT_RESTART * approximate_gain
        )
        if not disappoints or approximate_gain < MIN_LOG_EVIDENCE_FOR_RESTART:
            break
    return best_fit


def _fit_without_hypothesis(
    fit: NetworkFit, hypothesis: CauseHypothesis, indispensable_hypotheses: tuple[CauseHypothesis, ...]
) -> tuple[NetworkFit | None, tuple[CauseHypothesis, ...]]:
    """Fit without a hypothesis (None if no fit is possible), and the indispensable hypotheses.

    No fit is tried without one of the `indispensable_hypotheses`. If no fit is possible without the hypothesis, it is
    added to the indispensable ones.
    """
    if any(h is hypothesis for h in indispensable_hypotheses):
        return None, indispensable_hypotheses
    rest = fit_or_none(fit, tuple(h for h in fit.hypotheses if h is not hypothesis))
    return rest, indispensable_hypotheses if rest is not None else (*indispensable_hypotheses, hypothesis)
