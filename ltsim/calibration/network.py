"""Calibration by rigorous network adjustment: poses, targets and instrument parameters at once, with priors."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ltsim.adjustment import Adjustment, adjust as adjusted_network
from ltsim.adjustment.identification import Selection, adapted, identified, outcomes
from ltsim.adjustment.identification.tests import sentence_of
from ltsim.adjustment.prior import ParameterPrior, expected_sigmas, prior_sigmas
from ltsim.adjustment.quality import require_usable
from ltsim.adjustment.reference_tests import KINDS, SCALED
from ltsim.adjustment.stochastic_model import Grouping
from ltsim.calibration import result
from ltsim.calibration.arrays import CalibrationArrays
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.extra_effects import RequestedEffect, fit_with_extra_effects
from ltsim.calibration.prior_conflict import UNEXPLAINED, disagreement, noise_overstated, prior_rejected
from ltsim.calibration.prior_information import WIDE, Choice
from ltsim.calibration.reported import reported, uncertainty_factor
from ltsim.calibration.schema import Fit, VerdictEntry
from ltsim.calibration.shrinkage import correction_of
from ltsim.core.errors import ConvergenceError, LtsimError, NetworkError
from ltsim.core.limits import CALIBRATED_POINTINGS
from ltsim.physics.effects.range_mode import RangeMode
from ltsim.physics.effects.signature import Signature
from ltsim.physics.effects.verbs import name_tuple
from ltsim.physics.model.construction import Construction, declared_construction, ideal_construction
from ltsim.recordings.exchange import RecordingSource, recording_of
from ltsim.recordings.recording import MODE_COLUMN, Recording
from ltsim.recordings.result_file import SourceEntry

PASSES = 5
"""Largest number of adjustments until the noise and the set of widened priors no longer change."""


def calibrate_network(
    recording: Recording,
    construction: Construction | None = None,
    *,
    advise: bool = True,
    robust: bool = False,
    noise_from_data: bool = False,
    datum: Sequence[str] | None = None,
    choice: Choice | None = None,
    weigh: bool = True,
    extra_effects: Sequence[RequestedEffect] = (),
) -> Calibration:
    """Method `network` of `ltsim.calibrate`, with its options and errors, and with additional options.

    Parameters
    ----------
    choice : Choice, optional
        Parameters to estimate, and their prior; default all, with the prior of the set-up.
    weigh : bool
        Shrink the correction (`calibration.shrinkage`), widen the prior of constants that contradict it, and identify
        simple causes. Without it the model and the priors are the declared ones, and the estimates are linear in the
        readings.
    extra_effects : sequence of RequestedEffect
        Effects of the catalogue, and laws, to estimate too.
    """
    recording.require_at_most(CALIBRATED_POINTINGS, "a calibration")
    built = construction or declared_construction(recording)
    chosen = choice or Choice()
    for wanted in extra_effects:
        wanted.check(recording, built)
    modes = [RangeMode()] if built.n_parameters and MODE_COLUMN in recording.circumstances else []
    expected = expected_sigmas(recording, built) if weigh else prior_sigmas(recording, built)
    prior, history_prior = chosen.over(expected, recording, built), chosen.prior is not None
    freed, grouping = np.zeros(prior.mean.shape, dtype=bool), _grouping(noise_from_data)
    quiet_by, noise_may_differ = "", True
    # A simple cause could absorb an effect that the user requests.
    selection = identified(recording, built, prior) if weigh and not extra_effects else None
    for remaining in reversed(range(PASSES if weigh else 1)):
        adjusted = partial(_adjusted, recording, built, robust, grouping, datum, prior.widened(freed), selection)
        try:
            adjustment, fits = fit_with_extra_effects(adjusted, modes, extra_effects)
        except ConvergenceError:
            if not quiet_by:
                raise
            # readings that scatter so little do not determine their noise
            grouping, quiet_by, noise_may_differ = None, "", False
            continue
        further = freed if history_prior or chosen.free or not remaining else prior_rejected(adjustment, prior)
        if remaining and noise_may_differ and grouping is None and noise_overstated(adjustment):
            grouping, quiet_by = "observable", f"{adjustment.sigma0:.2f}"
        elif np.array_equal(freed, further):
            break
        else:
            freed = further
    tests = () if selection is None else outcomes(selection)
    calibration = _calibration(
        recording, adjustment, "network", advise=advise, robust=robust, effects=fits, tests=tests
    )
    changes: dict[str, Any] = {"prior_sigma": prior.sigma, "prior_rejected": freed, "history_prior": history_prior}
    if weigh:
        wider = WIDE if chosen.free else None
        factor = uncertainty_factor(calibration.fit, by_estimate=calibration.verdict.scale_by_sigma0)
        worth, applied_values = correction_of(
            adjustment, calibration.names, history_prior=history_prior, wider=wider, factor=factor
        )
        criteria = result.criteria_of(adjustment.recording, adjustment, built, applied_values)
        changes |= {"correction": worth, "applied_values": applied_values, "criteria": criteria}
    calibration = calibration.with_changes(**changes)
    quiet = f"the readings scatter {quiet_by} times as much as declared: the noise was estimated instead"
    notes = [*calibration.notes, *([quiet] if quiet_by else []), *disagreement(calibration)]
    return calibration.with_changes(notes=tuple(notes))


def adjust(
    recording: RecordingSource,
    *,
    robust: bool = False,
    noise_from_data: bool = False,
    datum: str | Sequence[str] | None = None,
) -> Calibration:
    """Network adjustment of a recording without instrument parameters: targets, stations, outliers.

    Parameters
    ----------
    recording : Recording, str or Path
    robust : bool
        Exclude outlying readings, each tested again at the end.
    noise_from_data : bool
        Estimate the noise of each observable and instrument from the residuals.
    datum : str or sequence of str, optional
        Targets that define the datum by inner constraints; default those that the set-up chose.

    Returns
    -------
    Calibration
        Without instrument parameters.

    Raises
    ------
    NetworkError
        When the network cannot be solved; the message names stations or targets.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> lt.adjust(recording).to_dataframe("targets").shape
    (28, 7)
    """
    source = recording_of(recording)
    chosen = None if datum is None else name_tuple(datum)
    selection = identified(source)
    adjustment = _adjusted(
        source, ideal_construction(), robust, _grouping(noise_from_data), chosen, selection=selection
    )
    tests, constants = () if selection is None else outcomes(selection), _fit_with_constants(adjustment)
    how = {"robust": robust, "tests": tests, "with_constants": constants}
    return reported(_calibration(source, adjustment, "adjustment", advise=False, **how))


def _fit_with_constants(adjustment: Adjustment) -> Fit | None:
    """Fit of rejected readings of uncorrected instruments with their constants estimated; None for others."""
    recording = adjustment.recording
    if recording.is_corrected or _uncertainty_factor(adjustment) == 1.0:
        return None
    try:
        built = declared_construction(recording)
        fitted = adjusted_network(recording, built, effects=adjustment.effects, sigma=adjustment.problem.sigma)
    except LtsimError:
        return None
    return result.fit_of(fitted) if fitted.solution.converged else None


def _uncertainty_factor(adjustment: Adjustment) -> float:
    return uncertainty_factor(result.fit_of(adjustment), by_estimate=result.verdict_of(adjustment).by_estimate)


def _grouping(noise_from_data: bool) -> Grouping | None:
    return "instrument" if noise_from_data else None


def _adjusted(
    recording: Recording,
    construction: Construction,
    robust: bool,
    grouping: Grouping | None,
    datum: Sequence[str] | None,
    prior: ParameterPrior | None = None,
    selection: Selection | None = None,
    effects: Sequence[Signature] = (),
) -> Adjustment:
    how: dict[str, Any] = {"robust": robust, "variance_components": grouping, "datum": datum, "prior": prior}
    if selection is not None and selection.leads:
        fit = selection.fit
        how["use"] = ~(fit.outliers & fit.is_gross)
        adjustment = adapted(fit, recording, construction, fit.hypotheses, effects=effects, **how)
        causes = tuple(sentence_of(fit, choice.hypothesis) for choice in selection.choices)
        adjustment = replace(adjustment, causes=causes)
        require_usable(adjustment)
        return _in_frame(adjustment, datum)
    how["judging"] = KINDS if prior is None or prior.held.all() else SCALED
    effects = (*effects, *(() if selection is None else selection.motions))
    adjustment = adjusted_network(recording, construction, effects=effects, **how)
    if adjustment.sigma0 >= UNEXPLAINED and any(test.kind == "scale" for test in adjustment.rejected_references):
        how["judging"] = KINDS  # lengths so far off that no scale of an instrument is: they count by their ratios
        adjustment = adjusted_network(recording, construction, effects=effects, **how)
    require_usable(adjustment)
    return _in_frame(adjustment, datum)


def _in_frame(adjustment: Adjustment, datum: Sequence[str] | None) -> Adjustment:
    """Adjustment; raises NetworkError for a requested datum in a network whose frame control points define."""
    if datum and not adjustment.problem.free.shape[1]:
        raise NetworkError("the control points define the frame already: leave the datum out, or their coordinates")
    return adjustment


def _calibration(source: Recording, adjustment: Adjustment, method: str, *, advise: bool, **fields: Any) -> Calibration:
    recording, construction = adjustment.recording, adjustment.construction
    at = adjustment.problem.unknowns.instrument.ravel()
    held = adjustment.problem.prior.held
    free = ~held.ravel()
    covariance = np.where(free[:, None] & free, adjustment.reduced_covariance[at[:, None], at], 0.0)
    prior = adjustment.problem.prior.sigma
    values, directions = adjustment.state.instrument_parameters, result.directions_of(covariance, prior)
    arrays = CalibrationArrays(
        construction=construction,
        instruments=recording.instruments,
        values=values,
        prior_sigma=prior,
        covariance=covariance,
        held=held,
        targets=recording.targets,
        points=adjustment.state.target_points,
        target_covariance=adjustment.target_covariance,
        adjustment=adjustment,
    )
    return Calibration.of(
        arrays,
        method=method,
        fit=result.fit_of(adjustment),
        undetermined=result.undetermined_of(adjustment, construction, directions, advise=advise),
        frame=result.frame_of(adjustment),
        stations=result.stations_of(adjustment),
        criteria=result.criteria_of(recording, adjustment, construction, values),
        reflectors=result.reflectors_of(adjustment),
        outliers=result.outliers_of(adjustment),
        verdict=VerdictEntry.of(result.verdict_of(adjustment)),
        noise=result.noise_of(adjustment),
        reference_values=result.reference_values_of(adjustment),
        undetermined_targets=adjustment.undetermined_targets,
        axes=result.axes_of(adjustment),
        recording=SourceEntry.of(source),
        notes=result.notes_on(adjustment),
        **fields,
    )
