"""Calibration by the paper's distance objective, and the network that its parameters leave."""

from __future__ import annotations

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.calibration.calibration import Calibration, Combination, Fit
from ltsim.calibration.choice import Choice
from ltsim.calibration.correct import corrected_readings
from ltsim.calibration.distance_solver import Estimate, solve_distances
from ltsim.calibration.equation_9 import Norm, solve_equation_9, with_minimum
from ltsim.calibration.objective import DistanceProblem
from ltsim.calibration.propagation import Propagation
from ltsim.calibration.result import (
    criteria_of,
    frame_of,
    gross_rows,
    notes_on_modes,
    outliers_of,
    stations_of,
    tied_readings,
    undetermined_of,
)
from ltsim.model.construction import Construction, stated_construction
from ltsim.recording.recording import Recording
from ltsim.recording.reflectors import require_one_radius
from ltsim.recording.result_file import SourceEntry

METHODS: dict[str, Norm] = {"distance": "squares", "distance-l1": "absolute"}
AS_PRINTED: dict[str, Norm] = {"equation-9": "squares", "equation-9-l1": "absolute"}
"""Methods that leave no combination out, however little the readings tell of it."""


def calibrate_distance(
    recording: Recording,
    construction: Construction | None = None,
    *,
    method: str = "distance",
    advise: bool = True,
    choice: Choice | None = None,
    box: float | None = None,
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
        `distance`: least squares over the combinations that the readings determine, `distance-l1`: least absolute
        deviations; `equation-9` and `equation-9-l1`: the same over all, the minimum of the objective as printed.
    advise : bool
        Compute which further measurements would cure undetermined combinations.
    choice : Choice, optional
        Which parameters to estimate; default all.
    box : float, optional
        Bound on every parameter, in prior sigmas; methods `equation-9` and `equation-9-l1` only.

    Raises
    ------
    NetworkError
        When stations share too few targets, or measured balls of several radii.
    ConvergenceError
        When the final adjustment does not converge.
    """
    require_one_radius(recording, f"the method {method}")
    built = construction or stated_construction(recording)
    known = (choice or Choice()).applied(recording, built)
    prior, held = known.sigma, known.held
    source = SourceEntry.of(recording)
    recording, _ = tied_readings(recording)
    usable = recording.with_readings(np.where(gross_rows(recording)[:, None], np.nan, recording.readings))
    start = np.where(held, known.mean / prior, 0.0).ravel()
    problem, notes = DistanceProblem(usable, built, prior), tuple[str, ...]()
    if method in AS_PRINTED:
        estimate = solve_equation_9(problem, AS_PRINTED[method], box=box, start=start, held=held.ravel())
    else:
        estimate = solve_distances(problem, METHODS[method], start=start, held=held.ravel())
        notes = with_minimum(problem, METHODS[method], estimate, held.ravel()) if advise else ()
    values = estimate.unknowns.reshape(prior.shape) * prior
    applied = values[0] if len(values) == 1 else values[recording.instrument]
    corrected = recording.with_readings(corrected_readings(recording, built, applied))
    adjustment = adjust(corrected)
    adjustment.solution.require_success()
    propagation = Propagation(recording, built, values, estimate, adjustment)
    added = propagation.added_covariance()
    unknowns = adjustment.problem.unknowns
    pose = adjustment.pose_covariance + added[unknowns.pose[:, :, None], unknowns.pose[:, None, :]]
    scale = prior.ravel()
    silent = np.array([d.vector for d in estimate.left_out]).reshape(-1, len(scale))
    return Calibration(
        method=method,
        construction=built,
        instruments=recording.instruments,
        values=values,
        prior_sigma=prior,
        covariance=estimate.covariance * np.outer(scale, scale),
        silent=silent,
        held=held,
        fit=_fit(propagation),
        undetermined=_undetermined(adjustment, built, estimate, advise=advise),
        frame=frame_of(adjustment),
        stations=stations_of(adjustment, pose),
        targets=recording.targets,
        points=adjustment.state.points,
        target_covariance=adjustment.target_covariance
        + added[unknowns.target[:, :, None], unknowns.target[:, None, :]],
        criteria=criteria_of(recording, adjustment, built, values),
        outliers=outliers_of(adjustment),
        lost_targets=tuple(recording.targets[i] for i in np.flatnonzero(adjustment.problem.structure.unseen)),
        recording=source,
        notes=(*notes_on_modes(adjustment), *notes),
        adjustment=adjustment,
    )


def _fit(propagation: Propagation) -> Fit:
    """The fit of the network that the parameters leave; `dof` is the chi-square to expect, to the nearest integer."""
    chi2, estimate = propagation.adjustment.chi2, propagation.estimate
    mean, variance = propagation.chi2_moments()
    expected = round(mean)
    redundant = propagation.adjustment.dof > 0 and expected > 0
    if estimate.converged:
        status = "converged", "the last step moved no parameter by more than a ten-millionth of its prior sigma"
    else:
        status = "capped", "the cap on iterations was reached before the steps became small"
    return Fit(
        chi2=chi2,
        dof=expected,
        sigma0=float(np.sqrt(chi2 / expected)) if redundant else None,
        p_value=propagation.chi2_tail(chi2) if redundant else None,
        iterations=estimate.iterations,
        status=status[0],
        sentence=status[1],
        chi2_sigma=float(np.sqrt(variance)),
    )


def _undetermined(
    adjustment: Adjustment, construction: Construction, estimate: Estimate, *, advise: bool
) -> tuple[Combination, ...]:
    instruments = adjustment.recording.instruments
    if len(instruments) == 1:
        return undetermined_of(adjustment, construction, [list(estimate.left_out)], advise=advise)
    names = construction.names_of(instruments)
    return tuple(
        Combination(combination=d.coefficients(names), gain=d.gain, cure="use the network method, which names a cure")
        for d in estimate.left_out
    )
