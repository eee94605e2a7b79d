"""List `tests` in every result file: identified errors and outliers, with their sizes and probabilities."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from ltsim.adjustment.identification.cause_selection import INFINITE_GAIN_SUBSTITUTE, CauseSelection, SelectedHypothesis
from ltsim.adjustment.identification.cause_sentences import (
    cause_sentence,
    estimate_sigma_and_unit,
    seating_row_numbers,
)
from ltsim.adjustment.identification.evidence import log_occam_factor_of_shift, log_prior_of_kind
from ltsim.adjustment.identification.fit import NetworkFit
from ltsim.adjustment.identification.hypothesis import (
    CauseHypothesis,
    CauseKind,
    CentringChange,
    NoiseFactorChange,
    ReadingShiftChange,
    ReferenceOmission,
)
from ltsim.adjustment.identification.noise_sentences import estimated_noise_factor
from ltsim.adjustment.identification.reference_misclosures import misclosure_estimate
from ltsim.adjustment.significance import MIN_REPORTED_PROBABILITY
from ltsim.core.notation import with_sigma
from ltsim.core.units import ARCSECOND, MILLIMETRE
from ltsim.recordings.recording import OBSERVABLES
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat


class CausePlace(Entry):
    """Stations and targets where an error acts."""

    stations: tuple[str, ...] = ()
    """Names of the stations; empty for all."""
    targets: tuple[str, ...] = ()
    """Names of the targets; empty for all."""


class AlternativeCause(Entry):
    """Alternative hypothesis that was fitted in place of a selected hypothesis, for comparison."""

    kind: str
    """Kind of the alternative error, with the same values as `CauseTest.kind`."""
    where: CausePlace
    """Stations or targets where the alternative error acts."""
    probability: Finite
    """Posterior probability of the alternative hypothesis."""


class CauseTest(Entry):
    """Test of a hypothesis on one error, in the network with all selected hypotheses."""

    kind: str
    """Kind of the error: `outlier`, `constant-offset`, `scale-error`, `target-moved`, `station-bump` and so on."""
    acts_on: str
    """Quantity that the error changes: an observable, `position` (of a target or station), a kind of reference value,
    or `noise`."""
    where: CausePlace
    """Stations or targets where the error acts."""
    statistic: Finite
    """Test statistic: decrease of chi-square by the hypothesis; for noise and blunders twice the gain of log
    evidence."""
    dof: int
    """Degrees of freedom of `statistic`: number of components of the error."""
    p_value: OptionalFloat = None
    """p-value of `statistic`, not corrected for the number of tests; null for noise, blunders and centring errors."""
    estimate: OptionalFloat = None
    """Estimated size of the error, in `unit`; for noise the factor on the declared noise."""
    sigma: OptionalFloat = None
    """Standard deviation of the estimate, in `unit`."""
    unit: str = ""
    """Unit of the estimate and of its standard deviation."""
    rows: tuple[int, ...] = ()
    """Affected rows of the recording, from 1; empty for more than 20 rows."""
    probability: OptionalFloat = None
    """Posterior probability of the hypothesis, compared with its alternatives and with no error."""
    alternatives: tuple[AlternativeCause, ...] = ()
    """Hypotheses that were fitted in place of the tested hypothesis and have a posterior probability above 1 %."""
    accepted: bool = True
    """True if the hypothesis is selected as a cause of the misfit."""
    is_in_model: bool = True
    """True if the adjusted model of the result contains this cause, so that the coordinates are corrected for it."""
    sentence: str = ""
    """Result of the test as a sentence."""

    @property
    def is_fault(self) -> bool:
        """True for a selected hypothesis that requires an action of the user: all but noise smaller than declared."""
        return self.accepted and not (self.kind == "noise-level" and (self.estimate or 0.0) <= 1.0)


MAX_LISTED_OUTLIERS = 20
"""Largest number of outliers that the list of tests contains, and of row numbers that one test lists."""


def cause_tests(selection: CauseSelection) -> tuple[CauseTest, ...]:
    """Tests of the selected hypotheses in their order, followed by tests of the outliers."""
    fit = selection.fit
    return (
        *(_test_of_selected_hypothesis(fit, choice) for choice in selection.selected_hypotheses),
        *_outlier_tests(fit),
    )


def _test_of_selected_hypothesis(fit: NetworkFit, selected_hypothesis: SelectedHypothesis) -> CauseTest:
    """Test of one selected hypothesis of a fit, as an entry for the list of all tests."""
    h = selected_hypothesis.hypothesis
    size_entries: dict[str, Any] = {}
    drop, rank = max(2.0 * min(selected_hypothesis.log_evidence_gain, INFINITE_GAIN_SUBSTITUTE), 0.0), 1
    if isinstance(h.model_change, ReadingShiftChange):
        values, covariance = fit.estimate_and_covariance(h)
        drop, rank = fit.estimate_length_in_sigmas(h) ** 2, len(values)
        size_entries = estimate_sigma_and_unit(h, values, covariance)
    elif isinstance(h.model_change, ReferenceOmission):
        rank = len(h.model_change.reference_value.declared_sigmas)
        size_entries = misclosure_estimate(fit, h)
    elif isinstance(h.model_change, NoiseFactorChange):
        size_entries = {"estimate": estimated_noise_factor(fit, h)}
    elif isinstance(h.model_change, CentringChange):
        rank = len(fit.estimate_and_covariance(h)[0])
        size_entries = {"estimate": h.model_change.centring_uncertainty.sigma_mm, "unit": "mm"}
        if (common := fit.common_displacement_length(h)) is not None:
            size_entries |= {"estimate": common.length / MILLIMETRE, "sigma": common.length_sigma / MILLIMETRE}
    p = (
        float(special.chdtrc(rank, drop))
        if isinstance(h.model_change, ReadingShiftChange | ReferenceOmission)
        else None
    )
    rows = seating_row_numbers(fit, h) if h.kind == "reflector-seating" else h.row_numbers
    share = selected_hypothesis.posterior_probabilities.tolist()
    alternatives = tuple(
        AlternativeCause(
            kind=other.kind, where=CausePlace(stations=other.stations, targets=other.targets), probability=s
        )
        for (other, _), s in zip(selected_hypothesis.alternatives, share[1:-1], strict=True)
        if s > MIN_REPORTED_PROBABILITY
    )
    rival_names = [
        other.reference_name_or_sentence
        for (other, _), s in zip(selected_hypothesis.alternatives, share[1:-1], strict=True)
        if s > MIN_REPORTED_PROBABILITY and isinstance(other.model_change, ReferenceOmission)
    ]
    return CauseTest(
        kind=reported_kind(fit, h),
        acts_on=h.acts_on,
        where=CausePlace(stations=h.stations, targets=h.targets),
        statistic=drop,
        dof=rank,
        p_value=p,
        rows=rows if len(rows) <= MAX_LISTED_OUTLIERS else (),
        probability=share[0],
        alternatives=alternatives,
        sentence=cause_sentence(fit, h, rival_names),
        **size_entries,
    )


def reported_kind(fit: NetworkFit, hypothesis: CauseHypothesis) -> CauseKind:
    """Kind under which a hypothesis is reported: centring errors of equal length are reported as another SMR radius."""
    if fit.common_displacement_length(hypothesis) is not None:
        return "reflector-radius"
    return hypothesis.kind


def _outlier_tests(fit: NetworkFit) -> list[CauseTest]:
    """Entries of the list of tests for rejected readings (outliers), the largest residual first.

    Each rejected reading is compared with its prediction by the readings in use.
    """
    recording, tests = fit.recording, list[CauseTest]()
    indices = np.argwhere(fit.is_outlier)
    indices = indices[np.argsort(-np.abs(fit.whitened_residuals[fit.is_outlier]))][:MAX_LISTED_OUTLIERS]
    for i, k in indices.tolist():
        station, target = recording.stations[recording.station[i]], recording.targets[recording.target[i]]
        unit, factor = ("mm", MILLIMETRE) if k == 0 else ("arcsec", ARCSECOND)
        prediction_sigma = fit.outlier_prediction_error_sigmas[i, k]
        value, sigma = float(fit.residuals[i, k]), float(fit.problem.reading_sigmas[i, k] * prediction_sigma)
        drop = (value / sigma) ** 2
        sentence = (
            f"The {OBSERVABLES[k]} from {station} to {target} (row {i + 1}) is off by "
            f"{with_sigma(abs(value) / factor, sigma / factor, unit)}: measure it again."
        )
        moved = _probability_of_moved_target(fit, i, drop)
        tests.append(
            CauseTest(
                kind="outlier",
                acts_on=OBSERVABLES[k],
                where=CausePlace(stations=(station,), targets=(target,)),
                statistic=drop,
                dof=1,
                p_value=float(special.chdtrc(1, drop)),
                estimate=value / factor,
                sigma=sigma / factor,
                unit=unit,
                rows=(i + 1,),
                probability=1.0 - moved,
                alternatives=(
                    AlternativeCause(kind="target-moved", where=CausePlace(targets=(target,)), probability=moved),
                )
                if moved > MIN_REPORTED_PROBABILITY
                else (),
                sentence=sentence,
            )
        )
    return tests


def _probability_of_moved_target(fit: NetworkFit, row: int, chi2_drop: float) -> float:
    """Posterior probability that the outlier with the pointing index `row` is caused by a motion of its target.

    `chi2_drop` is the decrease of chi-square by the rejection of the outlier. The probability is 0 unless the outlier
    is the last pointing to its target, because later pointings would show the motion.
    """
    s = fit.adjustment.sightings
    same_rows = np.flatnonzero(s.target == s.target[row])
    if same_rows[np.argmax(s.time[same_rows])] != row or len(same_rows) < 2:
        return 0.0
    w = float(np.sqrt(chi2_drop))
    odds = log_prior_of_kind("target-moved", len(s)) - log_prior_of_kind(
        "outlier", int(fit.problem_with_all_readings.is_used_reading.sum())
    )
    odds += (
        float(log_occam_factor_of_shift(w, 3))
        - float(log_occam_factor_of_shift(w, 1))
        + 0.5 * float(np.nansum(fit.adjustment.normalised_residuals[row] ** 2))
    )
    return 1.0 / (1.0 + float(np.exp(-odds)))
