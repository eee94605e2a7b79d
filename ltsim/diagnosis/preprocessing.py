"""Blunders of a recording, which no effect explains, and the adjustment without them before the search."""

from __future__ import annotations

from typing import cast

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.axes_point_tests import axes_point_tests_with_declared_points
from ltsim.adjustment.centring import correct_centring
from ltsim.adjustment.identification import CauseSelection, NetworkFit, adjust_with_causes, cause_tests
from ltsim.adjustment.identification.cause_selection import largest_displacement
from ltsim.adjustment.identification.cause_tests import reported_kind
from ltsim.adjustment.identification.hypothesis import (
    CauseHypothesis,
    CentringChange,
    NoiseFactorChange,
    ReadingShiftChange,
    includes_changed_noise,
)
from ltsim.adjustment.reliability import critical_normalised_residual
from ltsim.adjustment.significance import (
    MAX_CHANCE_SIGMAS,
    MAX_TRACKER_ERROR,
    MIN_GROSS_ERROR_SIGMAS,
)
from ltsim.core.arrays import Bools
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.diagnosis.findings_from_tests import axes_point_finding, blunder_finding, cause_test_finding
from ltsim.diagnosis.schema import Finding
from ltsim.physics.effects import CATALOGUE
from ltsim.physics.effects.linear_effect import CandidateEffect
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.recording import OBSERVABLES, Recording

MIN_FAR_OUTLIER_SIGMAS = 8.0
"""Smallest difference of an outlier from its prediction, in standard deviations, that may be a single error before the
search for effects. Readings with twice the declared noise do not reach this difference."""
MAX_SINGLE_OUTLIERS_PER_PLACE = 2
"""Largest number of outliers of one observable at a station, or at a target, that count as single errors. More outliers
may be the result of an effect."""


def causes_corrected_before_search(selection: CauseSelection) -> list[CauseHypothesis]:
    """Selected simple causes with sufficient evidence that are corrected before the search for effects.

    `selection` has the simple causes (such as outliers) of the recording. Those that are corrected are blunders in rows
    of the recording, and reference values that contradict the readings. Shifts of readings are included only if any
    shift is gross, because the search for effects, which is linear in their sizes, cannot explain a gross shift. Then
    all shifts are included, because each was tested given the others. Changed noise levels are not included.
    """
    fit, chosen = selection.fit, [c.hypothesis for c in selection.selected_hypotheses if c.is_certain]
    shifts = [h for h in chosen if isinstance(h.model_change, ReadingShiftChange | CentringChange)]
    gross = any(
        largest_displacement(fit, h) > MAX_TRACKER_ERROR and fit.estimate_length_in_sigmas(h) > MIN_GROSS_ERROR_SIGMAS
        for h in shifts
    )
    return [h for h in chosen if not isinstance(h.model_change, NoiseFactorChange) and (gross or h not in shifts)]


def effects_of_uncorrected_causes(selection: CauseSelection) -> tuple[CandidateEffect, ...]:
    """Catalogue effects among simple causes that are not corrected before other effects are sought, by certainty.

    Simple causes are, for example, outliers and moved targets.
    """
    corrected = causes_corrected_before_search(selection)
    changes = (
        c.hypothesis.model_change
        for c in selection.selected_hypotheses
        if c.is_certain and c.hypothesis not in corrected
    )
    effects = (change.effect for change in changes if isinstance(change, ReadingShiftChange))
    return tuple(cast(CandidateEffect, effect) for effect in effects if type(effect) in CATALOGUE)


def single_error_mask(fit: NetworkFit, min_error_sigmas: float = MIN_FAR_OUTLIER_SIGMAS) -> Bools:
    """Flags (n, 3) of the outliers of n pointings that count as single errors and not as results of an effect.

    Single errors are gross errors, and errors above `min_error_sigmas` standard deviations without others at the same
    place. If several readings of an observable are wrong at one station or at one target, an effect may be the cause.
    `fit` is the adjustment with the outliers.
    """
    error = np.where(fit.is_outlier, np.abs(fit.whitened_residuals), 0.0) / fit.outlier_prediction_error_sigmas
    isolated, gross = error > min_error_sigmas, fit.is_gross_reading & (error > MIN_GROSS_ERROR_SIGMAS)
    for place in (fit.recording.station, fit.recording.target):
        count = np.stack([np.bincount(place, fit.is_outlier[:, k], place.max() + 1) for k in range(3)], axis=1)
        isolated &= count[place] <= MAX_SINGLE_OUTLIERS_PER_PLACE
    return gross | isolated


def revised_error_mask(fit: NetworkFit, adjustment: Adjustment, error_mask: Bools) -> Bools:
    """Flags (n, 3) of the single errors among the readings of n pointings, in an adjustment with the selected effects.

    `error_mask` (n, 3) flags the readings that the adjustment does not use; those that agree with it are no errors. If
    the noise is estimated, outliers of `fit` that are single errors and also contradict the adjustment are added. `fit`
    is the adjustment with the simple causes, the noise and the outliers.
    """
    whitened = np.abs(adjustment.residuals) / fit.problem.reading_sigmas
    remaining_mask = error_mask & ~(np.nan_to_num(whitened, nan=np.inf) < MAX_CHANCE_SIGMAS)
    if not includes_changed_noise(fit.hypotheses):
        return remaining_mask
    redundancy = np.where(adjustment.redundancy > NORMAL_EQUATIONS_TOLERANCE, adjustment.redundancy, np.nan)
    limit = critical_normalised_residual(int(fit.problem_with_all_readings.is_used_reading.sum()))
    return remaining_mask | (single_error_mask(fit, 0.0) & (whitened > limit * np.sqrt(redundancy)))


def adjustment_without_blunders(
    recording: Recording,
    construction: GeometricErrorModel,
    selection: CauseSelection,
    *,
    error_mask: Bools | None = None,
) -> tuple[Adjustment, Bools, list[Finding]]:
    """Adjustment without blunders, flags (n, 3) of the readings of n pointings in it, and findings on blunders.

    The readings are corrected by the estimated blunders, whose uncertainty is in the model. `selection` has the simple
    causes of the recording. `construction` is the geometric error model of the instruments. `error_mask` (n, 3) flags
    the readings that are not used, by default the single errors.
    """
    fit, mistakes = selection.fit, causes_corrected_before_search(selection)
    errors = single_error_mask(fit) if error_mask is None else error_mask
    baseline = adjust_with_causes(fit, recording, construction, mistakes, subtracts_changes=True, reading_mask=~errors)
    rows = {(int(i) + 1, OBSERVABLES[k]) for i, k in np.argwhere(errors)}
    places = {(reported_kind(fit, h), h.stations, h.targets) for h in mistakes}
    tests = [
        test
        for test in cause_tests(selection)
        if (test.kind, test.where.stations, test.where.targets) in places
        or (test.kind == "outlier" and (test.rows[0], test.acts_on) in rows)
    ]
    moved, tripods = correct_centring(baseline)
    if tripods:
        baseline = adjust(
            moved, construction, effects=baseline.effects, reading_mask=~errors, start_state=baseline.state
        )
    findings = [*map(cause_test_finding, tests), *map(blunder_finding, tripods)]
    return baseline, ~errors, list(map(_corrected_before_search, findings))


def axes_point_findings(final_adjustment: Adjustment, declared_recording: Recording) -> list[Finding]:
    """Findings on points whose coordinates, declared in `declared_recording`, contradict the axes by the other points.

    They are tested in `final_adjustment`, which has the selected causes in its model. Without these causes a right
    point would contradict the readings to a target that moved.
    """
    tests = axes_point_tests_with_declared_points(final_adjustment, declared_recording)
    return [_corrected_before_search(axes_point_finding(test)) for test in tests if test.is_excluded]


def _corrected_before_search(finding: Finding) -> Finding:
    """Copy of a finding that is marked as corrected before the search for effects."""
    return finding.model_copy(update={"is_corrected_before_search": True})
