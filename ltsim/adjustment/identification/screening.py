"""Approximate test (screening) of all hypotheses on errors of a network, by their gain of log evidence.

Two methods are used, and the larger gain counts. Projection onto the residual space of a fit is exact for small errors.
A fit to the residuals of one station or target, with the rest of the network unchanged, detects errors of any size
whose readings were rejected as outliers. Both methods only rank hypotheses; each selected one is fitted to the network.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.fit_readings import FitReadings
from ltsim.adjustment.fitting import fit_point
from ltsim.adjustment.identification.approximate_gains import (
    approximate_log_evidence_gains,
    log_evidence_gain,
    log_evidence_gains_of_scores,
    weighted_family_designs,
)
from ltsim.adjustment.identification.centring_errors import centring_hypotheses, local_centring_hypotheses
from ltsim.adjustment.identification.evidence import (
    estimate_noise_factors_of_groups,
    log_occam_factor_of_shift,
    log_occam_factor_of_variance,
    log_prior_of_kind,
)
from ltsim.adjustment.identification.fit import NetworkFit
from ltsim.adjustment.identification.hypothesis import CauseHypothesis, NoiseFactorChange, ReadingShiftChange
from ltsim.adjustment.identification.hypothesis_library import (
    ShiftCandidate,
    noise_hypotheses,
    reference_omissions,
    row_corrections,
    shift_candidates,
)
from ltsim.adjustment.identification.local_shifts import LocalShiftProblem, fit_local_shifts
from ltsim.adjustment.reference_tests import ReferenceTest, reference_tests
from ltsim.adjustment.reference_values import with_nonzero_reference_sigmas
from ltsim.adjustment.residual_space import MAX_SCREENED_ENTRIES, ResidualSpace
from ltsim.core.arrays import Bools, Floats, Ints, batches
from ltsim.core.errors import NetworkError
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE
from ltsim.physics.effects.gauge_scale import GaugeScale
from ltsim.physics.effects.motions import reading_change_by_displacement
from ltsim.solve.gauss_newton import solve

MIN_OUTLIERS_FOR_DISTANCE_TRIAL = 6
"""Limit of the number of outliers in a network. If it is exceeded, trial fits are made without the distances of one
station or target."""
MIN_GROSS_FRACTION_FOR_TRIAL = 0.4
"""Limit of the fraction of gross errors among the pointings of a station or target. If it is exceeded, a motion of the
target is tested, or a trial fit is made without the distances."""
MAX_FITTED_HYPOTHESES = 4
"""Largest number of hypotheses that one step of the selection fits; also of failed fits and of trial fits."""
MIN_SCALE_TEST_LENGTHS = 2
"""Smallest number of reference lengths for a test of their common scale error."""
ScreenedHypothesis = tuple[float, CauseHypothesis]
"""Tuple of the approximate gain of log evidence by a hypothesis, and the hypothesis."""


def screened_hypotheses(fit: NetworkFit) -> list[ScreenedHypothesis]:
    """Hypotheses that may explain the misfit of a fit, each preceded by its approximate gain; largest gain first."""
    every = shift_candidates(fit.adjustment.sightings)
    gains = np.full(len(every), -np.inf)
    non_robust_fit = _non_robust_fit(fit)
    spaces = [(ResidualSpace.from_adjustment(fit.adjustment), 0.0)]
    if non_robust_fit is not None:
        spaces.append((ResidualSpace.from_adjustment(non_robust_fit[0]), non_robust_fit[1]))
    for space, behind in spaces:
        gains = np.maximum(gains, _projected_log_evidence_gains(space, every) + behind)
    guesses = [np.zeros(c.family.design.shape[2]) for c in every]
    if fit.is_outlier.any():
        local, guesses = _local_shift_gains_and_starts(fit, every)
        gains = np.maximum(gains, local)
        for i, gain, guess in _moved_target_candidates(fit, every):
            if gain > gains[i]:
                gains[i], guesses[i] = gain, guess
    ranked = [(float(gains[i]), i) for i in np.argsort(-gains).tolist() if gains[i] > 0.0]
    offers = [(gain, every[i].make_hypothesis(guesses[i])) for gain, i in _best_onset_per_place(ranked, every)]
    for space, behind in spaces:
        offers += [(gain + behind, h) for gain, h in _reference_hypotheses(fit, space.adjustment)]
        offers += [(gain + behind, h) for gain, h in _length_scale_hypothesis(fit, space)]
        offers += [(gain + behind, h) for gain, h in centring_hypotheses(fit, space)]
    if fit.is_outlier.any():
        offers += [(_gain_by_outliers(fit, np.array(h.row_numbers) - 1) + h.log_prior, h) for h in row_corrections(fit)]
        offers += [
            (_gain_by_outliers(fit, _affected_pointings(fit, h)) + h.log_prior, h)
            for h in reference_omissions(fit)
            if h.targets or h.stations
        ]
        offers += local_centring_hypotheses(fit)
    offers += _noise_hypotheses(fit)
    if fit.is_outlier.sum() > MIN_OUTLIERS_FOR_DISTANCE_TRIAL:
        offers += _distance_trial_hypotheses(fit, every)
    offers.sort(key=lambda offer: -offer[0])
    return offers


def _non_robust_fit(fit: NetworkFit) -> tuple[Adjustment, float] | None:
    """Least-squares fit of all readings, and its log evidence minus that of the robust fit `fit` (at most 0).

    The result is None if the robust fit has no outliers, or if the least-squares fit does not converge.
    """
    if not fit.is_outlier.any():
        return None
    solution = solve(fit.problem_with_all_readings, fit.state)
    if solution.factor is None or not solution.has_converged:
        return None
    evidence_deficit = -0.5 * (solution.sum_of_squares - fit.solution.sum_of_squares) - fit.outlier_log_evidence
    return replace(fit.adjustment, problem=fit.problem_with_all_readings, solution=solution), min(evidence_deficit, 0.0)


def _best_onset_per_place(
    ranked_candidates: Sequence[tuple[float, int]], candidates: Sequence[ShiftCandidate]
) -> list[tuple[float, int]]:
    """Gains and indices of the best candidates, one (with the best onset time) per kind of error, stations and targets.

    `ranked_candidates` contains gains and indices of all candidates, the largest gain first.
    """
    places, best = set[tuple[object, ...]](), []
    for gain, i in ranked_candidates:
        key = candidates[i].place_key
        if key not in places:
            places.add(key)
            best.append((gain, i))
    return best


def _projected_log_evidence_gains(residual_space: ResidualSpace, candidates: Sequence[ShiftCandidate]) -> Floats:
    """Gains (h,) of log evidence by h candidate shifts, from residuals of a fit and projected design columns."""
    gains = np.full(len(candidates), -np.inf)
    indices = np.arange(len(candidates))
    n_entries = np.array([residual_space.n_equations * c.family.design.shape[2] for c in candidates], dtype=np.int64)
    if n_entries.sum() > MAX_SCREENED_ENTRIES:
        indices = np.argsort(-approximate_log_evidence_gains(residual_space, candidates))
        indices = indices[np.cumsum(n_entries[indices]) <= MAX_SCREENED_ENTRIES]
    by_rank: dict[int, list[int]] = {}
    for i in indices.tolist():
        by_rank.setdefault(candidates[i].family.design.shape[2], []).append(i)
    for rank, group in by_rank.items():
        for batch in (group[part] for part in batches(len(group), residual_space.n_equations * rank)):
            rows = np.hstack([_whitened_design(residual_space, candidates[i]) for i in batch])
            projected = residual_space.project(rows).reshape(residual_space.n_equations, len(batch), rank)
            size = residual_space.norms_without_centring(rows).reshape(len(batch), rank)
            unit = projected / np.where(size > 0, size, 1.0)
            gram = np.einsum("mhi,mhj->hij", unit, unit)
            score = np.einsum("mhi,m->hi", unit, residual_space.whitened_residuals)
            gain = log_evidence_gains_of_scores(gram, score, NORMAL_EQUATIONS_TOLERANCE)
            gains[batch] = gain + [candidates[i].log_prior for i in batch]
    return gains


def _whitened_design(residual_space: ResidualSpace, candidate: ShiftCandidate) -> Floats:
    """Whitened design columns (m, q) of a candidate shift with q parameters, for the m equations of an adjustment."""
    design = np.zeros_like(candidate.family.design)
    design[candidate.affected_rows] = candidate.family.design[candidate.affected_rows]
    return residual_space.whiten(design)


def _local_shift_gains_and_starts(fit: NetworkFit, candidates: Sequence[ShiftCandidate]) -> tuple[Floats, list[Floats]]:
    """Gains (h,) of log evidence by h candidate shifts with the network unchanged, and start values of each shift.

    A shift gains evidence if its readings are no longer outliers. The network may agree with the readings before or
    after the onset of a shift. In the second case the earlier readings show the negative shift. Both cases are tested.
    """
    gains = np.full(len(candidates), -np.inf)
    guesses = [np.zeros(c.family.design.shape[2]) for c in candidates]
    price = -log_prior_of_kind("outlier", int(fit.problem_with_all_readings.is_used_reading.sum())) - float(
        log_occam_factor_of_shift(10.0, 1)
    )
    weighted = weighted_family_designs(
        candidates, fit.problem_with_all_readings.is_used_reading, fit.problem.reading_sigmas
    )
    gross = np.asarray(fit.is_outlier.any(axis=1))
    trials = list[tuple[int, float, LocalShiftProblem]]()
    for i, c in enumerate(candidates):
        for sign, rows in ((1.0, c.affected_rows), (-1.0, c.earlier_rows)):
            out = int(gross[rows].sum())
            if 4 * out < len(rows) or 3 * out < c.family.design.shape[2] or not out:
                continue
            shift = LocalShiftProblem.from_design(weighted[i][rows], fit.whitened_residuals[rows], fit.is_outlier[rows])
            trials += [(i, sign, shift)] if shift.has_outliers_and_parameters else []
    fits = fit_local_shifts([shift for *_, shift in trials], price)
    for (i, sign, _), (saved, guess) in zip(trials, fits, strict=True):
        gain = saved + float(log_occam_factor_of_shift(10.0, len(guess))) + candidates[i].log_prior
        if gain > gains[i]:
            gains[i], guesses[i] = gain, sign * guess
    return gains, guesses


def _moved_target_candidates(
    fit: NetworkFit, candidates: Sequence[ShiftCandidate]
) -> Iterator[tuple[int, float, Floats]]:
    """Candidates for targets that moved far: index, gain of log evidence, and displacement (3,) [m].

    The position of each target is computed separately from the pointings before and after the onset. Other methods fail
    for a large motion, because the adjusted position lies between both positions and no reading to the target fits.
    """
    gross, sightings = np.asarray(fit.is_outlier.any(axis=1)), fit.adjustment.sightings
    moved_indices = [i for i, c in enumerate(candidates) if c.family.kind == "target-moved"]
    share = {
        candidates[i].place.targets: float(
            gross[np.append(candidates[i].affected_rows, candidates[i].earlier_rows)].mean()
        )
        for i in moved_indices
    }
    suspects = sorted(
        (name for name in share if share[name] > MIN_GROSS_FRACTION_FOR_TRIAL), key=lambda name: -share[name]
    )[:MAX_FITTED_HYPOTHESES]
    price = -log_prior_of_kind("outlier", int(fit.problem_with_all_readings.is_used_reading.sum())) - float(
        log_occam_factor_of_shift(10.0, 1)
    )
    sigma = fit.problem.reading_sigmas
    for i in (i for i in moved_indices if candidates[i].place.targets in suspects):
        parts = candidates[i].earlier_rows, candidates[i].affected_rows
        points = [point for rows in parts if (point := _target_position(fit, rows)) is not None]
        if len(points) < len(parts):
            continue
        displacement = np.zeros((len(sightings), 3))
        for rows, point in zip(parts, points, strict=True):
            displacement[rows] = point - fit.state.target_points[sightings.target[rows]]
        both = np.concatenate(parts)
        rest = (fit.residuals - reading_change_by_displacement(sightings, displacement))[both] / sigma[both]
        used = fit.problem_with_all_readings.is_used_reading[both]
        saved = sum(
            sign * float(np.minimum(0.5 * w[used] ** 2, price).sum())
            for sign, w in ((1.0, fit.whitened_residuals[both]), (-1.0, rest))
        )
        yield i, saved + float(log_occam_factor_of_shift(10.0, 3)) + candidates[i].log_prior, points[1] - points[0]


def _target_position(fit: NetworkFit, pointing_indices: Ints) -> Floats | None:
    """Position (3,) [m] of a target from some pointings (indices), with unchanged stations; None if not unique."""
    pointing_indices = pointing_indices[fit.problem_with_all_readings.is_used_reading[pointing_indices].any(axis=1)]
    sight, station = (
        FitReadings.from_recording(fit.recording).select_rows(pointing_indices),
        fit.recording.station[pointing_indices],
    )
    usable = replace(
        sight,
        readings=np.where(fit.problem_with_all_readings.is_used_reading[pointing_indices], sight.readings, np.nan),
    )
    return fit_point(usable, fit.state.station_positions[station], fit.state.station_rotations[station])


def _distance_trial_hypotheses(fit: NetworkFit, candidates: Sequence[ShiftCandidate]) -> list[ScreenedHypothesis]:
    """Hypotheses of offsets and scale errors of distances at the stations and targets with most outliers.

    Distances with large errors displace the target or station, so that its angles have large residuals too. The network
    is therefore fitted without these distances, and the error is estimated from their residuals. The list is empty if
    gross pointings are frequent in the whole recording. Each hypothesis is preceded by its gain of log evidence.
    """
    gross = np.asarray((fit.is_outlier & fit.is_gross_reading).any(axis=1))
    if gross.mean() > MIN_GROSS_FRACTION_FOR_TRIAL:
        return []
    tried = [c for c in candidates if c.family.acts_on == "distance" and np.isneginf(c.onset_time)]
    share = {id(c): float(gross[c.affected_rows].mean()) for c in tried}
    price = -log_prior_of_kind("outlier", int(fit.problem_with_all_readings.is_used_reading.sum())) - float(
        log_occam_factor_of_shift(10.0, 1)
    )
    offers, fits = list[ScreenedHypothesis](), dict[object, NetworkFit | None]()
    for c in sorted(tried, key=lambda c: -share[id(c)]):
        names = c.place.stations, c.place.targets
        if names not in fits:
            if len(fits) == MAX_FITTED_HYPOTHESES or not share[id(c)] > MIN_GROSS_FRACTION_FOR_TRIAL:
                continue
            fits[names] = _fit_without_distances(fit, c.affected_rows)
        aside = fits[names]
        if aside is None:
            continue
        use = c.affected_rows[fit.problem_with_all_readings.is_used_reading[c.affected_rows, 0]]
        g = c.family.design[use, 0, 0] / fit.problem.reading_sigmas[use, 0]
        r = aside.residuals_of_recording(fit.recording)[use, 0] / fit.problem.reading_sigmas[use, 0]
        acts = g != 0.0
        if not acts.any():
            continue
        guess = float(np.median(r[acts] / g[acts]))
        rest = float(np.minimum(0.5 * (r - g * guess) ** 2, price).sum())
        gain = aside.log_evidence - rest - fit.log_evidence + float(log_occam_factor_of_shift(10.0, 1)) + c.log_prior
        offers.append((gain, c.make_hypothesis(np.array([guess]))))
    return offers


def _fit_without_distances(fit: NetworkFit, rows: Ints) -> NetworkFit | None:
    """New fit without the distances of the pointings `rows`; None if they are necessary to determine the network."""
    readings = fit.fit_input.recording.readings.copy()
    readings[rows, 0] = np.nan
    fit_input = replace(fit.fit_input, recording=fit.fit_input.recording.with_readings(readings))
    try:
        return NetworkFit.from_start(fit_input, fit.hypotheses)
    except NetworkError:
        return None


def _gain_by_outliers(fit: NetworkFit, pointing_indices: Ints) -> float:
    """Gain of log evidence if a hypothesis explains all outliers among the pointings `pointing_indices`."""
    is_outlier = fit.is_outlier[pointing_indices]
    w = np.abs(fit.whitened_residuals[pointing_indices][is_outlier])
    return -float(np.sum(log_occam_factor_of_shift(w, 1))) - len(w) * log_prior_of_kind(
        "outlier", int(fit.problem_with_all_readings.is_used_reading.sum())
    )


def _affected_pointings(fit: NetworkFit, hypothesis: CauseHypothesis) -> Ints:
    """Indices of the pointings from the stations, or to the targets, where a hypothesis acts."""
    recording = fit.recording
    targets = [recording.targets.index(name) for name in hypothesis.targets]
    stations = [recording.stations.index(name) for name in hypothesis.stations]
    return np.flatnonzero(np.isin(recording.target, targets) | np.isin(recording.station, stations))


def _reference_hypotheses(fit: NetworkFit, adjustment: Adjustment) -> list[ScreenedHypothesis]:
    """Hypotheses that a reference value is wrong, with approximate gains of log evidence from tests in `adjustment`."""
    problem = with_nonzero_reference_sigmas(adjustment.problem, adjustment.state)
    solution = adjustment.solution if problem is adjustment.problem else solve(problem, adjustment.state)
    tests: dict[tuple[str, str], ReferenceTest] = {}
    if solution.factor is not None:
        tests = {(t.kind, t.name): t for t in reference_tests(problem, solution)}
    offers = []
    for h in reference_omissions(fit):
        test = tests.get((h.acts_on, h.reference_name_or_sentence))
        if test is not None and test.rank:
            offers.append((log_evidence_gain(test.chi2_drop, test.rank) + h.log_prior, h))
    return offers


def _length_scale_hypothesis(fit: NetworkFit, residual_space: ResidualSpace) -> list[ScreenedHypothesis]:
    """Hypothesis that reference lengths and distances differ in scale, after its gain of log evidence, as a list."""
    scale = GaugeScale()
    if any(h.kind == "reference-scale" for h in fit.hypotheses) or len(fit.problem.gauge_rows) < MIN_SCALE_TEST_LENGTHS:
        return []
    drop, rank = residual_space.chi2_drop(residual_space.whitened_design(scale))
    prior = log_prior_of_kind("reference-scale", 1)
    scale_hypothesis = CauseHypothesis("reference-scale", "length", (), (), prior, ReadingShiftChange(scale))
    return [(log_evidence_gain(drop, rank) + prior, scale_hypothesis)] if rank else []


def _noise_hypotheses(fit: NetworkFit) -> list[ScreenedHypothesis]:
    """Hypotheses that noise is not as declared, each preceded by its gain of log evidence."""
    return [_best_noise_hypothesis(fit, h, readings) for h, readings in noise_hypotheses(fit)]


def _best_noise_hypothesis(fit: NetworkFit, hypothesis: CauseHypothesis, reading_mask: Bools) -> ScreenedHypothesis:
    """Largest gain of log evidence by a factor on the noise of some readings, and the hypothesis with this factor.

    `reading_mask` (n, 3) flags the readings whose noise `hypothesis` changes. If the noise is larger than declared,
    some outliers are correct readings: those with the smallest residuals, as many as maximise the gain.
    """
    within, out = reading_mask & fit.problem.is_used_reading, reading_mask & fit.is_outlier
    residual_sizes = np.sort(np.abs(fit.whitened_residuals[out]))
    squares = np.sum(fit.whitened_residuals[within] ** 2) + np.append(0.0, np.cumsum(residual_sizes**2))
    redundancy = np.nansum(fit.redundancy[within]) + np.arange(len(residual_sizes) + 1)
    factor, gain = estimate_noise_factors_of_groups(squares, redundancy)
    # The gain contains the outliers with the declared noise; their log evidence as outliers replaces this part.
    price = -log_occam_factor_of_shift(residual_sizes, 1) - log_prior_of_kind(
        "outlier", int(fit.problem_with_all_readings.is_used_reading.sum())
    )
    gain = gain + np.append(0.0, np.cumsum(price - 0.5 * residual_sizes**2)) + log_occam_factor_of_variance(redundancy)
    best_index = int(np.argmax(gain))
    change = NoiseFactorChange(reading_mask, float(factor[best_index]))
    return float(gain[best_index]) + hypothesis.log_prior, replace(hypothesis, model_change=change)
