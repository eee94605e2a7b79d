"""Calibration by the paper's distance objective, and the network that its parameters leave."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy import stats

from ltsim.adjust.adjustment import Adjustment, adjust
from ltsim.adjust.problem import prior_sigmas
from ltsim.arrays import Floats
from ltsim.calibrate.calibration import Calibration, Combination, Fit, flat_names
from ltsim.calibrate.correct import corrected_readings
from ltsim.calibrate.distance_solver import Estimate, solve_distances
from ltsim.calibrate.objective import DistanceProblem
from ltsim.calibrate.result import criteria_of, frame_of, gross_rows, outliers_of, stations_of, undetermined_of
from ltsim.model.construction import Construction, misalignment
from ltsim.model.measurement import MeasurementModel, State
from ltsim.recording.recording import Recording

METHODS: dict[str, Literal["squares", "absolute"]] = {"distance": "squares", "distance-l1": "absolute"}


def calibrate_distance(
    recording: Recording,
    construction: Construction | None = None,
    *,
    method: str = "distance",
    advise: bool = True,
) -> Calibration:
    """Estimate the parameters of an instrument by making distances agree (eq. 9 and 10).

    Stations and targets then come from an adjustment of the corrected readings; their covariance holds the
    uncertainty of the parameters, which were found from the same readings.

    Parameters
    ----------
    recording : Recording
    construction : Construction, optional
        Default: the geometric misalignment model with its 16 parameters.
    method : str
        `distance`: least squares; `distance-l1`: least absolute deviations.
    advise : bool
        Compute which further measurements would cure undetermined combinations.

    Raises
    ------
    NetworkError
        When stations share too few targets.
    ConvergenceError
        When the final adjustment does not converge.
    """
    built = construction or misalignment()
    prior = prior_sigmas(recording, built)
    usable = recording.with_readings(np.where(gross_rows(recording)[:, None], np.nan, recording.readings))
    estimate = solve_distances(DistanceProblem(usable, built, prior), METHODS[method])
    values = estimate.unknowns.reshape(prior.shape) * prior
    applied = values[0] if len(values) == 1 else values[recording.instrument]
    corrected = recording.with_readings(corrected_readings(recording, built, applied))
    adjustment = adjust(corrected)
    adjustment.solution.require_success()
    added = _added_covariance(adjustment, recording, built, values, estimate)
    layout = adjustment.problem.layout
    pose = adjustment.pose_covariance + added[layout.pose[:, :, None], layout.pose[:, None, :]]
    scale = prior.ravel()
    return Calibration(
        method=method,
        construction=built,
        instruments=recording.instruments,
        values=values,
        prior_sigma=prior,
        covariance=estimate.covariance * np.outer(scale, scale),
        fit=_fit(adjustment, estimate),
        undetermined=_undetermined(adjustment, built, estimate, advise=advise),
        frame=frame_of(adjustment),
        stations=stations_of(adjustment, pose),
        targets=recording.targets,
        points=adjustment.state.points,
        target_covariance=adjustment.target_covariance + added[layout.target[:, :, None], layout.target[:, None, :]],
        criteria=criteria_of(recording, adjustment, built, values),
        outliers=outliers_of(adjustment),
        adjustment=adjustment,
    )


def _fit(adjustment: Adjustment, estimate: Estimate) -> Fit:
    """The fit of the network that the parameters leave; they cost as many degrees of freedom."""
    dof = adjustment.dof - (len(estimate.unknowns) - len(estimate.left_out))
    chi2 = adjustment.chi2
    if estimate.converged:
        status = "converged", "the last step moved no parameter by more than a ten-millionth of its prior sigma"
    else:
        status = "capped", "the cap on iterations was reached before the steps became small"
    return Fit(
        chi2=chi2,
        dof=dof,
        sigma0=float(np.sqrt(chi2 / dof)) if dof > 0 else None,
        p_value=float(stats.chi2.sf(chi2, dof)) if dof > 0 else None,
        iterations=estimate.iterations,
        status=status[0],
        sentence=status[1],
    )


def _undetermined(
    adjustment: Adjustment, construction: Construction, estimate: Estimate, *, advise: bool
) -> tuple[Combination, ...]:
    instruments = adjustment.recording.instruments
    if len(instruments) == 1:
        return undetermined_of(adjustment, construction, [list(estimate.left_out)], advise=advise)
    names = flat_names(construction.names, instruments)
    return tuple(
        Combination(d.coefficients(names), d.gain, "use the network method, which names a cure")
        for d in estimate.left_out
    )


def _added_covariance(
    adjustment: Adjustment,
    recording: Recording,
    construction: Construction,
    values: Floats,
    estimate: Estimate,
) -> Floats:
    """What the parameters' uncertainty adds to the covariance (size, size) of the final adjustment.

    The adjusted network errs by A e - A B dx: e the whitened noise, A the adjustment, B the design of the
    parameters, dx the parameters' error, which is correlated with e since it comes from the same readings.
    """
    problem, (count, size) = adjustment.problem, values.shape
    used = np.flatnonzero(problem.use.ravel())
    rows = len(used) + len(problem.gauge)
    design = adjustment.solution.system.design[:rows]
    respond = adjustment.factor.covariance_columns(np.ascontiguousarray(design.toarray().T))
    state = adjustment.state
    at = State(state.position, state.rotation, state.points, values)
    by_value = MeasurementModel(recording, construction).linearised(at).by_instrument
    wide = np.zeros((len(recording), 3, count, size))
    wide[np.arange(len(recording)), :, recording.instrument] = (
        by_value * prior_sigmas(recording, construction)[recording.instrument][:, None, :]
    )
    wide = wide / problem.sigma[:, :, None, None]
    through = respond[:, : len(used)] @ wide.reshape(-1, count * size)[used]
    readings = 3 * len(recording)
    together = np.concatenate([estimate.noise[:, used], estimate.noise[:, readings:]], axis=1)
    crossed = respond @ together.T @ through.T
    added: Floats = through @ estimate.covariance @ through.T - crossed - crossed.T
    return added
