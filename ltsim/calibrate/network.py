"""Calibration by rigorous network adjustment: poses, targets and instrument parameters at once, with priors."""

from __future__ import annotations

from ltsim.adjust.adjustment import adjust
from ltsim.calibrate.calibration import Calibration
from ltsim.calibrate.result import (
    criteria_of,
    directions_of,
    fit_of,
    frame_of,
    outliers_of,
    stations_of,
    undetermined_of,
)
from ltsim.model.construction import Construction, ideal, misalignment
from ltsim.recording.recording import Recording


def calibrate_network(
    recording: Recording, construction: Construction | None = None, *, advise: bool = True
) -> Calibration:
    """Estimate the parameters of an instrument from a network, with everything else that is unknown.

    Parameters
    ----------
    recording : Recording
    construction : Construction, optional
        Default: the geometric misalignment model with its 16 parameters.
    advise : bool
        Compute which further measurements would cure undetermined combinations (half of the time it takes).

    Raises
    ------
    NetworkError
        When stations share too few targets.
    ConvergenceError
        When the adjustment does not converge.
    """
    return _calibration(recording, construction or misalignment(), "network", advise=advise)


def adjust_network(recording: Recording) -> Calibration:
    """The same network without instrument parameters, in the same form; raises as `calibrate_network`."""
    return _calibration(recording, ideal(), "adjustment", advise=False)


def _calibration(recording: Recording, construction: Construction, method: str, *, advise: bool) -> Calibration:
    adjustment = adjust(recording, construction)
    adjustment.solution.require_success()
    at = adjustment.problem.layout.instrument.ravel()
    covariance = adjustment.kept_covariance[at[:, None], at]
    prior = adjustment.problem.prior_sigma
    values = adjustment.state.instrument
    return Calibration(
        method=method,
        construction=construction,
        instruments=recording.instruments,
        values=values,
        prior_sigma=prior,
        covariance=covariance,
        fit=fit_of(adjustment),
        undetermined=undetermined_of(adjustment, construction, directions_of(covariance, prior), advise=advise),
        frame=frame_of(adjustment),
        stations=stations_of(adjustment),
        targets=recording.targets,
        points=adjustment.state.points,
        target_covariance=adjustment.target_covariance,
        criteria=criteria_of(recording, adjustment, construction, values),
        outliers=outliers_of(adjustment),
        adjustment=adjustment,
    )
