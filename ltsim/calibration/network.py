"""Calibration by network adjustment: poses, targets and instrument parameters in one adjustment, with priors."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from ltsim.adjustment import Adjustment, adjust as adjusted_network
from ltsim.adjustment.identification import identify_causes
from ltsim.adjustment.identification.cause_tests import CauseTest
from ltsim.adjustment.prior import expected_error_sigmas, prior_sigmas
from ltsim.adjustment.stochastic_model import NoiseGrouping
from ltsim.adjustment.verdict import FitWithConstants
from ltsim.calibration import result
from ltsim.calibration.arrays import CalibrationArrays
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.identified_network import (
    adjust_with_cause_selection,
    cause_tests_of_adjustment,
    network_uncertainty_factor,
)
from ltsim.calibration.prior_conflict import (
    contradicted_prior_mask,
    is_noise_overstated,
    prior_conflict_sentences,
)
from ltsim.calibration.prior_information import NO_PRIOR_SIGMA_FACTOR, ParameterSelection
from ltsim.calibration.reported_uncertainty import uncertainty_factor, with_reported_uncertainty
from ltsim.calibration.requested_effects import RequestedEffect, fit_with_requested_effects
from ltsim.calibration.schema import VerdictEntry
from ltsim.calibration.shrinkage import recommend_correction
from ltsim.calibration.undetermined import undetermined_entries
from ltsim.core.errors import ConvergenceError, LtsimError
from ltsim.core.limits import MAX_CALIBRATED_POINTINGS, MAX_CALIBRATED_TARGETS, require_few_effects
from ltsim.physics.effects.range_mode import RangeMode
from ltsim.physics.effects.verbs import name_tuple
from ltsim.physics.model.construction import GeometricErrorModel, declared_construction, ideal_construction
from ltsim.recordings.exchange import RecordingSource, load_recording
from ltsim.recordings.recording import DISTANCE_METER_COLUMN, Recording
from ltsim.recordings.result_file import ResultSource
from ltsim.solve.gauss_newton import MAX_DECISION_CHANGES


def calibrate_network(
    recording: Recording,
    construction: GeometricErrorModel | None = None,
    *,
    recommend_measurements: bool = True,
    robust: bool = False,
    noise_from_data: bool = False,
    datum: Sequence[str] | None = None,
    parameter_selection: ParameterSelection | None = None,
    choose_correction: bool = True,
    requested_effects: Sequence[RequestedEffect] = (),
) -> Calibration:
    """Calibration by the method `network` of `ltsim.calibrate`, with its options and errors and with further options.

    Parameters
    ----------
    parameter_selection : ParameterSelection, optional
        Parameters to estimate, and their prior. Default: all, with the prior in `setup.toml`.
    choose_correction : bool
        True to shrink the correction (`calibration.shrinkage`), to widen priors that the readings contradict, and
        to identify single causes of a misfit, such as a moved station. If False, the model and the priors are the
        declared ones, and the estimates are linear in the readings.
    requested_effects : sequence of RequestedEffect
        Physical effects, and empirical laws (functions of time, angles and so on), that are also estimated.
    """
    recording.require_at_most(MAX_CALIBRATED_POINTINGS, MAX_CALIBRATED_TARGETS, "a calibration")
    require_few_effects(len(requested_effects), len(recording))
    model = construction or declared_construction(recording)
    chosen = parameter_selection or ParameterSelection()
    for wanted in requested_effects:
        wanted.require_estimable(recording, model)
    modes = [RangeMode()] if model.n_parameters and DISTANCE_METER_COLUMN in recording.regressor_covariates else []
    expected_prior = expected_error_sigmas(recording, model) if choose_correction else prior_sigmas(recording, model)
    prior, has_history_prior = (
        chosen.prior_with_sigma(expected_prior, recording, model),
        chosen.earlier_calibration_prior is not None,
    )
    freed, grouping = np.zeros(prior.mean.shape, dtype=bool), _noise_grouping(noise_from_data)
    quiet_by, noise_may_differ, tried_sets, alternates = "", True, [freed], False
    # A single cause of a misfit could absorb an effect that the user requests.
    selection = identify_causes(recording, model, prior) if choose_correction and not requested_effects else None
    if selection is not None and selection.wrong_range_constants:
        # Range zero and scale are parameters of the calibration, whose prior follows the readings.
        is_wrong = freed | np.isin(model.parameter_names, selection.wrong_range_constants)
        selection = identify_causes(recording, model, prior.with_widened_sigmas(is_wrong))
    for remaining in reversed(range(MAX_DECISION_CHANGES if choose_correction else 1)):
        adjusted = partial(
            adjust_with_cause_selection,
            recording,
            model,
            robust,
            grouping,
            datum,
            prior.with_widened_sigmas(freed),
            selection,
        )
        try:
            adjustment, fits = fit_with_requested_effects(adjusted, modes, requested_effects)
        except ConvergenceError:
            if not quiet_by:
                raise
            # readings that scatter so little do not determine their noise
            grouping, quiet_by, noise_may_differ = None, "", False
            continue
        further = (
            freed
            if has_history_prior or chosen.has_no_prior or alternates or not remaining
            else contradicted_prior_mask(adjustment, prior)
        )
        if remaining and noise_may_differ and grouping is None and is_noise_overstated(adjustment):
            grouping, quiet_by = "observable", f"{adjustment.sigma0:.2f}"
        elif np.array_equal(freed, further):
            break
        else:  # of two sets that alternate, only the priors in both are widened
            alternates = any(np.array_equal(further, earlier) for earlier in tried_sets)
            freed = freed & further if alternates else further
            tried_sets.append(freed)
    tests = cause_tests_of_adjustment(selection, adjustment)
    calibration = _make_calibration(
        recording,
        adjustment,
        "network",
        recommend_measurements=recommend_measurements,
        robust=robust,
        effects=fits,
        tests=tests,
    )
    new_fields: dict[str, Any] = {
        "prior_sigma": prior.sigma,
        "is_prior_rejected": freed,
        "has_history_prior": has_history_prior,
    }
    if choose_correction:
        wider = NO_PRIOR_SIGMA_FACTOR if chosen.has_no_prior else None
        factor = uncertainty_factor(calibration.fit, is_sigma0_credible=calibration.verdict.is_sigma0_credible)
        worth, applied_values = recommend_correction(
            adjustment,
            calibration.instrument_parameter_names,
            has_history_prior=has_history_prior,
            prior_widening_factor=wider,
            noise_factor=factor,
        )
        criteria = result.criteria_entry(adjustment.recording, adjustment, model, applied_values)
        new_fields |= {"correction": worth, "applied_values": applied_values, "criteria": criteria}
    calibration = calibration.with_changes(**new_fields)
    sentence = f"the readings scatter {quiet_by} times as much as declared: the estimated noise replaces it"
    notes = [*calibration.notes, *([sentence] if quiet_by else []), *prior_conflict_sentences(calibration)]
    return calibration.with_changes(notes=tuple(notes))


def adjust(
    recording: RecordingSource,
    *,
    robust: bool = False,
    noise_from_data: bool = False,
    datum: str | Sequence[str] | None = None,
) -> Calibration:
    """Network adjustment of a recording without instrument parameters: coordinates of targets, stations, and outliers.

    Parameters
    ----------
    recording : Recording, str or Path
    robust : bool
        True to exclude outlying readings; each excluded reading is tested again at the end.
    noise_from_data : bool
        True to estimate the noise of each observable and instrument from the residuals.
    datum : str or sequence of str, optional
        Targets that define the datum by inner constraints. Default: the selection in `setup.toml`.

    Returns
    -------
    Calibration
        Calibration without instrument parameters.

    Raises
    ------
    NetworkError
        If the network cannot be solved; the message names the stations or targets that cannot be determined.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> lt.adjust(recording).to_dataframe("targets").shape
    (28, 7)
    """
    source = load_recording(recording)
    datum_names = None if datum is None else name_tuple(datum)
    selection = identify_causes(source)
    adjustment = adjust_with_cause_selection(
        source, ideal_construction(), robust, _noise_grouping(noise_from_data), datum_names, selection=selection
    )
    tests = cause_tests_of_adjustment(selection, adjustment)
    calibration = _make_calibration(
        source,
        adjustment,
        "adjustment",
        recommend_measurements=False,
        with_constants=_adjustment_with_instrument_constants(adjustment),
        robust=robust,
        tests=tests,
    )
    return with_reported_uncertainty(calibration)


def _adjustment_with_instrument_constants(adjustment: Adjustment) -> Adjustment | None:
    """Adjustment that also estimates the instrument constants, from the readings in use.

    The result is None for corrected instruments, and if the fit without instrument constants is not rejected.
    """
    recording = adjustment.recording
    if recording.is_corrected or network_uncertainty_factor(adjustment) == 1.0:
        return None
    try:
        built = declared_construction(recording)
        problem = adjustment.problem
        how: dict[str, Any] = {
            "effects": adjustment.effects,
            "sigma": problem.reading_sigmas,
            "reading_mask": problem.is_used_reading,
        }
        fitted = adjusted_network(recording, built, **how)
    except LtsimError:
        return None
    return fitted if fitted.solution.has_converged else None


def _noise_grouping(noise_from_data: bool) -> NoiseGrouping | None:
    """Grouping of the readings for the estimation of their noise; None if the noise is not estimated."""
    return "instrument" if noise_from_data else None


def _suspect_targets(tests: Sequence[CauseTest]) -> tuple[str, ...]:
    """Names of the targets with a selected cause of a misfit, other than an outlier of a single reading."""
    faults = (test for test in tests if test.is_fault and test.kind != "outlier")
    return tuple(dict.fromkeys(name for test in faults for name in test.where.targets))


def _make_calibration(
    source: Recording,
    adjustment: Adjustment,
    method: str,
    *,
    recommend_measurements: bool,
    with_constants: Adjustment | None = None,
    **fields: Any,
) -> Calibration:
    """Calibration from an adjusted network; `fields` are other fields of the result.

    `with_constants` is the adjustment that also estimates the instrument constants, to compare with.
    """
    recording, construction = adjustment.recording, adjustment.construction
    fit_with_constants = FitWithConstants.from_adjustment(with_constants)
    columns_of_free = adjustment.problem.unknowns.instrument_columns.ravel()
    is_fixed = adjustment.problem.prior.is_fixed
    is_free = ~is_fixed.ravel()
    covariance = np.where(
        is_free[:, None] & is_free, adjustment.retained_covariance[columns_of_free[:, None], columns_of_free], 0.0
    )
    prior = adjustment.problem.prior.sigma
    values, directions = (
        adjustment.state.instrument_parameters,
        result.undetermined_by_instrument(covariance, prior),
    )
    arrays = CalibrationArrays(
        construction=construction,
        instruments=recording.instruments,
        estimates=values,
        prior_sigma=prior,
        covariance=covariance,
        is_fixed=is_fixed,
        target_names=recording.targets,
        target_points=adjustment.state.target_points,
        target_covariances=adjustment.target_covariances,
        adjustment=adjustment,
    )
    return Calibration.from_arrays(
        arrays,
        method=method,
        fit=result.fit_entry(adjustment),
        undetermined=undetermined_entries(
            adjustment,
            construction,
            directions,
            recommend_measurements=recommend_measurements,
            suspect_targets=_suspect_targets(fields.get("tests", ())),
        ),
        frame=result.frame_text(adjustment),
        stations=result.station_poses(adjustment),
        criteria=result.criteria_entry(recording, adjustment, construction, values),
        reflectors=result.reflector_entries(adjustment),
        fit_with_constants=None if with_constants is None else result.fit_entry(with_constants),
        outliers=result.outlier_rows(adjustment, fit_with_constants),
        verdict=VerdictEntry.from_verdict(result.fit_verdict(adjustment, fit_with_constants)),
        noise=result.noise_rows(adjustment),
        reference_values=result.reference_value_entries(adjustment),
        undetermined_targets=adjustment.undetermined_targets,
        axes=result.axes_entry(adjustment),
        recording=ResultSource.from_recording(source),
        notes=result.network_notes(adjustment),
        **fields,
    )
