"""Calibration by rigorous network adjustment: poses, targets and instrument parameters at once, with priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.components import Grouping
from ltsim.adjustment.doubt import require_result
from ltsim.adjustment.prior import ParameterPrior
from ltsim.calibration.beside import Wanted, estimated_beside
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.choice import WIDE, Choice
from ltsim.calibration.conflict import beyond_prior, disagreement, widened
from ltsim.calibration.known_values import known_of
from ltsim.calibration.result import (
    axes_of,
    criteria_of,
    directions_of,
    fit_of,
    frame_of,
    noise_of,
    notes_on_axes,
    notes_on_hand,
    notes_on_modes,
    notes_on_plan,
    outliers_of,
    stations_of,
    undetermined_of,
    verdict_of,
)
from ltsim.calibration.worth import correction_of
from ltsim.effects.range_mode import RangeMode
from ltsim.effects.signature import Signature
from ltsim.errors import NetworkError
from ltsim.model.construction import Construction, ideal, stated_construction
from ltsim.recording.recording import MODE_COLUMN, Recording
from ltsim.recording.result_file import SourceEntry


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
    beside: Sequence[Wanted] = (),
) -> Calibration:
    """Estimate the parameters of an instrument from a network, with everything else that is unknown.

    Parameters
    ----------
    recording : Recording
    construction : Construction, optional
        Default: that of the set-up; the misalignments of a source in the head (16 parameters), or of a steering mirror.
    advise : bool
        Compute which further measurements would cure undetermined combinations (half of the time it takes).
    robust : bool
        Leave out readings that do not belong, each tested again at the end.
    noise_from_data : bool
        Estimate the noise of each observable of each instrument, and of the levels, from the residuals.
    datum : sequence of str, optional
        Targets that define the datum by inner constraints; default those that the set-up chose.
    choice : Choice, optional
        Which parameters to estimate and from what prior; default all, from what the set-up states.
    weigh : bool
        Find out what of the estimates is worth applying (`calibration.worth`), and let constants that contradict their
        prior follow the readings; without it the estimates are those of the stated priors, linear in the readings.
    beside : sequence of Wanted
        Effects of the catalogue, and laws, to estimate too.

    Raises
    ------
    NetworkError
        When stations share too few targets, most pointings or the known points contradict the rest, or control points
        leave nothing to a datum that was asked for.
    ModelError
        When the datum names a target that does not exist, or too few, or the choice a parameter.
    SetupError
        When the set-up states a prior of a parameter that does not exist.
    RecordError
        When the choice's prior belongs to other instruments or another construction.
    ConvergenceError
        When the adjustment does not converge.
    """
    built = construction or stated_construction(recording)
    chosen = choice or Choice()
    for wanted in beside:
        wanted.check(recording, built)
    adjusted = partial(_adjusted, recording, built, robust, noise_from_data, datum)
    modes = [RangeMode()] if built.size and MODE_COLUMN in recording.circumstances else []
    prior, informed = chosen.applied(recording, built), chosen.prior is not None
    found, fits = estimated_beside(partial(adjusted, prior), modes, beside)
    freed = beyond_prior(found)
    freed &= weigh and not (informed or chosen.free)
    if freed.any():
        found, fits = estimated_beside(partial(adjusted, widened(prior, freed)), modes, beside)
    calibration = replace(_calibration(recording, found, "network", advise=advise, robust=robust), effects=fits)
    if weigh:
        wider = WIDE if chosen.free else None
        worth, weighed = correction_of(found, calibration.names, informed=informed, wider=wider)
        calibration = replace(calibration, correction=worth, weighed=weighed)
        calibration = replace(calibration, criteria=criteria_of(found.recording, found, built, calibration.applied))
    calibration = replace(calibration, prior_sigma=prior.sigma, informed=informed)
    return replace(calibration, notes=(*calibration.notes, *disagreement(calibration, freed)))


def adjust_network(
    recording: Recording,
    *,
    robust: bool = False,
    noise_from_data: bool = False,
    datum: Sequence[str] | None = None,
) -> Calibration:
    """The same network without instrument parameters, in the same form; arguments and errors of `calibrate_network`."""
    found = _adjusted(recording, ideal(), robust, noise_from_data, datum)
    return _calibration(recording, found, "adjustment", advise=False, robust=robust)


def _adjusted(
    recording: Recording,
    construction: Construction,
    robust: bool,
    noise_from_data: bool,
    datum: Sequence[str] | None,
    prior: ParameterPrior | None = None,
    effects: Sequence[Signature] = (),
) -> Adjustment:
    grouping: Grouping | None = "instrument" if noise_from_data else None
    how: dict[str, Any] = {"robust": robust, "variance_components": grouping, "datum": datum, "prior": prior}
    found = adjust(recording, construction, effects=effects, **how)
    require_result(found)
    if datum and not found.problem.free.shape[1]:
        raise NetworkError("the control points define the frame already: leave the datum out, or their coordinates")
    return found


def _calibration(source: Recording, adjustment: Adjustment, method: str, *, advise: bool, robust: bool) -> Calibration:
    recording, construction = adjustment.recording, adjustment.construction
    at = adjustment.problem.unknowns.instrument.ravel()
    held = adjustment.problem.prior.held
    free = ~held.ravel()
    covariance = np.where(free[:, None] & free, adjustment.kept_covariance[at[:, None], at], 0.0)
    prior = adjustment.problem.prior_sigma
    values = adjustment.state.instrument
    return Calibration(
        method=method,
        construction=construction,
        instruments=recording.instruments,
        values=values,
        prior_sigma=prior,
        covariance=covariance,
        held=held,
        fit=fit_of(adjustment),
        undetermined=undetermined_of(adjustment, construction, directions_of(covariance, prior), advise=advise),
        frame=frame_of(adjustment),
        stations=stations_of(adjustment),
        targets=recording.targets,
        points=adjustment.state.points,
        target_covariance=adjustment.target_covariance,
        criteria=criteria_of(recording, adjustment, construction, values),
        outliers=outliers_of(adjustment),
        verdict=verdict_of(adjustment),
        robust=robust,
        noise=noise_of(adjustment),
        known=known_of(adjustment),
        lost_targets=adjustment.lost_targets,
        axes=axes_of(adjustment),
        recording=SourceEntry.of(source),
        notes=(
            *notes_on_axes(adjustment),
            *notes_on_modes(adjustment),
            *notes_on_hand(adjustment),
            *notes_on_plan(adjustment),
        ),
        adjustment=adjustment,
    )
