"""Mistakes, which no effect explains and which are in the model of the network before an effect is searched for."""

from __future__ import annotations

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.centring import correct_centring
from ltsim.adjustment.identification import Fit, Selection, adapted, outcomes
from ltsim.adjustment.identification.hypothesis import Hypothesis, NoiseFactor, Shift
from ltsim.adjustment.identification.selection import BEYOND_DOUBT
from ltsim.adjustment.snooping import LARGEST_ERROR
from ltsim.core.arrays import Bools
from ltsim.diagnosis.findings_from_tests import axis_finding, finding_of, gross_finding
from ltsim.diagnosis.schema import Finding
from ltsim.physics.model.construction import Construction
from ltsim.recordings.recording import OBSERVABLES, Recording

FAR_OUT = 8.0
"""Error of an outlier against its prediction, in standard deviations, that noise twice the declared one does not reach.
"""
AGREES = 4.0
"""Residual over the standard deviation up to which an omitted reading agrees: beyond the noise of any reading used."""
GROSS = 30.0
"""Standard deviations that a gross error exceeds too: noise of long sights is larger than any error of a tracker."""
PATTERN = 2
"""Outliers of one observable at one station or target up to which they are single errors."""


def mistakes_in(selection: Selection) -> list[Hypothesis]:
    """The hypotheses of a selection with which a network is adjusted before an effect is searched for.

    Rows that were written down wrongly and reference values that contradict the rest, where they are beyond doubt.
    Shifts only where one is gross, which no effect in first order reaches: then all of them, since each was judged with
    it.
    """
    fit, chosen = selection.fit, [c.hypothesis for c in selection.choices if c.gain > BEYOND_DOUBT]
    shifts = [h for h in chosen if isinstance(h.change, Shift)]
    gross = any(fit.displacement(h) > LARGEST_ERROR and fit.length(h) > GROSS for h in shifts)
    return [h for h in chosen if not isinstance(h.change, NoiseFactor) and (gross or not isinstance(h.change, Shift))]


def single_errors(fit: Fit) -> Bools:
    """Outliers (n, 3) that no effect explains: gross ones, and those far out that are alone at their place.

    Several readings of an observable that are off at one station or at one target may follow an effect instead.
    """
    error = np.where(fit.outliers, np.abs(fit.whitened), 0.0) / fit.prediction_spread
    far, single = error > FAR_OUT, fit.is_gross & (error > GROSS)
    for place in (fit.recording.station, fit.recording.target):
        count = np.stack([np.bincount(place, fit.outliers[:, k], place.max() + 1) for k in range(3)], axis=1)
        far &= count[place] <= PATTERN
    return single | far


def agreeing(adjustment: Adjustment, omitted: Bools) -> Bools:
    """Omitted readings (n, 3) that agree with an adjustment: with the effects of a diagnosis they are no errors."""
    whitened = np.nan_to_num(np.abs(adjustment.residuals / adjustment.problem.sigma), nan=np.inf)
    return omitted & (whitened < AGREES)


def adapted_baseline(
    recording: Recording, construction: Construction, selection: Selection, *, restored: Bools | None = None
) -> tuple[Adjustment, Bools, list[Finding]]:
    """The adjustment with the mistakes of a selection in its model, readings (n, 3) to use, and the findings.

    The recording of the adjustment is corrected by the estimates; what these are uncertain by is estimated in it.
    Readings that are `restored` (n, 3) are no errors.
    """
    fit, mistakes = selection.fit, mistakes_in(selection)
    errors = single_errors(fit)
    if restored is not None:
        errors &= ~restored
    baseline = adapted(fit, recording, construction, mistakes, subtracted=True, use=~errors)
    rows = {(int(i) + 1, OBSERVABLES[k]) for i, k in np.argwhere(errors)}
    places = {(h.kind, h.stations, h.targets) for h in mistakes}
    tests = [
        test
        for test in outcomes(selection)
        if (test.kind, test.where.stations, test.where.targets) in places
        or (test.kind == "outlier" and (test.rows[0], test.acts_on) in rows)
    ]
    moved, tripods = correct_centring(baseline)
    if tripods:
        baseline = adjust(moved, construction, effects=baseline.effects, use=~errors, start=baseline.state)
    axes = [test for test in baseline.axis_tests if test.excluded]
    return baseline, ~errors, [*map(finding_of, tests), *map(axis_finding, axes), *map(gross_finding, tripods)]
