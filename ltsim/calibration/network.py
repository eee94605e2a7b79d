"""Calibration by rigorous network adjustment: poses, targets and instrument parameters at once, with priors."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ltsim.adjustment import Adjustment, adjust as adjusted_network
from ltsim.adjustment.components import Grouping
from ltsim.adjustment.doubt import require_result
from ltsim.adjustment.identification import Selection, identified, outcomes
from ltsim.adjustment.identification.fit import changed_recording
from ltsim.adjustment.identification.tests import sentence_of
from ltsim.adjustment.known import KINDS, SCALED
from ltsim.adjustment.moving import Motion, moving_stations
from ltsim.adjustment.prior import ParameterPrior, expected_sigmas, prior_sigmas
from ltsim.calibration import result
from ltsim.calibration.beside import Wanted, estimated_beside
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.conflict import UNEXPLAINED, beyond_prior, disagreement, too_quiet
from ltsim.calibration.known import WIDE, Choice
from ltsim.calibration.worth import correction_of
from ltsim.core.errors import ConvergenceError, NetworkError
from ltsim.physics.effects.range_mode import RangeMode
from ltsim.physics.effects.signature import Signature
from ltsim.physics.effects.verbs import names
from ltsim.physics.model.construction import Construction, declared_construction, ideal
from ltsim.recordings.exchange import RecordingSource, recording_of
from ltsim.recordings.recording import MODE_COLUMN, Recording
from ltsim.recordings.result_file import SourceEntry

PASSES = 5
"""Adjustments until the noise and the parameters that contradict their prior are settled."""
MISFIT = 1e-3
"""Chance of a larger chi-square in a plain network, below which it is asked whether a station moves."""


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
    extra_effects: Sequence[Wanted] = (),
) -> Calibration:
    """The method `network` of `ltsim.calibrate`, whose options and errors it has, and further ones of programs.

    Parameters
    ----------
    choice : Choice, optional
        Which parameters to estimate and from what prior; default all, from what the set-up states.
    weigh : bool
        Find out what of the estimates is worth applying (`calibration.worth`), let constants that contradict their
        prior follow the readings, and identify simple causes; without it the model is the stated one whatever the
        readings show, and the estimates are those of the stated priors, linear in the readings.
    extra_effects : sequence of Wanted
        Effects of the catalogue, and laws, to estimate too.
    """
    built = construction or declared_construction(recording)
    chosen = choice or Choice()
    for wanted in extra_effects:
        wanted.check(recording, built)
    modes = [RangeMode()] if built.size and MODE_COLUMN in recording.circumstances else []
    expected = expected_sigmas(recording, built) if weigh else prior_sigmas(recording, built)
    prior, informed = chosen.over(expected, recording, built), chosen.prior is not None
    freed, grouping = np.zeros(prior.mean.shape, dtype=bool), _grouping(noise_from_data)
    quiet_by, heard = "", True
    # Beside effects that are asked for, a simple cause would take what they are to take.
    selection = identified(recording, built, prior) if weigh and not extra_effects else None
    for left in reversed(range(PASSES if weigh else 1)):
        adjusted = partial(_adjusted, recording, built, robust, grouping, datum, prior.widened(freed), selection)
        try:
            found, fits = estimated_beside(adjusted, modes, extra_effects)
        except ConvergenceError:
            if not quiet_by:
                raise
            grouping, quiet_by, heard = None, "", False  # what scatters so little has no noise of its own
            continue
        further = freed if informed or chosen.free or not left else beyond_prior(found, prior)
        if left and heard and grouping is None and too_quiet(found):
            grouping, quiet_by = "observable", f"{found.sigma0:.2f}"
        elif np.array_equal(freed, further):
            break
        else:
            freed = further
    calibration = replace(_calibration(recording, found, "network", advise=advise, robust=robust), effects=fits)
    calibration = replace(calibration, tests=() if selection is None else outcomes(selection))
    if weigh:
        wider = WIDE if chosen.free else None
        worth, weighed = correction_of(found, calibration.names, informed=informed, wider=wider)
        criteria = result.criteria_of(found.recording, found, built, weighed)
        calibration = replace(calibration, correction=worth, weighed=weighed, criteria=criteria)
    calibration = replace(calibration, prior_sigma=prior.sigma, beyond_prior=freed, informed=informed)
    quiet = f"the readings scatter {quiet_by} times as much as stated, which only the noise does: it is estimated"
    notes = [*calibration.notes, *([quiet] if quiet_by else []), *disagreement(calibration)]
    return replace(calibration, notes=tuple(notes))


def adjust(
    recording: RecordingSource,
    *,
    robust: bool = False,
    noise_from_data: bool = False,
    datum: str | Sequence[str] | None = None,
) -> Calibration:
    """Adjust the network of a recording, taking the instrument as it is: targets, stations, outliers.

    Parameters
    ----------
    recording : Recording, str or Path
    robust : bool
        Leave out readings that do not belong, each tested again at the end.
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
    seen = recording_of(recording)
    chosen = None if datum is None else names(datum)
    selection = identified(seen)
    found = _adjusted(seen, ideal(), robust, _grouping(noise_from_data), chosen, selection=selection)
    calibration = _calibration(seen, found, "adjustment", advise=False, robust=robust)
    return replace(calibration, tests=() if selection is None else outcomes(selection))


def _adapted(
    recording: Recording, construction: Construction, selection: Selection, effects: Sequence[Signature], **how: Any
) -> Adjustment:
    """The adjustment with the simple causes in its model: from their state, and without outliers that are gross."""
    fit = selection.fit
    changed = changed_recording(recording, fit.hypotheses)
    instrument = np.zeros((len(recording.instruments), construction.size))
    if construction.size == fit.state.instrument.shape[1]:
        instrument = fit.state.instrument
    extra = np.zeros(sum(len(e.parameters) for e in effects))
    start = replace(fit.state, instrument=instrument, extra=np.concatenate([extra, fit.state.extra]))
    found = adjusted_network(
        changed,
        construction,
        effects=(*effects, *fit.effects),
        use=~(fit.outliers & fit.is_gross),
        start=start,
        **how,
    )
    causes = tuple(sentence_of(fit, choice.hypothesis) for choice in selection.choices)
    return replace(found, causes=causes)


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
        found = _adapted(recording, construction, selection, effects, **how)
        require_result(found)
        return _in_frame(found, datum)
    how["judging"] = KINDS if prior is None or prior.held.all() else SCALED
    found = adjusted_network(recording, construction, effects=effects, **how)
    if found.sigma0 >= UNEXPLAINED and any(test.kind == "scale" for test in found.wrong):
        how["judging"] = KINDS  # lengths so far off that no scale of an instrument is: they count by their ratios
        found = adjusted_network(recording, construction, effects=effects, **how)
    require_result(found)
    if moving := _moving(found):
        found = adjusted_network(recording, construction, effects=(*effects, *moving), **how)
        require_result(found)
    return _in_frame(found, datum)


def _in_frame(found: Adjustment, datum: Sequence[str] | None) -> Adjustment:
    """The adjustment; NetworkError where a datum is asked for that control points define."""
    if datum and not found.problem.free.shape[1]:
        raise NetworkError("the control points define the frame already: leave the datum out, or their coordinates")
    return found


def _moving(found: Adjustment) -> tuple[Motion, ...]:
    """Stations that move; what an instrument's errors do to the readings of a plain network moves none."""
    if found.construction.size:
        return moving_stations(found)
    if not found.p_value < MISFIT and not found.outliers():
        return ()
    try:
        built = declared_construction(found.recording)
    except NetworkError:  # of two designs: nothing is known of their errors
        return moving_stations(found)
    return moving_stations(adjusted_network(found.recording, built, robust=True))


def _calibration(source: Recording, adjustment: Adjustment, method: str, *, advise: bool, robust: bool) -> Calibration:
    recording, construction = adjustment.recording, adjustment.construction
    at = adjustment.problem.unknowns.instrument.ravel()
    held = adjustment.problem.prior.held
    free = ~held.ravel()
    covariance = np.where(free[:, None] & free, adjustment.kept_covariance[at[:, None], at], 0.0)
    prior = adjustment.problem.prior.sigma
    values, directions = adjustment.state.instrument, result.directions_of(covariance, prior)
    return Calibration(
        method=method,
        construction=construction,
        instruments=recording.instruments,
        values=values,
        prior_sigma=prior,
        covariance=covariance,
        held=held,
        fit=result.fit_of(adjustment),
        undetermined=result.undetermined_of(adjustment, construction, directions, advise=advise),
        frame=result.frame_of(adjustment),
        stations=result.stations_of(adjustment),
        targets=recording.targets,
        points=adjustment.state.points,
        target_covariance=adjustment.target_covariance,
        criteria=result.criteria_of(recording, adjustment, construction, values),
        outliers=result.outliers_of(adjustment),
        verdict=result.verdict_of(adjustment),
        robust=robust,
        noise=result.noise_of(adjustment),
        known=result.known_of(adjustment),
        lost_targets=adjustment.lost_targets,
        axes=result.axes_of(adjustment),
        recording=SourceEntry.of(source),
        notes=result.notes_on(adjustment),
        adjustment=adjustment,
    )
