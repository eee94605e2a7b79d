"""Application of the model changes of hypotheses to a recording: corrections, exclusions, shifts, centring errors."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ltsim.adjustment.datum import solution_near_excluded_points
from ltsim.adjustment.identification.hypothesis import (
    CauseHypothesis,
    CentringChange,
    CoordinateExchange,
    ReadingShiftChange,
    ReferenceOmission,
    RowCorrection,
)
from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.reference_values import drop_reference, exchange_coordinates
from ltsim.adjustment.snooping import snoop_readings
from ltsim.core.arrays import Floats
from ltsim.core.units import MILLIMETRE
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import Recording
from ltsim.scene.sightings import Sightings
from ltsim.solve.gauss_newton import MAX_DECISION_CHANGES, Solution

CENTRING_SIGMA_TOLERANCE = 0.15
"""Limit of the relative change of the standard deviation of centring errors. After a larger change, the network fit is
repeated. An estimate from a hundred displacement components has a relative standard deviation of 7 %."""


def start_parameter_values(
    hypotheses: Sequence[CauseHypothesis], n_parameters: int, approximate_sightings: Sightings | None
) -> Floats:
    """Start values (`n_parameters`,) [SI] of the parameters of additional effects, those of the shifts first.

    Shifts start at the start values of their hypotheses if `approximate_sightings` is not None; all other start values
    are zero.
    """
    shifts = [h.model_change for h in hypotheses if isinstance(h.model_change, ReadingShiftChange)]
    start_values = [
        s.start_values if approximate_sightings is not None and s.start_values else (0.0,) * len(s.effect.parameters)
        for s in shifts
    ]
    parameters = np.zeros(n_parameters)
    all_values = [v for value in start_values for v in value]
    parameters[: len(all_values)] = all_values
    return parameters


def subtract_shifts(
    recording: Recording, hypotheses: Sequence[CauseHypothesis], approximate_sightings: Sightings
) -> Recording:
    """Recording from whose readings the shifts of the hypotheses are subtracted; their sizes are the start values.

    `approximate_sightings` are the ranges and directions at which the shifts are computed.
    """
    readings = recording.readings.copy()
    for h in hypotheses:
        if isinstance(h.model_change, ReadingShiftChange) and h.model_change.start_values:
            readings -= h.model_change.effect.reading_change(
                approximate_sightings, np.array(h.model_change.start_values)
            )
    return recording.with_readings(readings)


def apply_corrections_and_omissions(recording: Recording, hypotheses: Sequence[CauseHypothesis]) -> Recording:
    """Recording with the model changes of the hypotheses, except shifts of readings and noise factors.

    Wrongly recorded pointings are corrected, centring errors declared, coordinates exchanged and wrong reference values
    removed.
    """
    readings, target, face = recording.readings.copy(), recording.target.copy(), recording.face.copy()
    for h in hypotheses:
        if isinstance(h.model_change, RowCorrection):
            rows = h.model_change.pointing_indices
            readings[rows], target[rows], face[rows] = (
                h.model_change.readings,
                h.model_change.target_indices,
                h.model_change.faces,
            )
    recording = recording.replace(readings=readings, target=target, face=face)
    for h in hypotheses:
        if isinstance(h.model_change, ReferenceOmission):
            recording = drop_reference(recording, h.model_change.reference_value)
        elif isinstance(h.model_change, CoordinateExchange):
            recording = exchange_coordinates(recording, *h.model_change.target_names)
        elif isinstance(h.model_change, CentringChange):
            centring = (*recording.setup.centring, h.model_change.centring_uncertainty)
            recording = recording.replace(setup=recording.setup.model_copy(update={"centring": centring}))
    return recording


def solve_without_outliers(
    problem: NetworkProblem, start_state: NetworkState, hypotheses: Sequence[CauseHypothesis]
) -> tuple[NetworkProblem, Solution[NetworkState]]:
    """Problem without outliers among the readings, and its solution, as near as possible to excluded points."""
    problem, solution = snoop_readings(problem, start_state, MAX_DECISION_CHANGES)
    excluded = [h.model_change.reference_value for h in hypotheses if isinstance(h.model_change, ReferenceOmission)]
    return problem, solution_near_excluded_points(problem, solution, excluded)


def hypothesis_with_centring_sigma(
    hypothesis: CauseHypothesis, estimate_function: Callable[[CauseHypothesis], tuple[Floats, Floats]]
) -> CauseHypothesis:
    """Hypothesis of centring errors with a new standard deviation s, estimated from the fitted displacements.

    `estimate_function` returns the q components u (q,) [m] of the displacements of a hypothesis, and their covariance C
    (q, q). The step of restricted maximum likelihood is s^2 = u'u / (q - tr(C) / s^2). Hypotheses of other kinds, and
    those whose s changes by less than `CENTRING_SIGMA_TOLERANCE`, are returned unchanged.
    """
    change = hypothesis.model_change
    if not isinstance(change, CentringChange):
        return hypothesis
    displacement, covariance = estimate_function(hypothesis)
    sigma = change.centring_uncertainty.sigma_mm * MILLIMETRE
    determined = len(displacement) - float(np.trace(covariance)) / sigma**2
    if determined < 1.0:
        return hypothesis
    factor = float(np.sqrt(displacement @ displacement / determined)) / sigma
    if abs(np.log(max(factor, 1e-3))) < CENTRING_SIGMA_TOLERANCE:
        return hypothesis
    centring = change.centring_uncertainty.model_copy(
        update={"sigma_mm": max(factor, 1e-3) * change.centring_uncertainty.sigma_mm}
    )
    return replace(hypothesis, model_change=replace(change, centring_uncertainty=centring))
