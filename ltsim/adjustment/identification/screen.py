"""Screening of all hypotheses by an approximate gain of log evidence, given a fit.

Two methods are used, and the larger gain counts. The residual space of a fit is exact for a small cause. The residuals
of single pointings, with the network unchanged, reveal a cause of any size whose readings were rejected as outliers.
Both only rank hypotheses: results come from a fit with the hypothesis in the model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.fitting import fit_point
from ltsim.adjustment.identification.evidence import log_prior_of, occam, occam_of_variance, variance_factor
from ltsim.adjustment.identification.fit import Fit
from ltsim.adjustment.identification.hypothesis import Hypothesis, NoiseFactor, Shift
from ltsim.adjustment.identification.library import Candidate, candidates, corrections, noises, omissions
from ltsim.adjustment.identification.local_shifts import LocalShift, fitted_shifts
from ltsim.adjustment.reference_tests import ReferenceTest, reference_tests, relaxed_references
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.sight import Sight
from ltsim.adjustment.significance import UNCHECKED
from ltsim.core.arrays import AT_ONCE, Bools, Floats, Ints
from ltsim.physics.effects.gauge_scale import GaugeScale
from ltsim.physics.effects.motions import exact_target_change
from ltsim.solve.gauss_newton import solve

EXACT = 3_000_000
"""Number of entries of all signatures up to which all are projected exactly; of more only the best ones by their own
rows.
"""
MANY = 6
HALF = 0.4
PLACES = 5
"""Number of outliers, and fraction of gross ones among a place's pointings, from which its distances are removed for a
trial; number of such places.
"""
SEVERAL = 2
"""Smallest number of reference lengths that share a scale."""


def looks(fit: Fit) -> list[tuple[float, Hypothesis]]:
    """Hypotheses with their approximate gain of log evidence, the largest first."""
    every = candidates(fit.adjustment.sightings)
    gains = np.full(len(every), -np.inf)
    plain = _plain(fit)
    spaces = [(ResidualSpace.of(fit.adjustment), 0.0)]
    if plain is not None:
        spaces.append((ResidualSpace.of(plain[0]), plain[1]))
    for space, behind in spaces:
        gains = np.maximum(gains, _exact(space, every) + behind)
    guesses = [np.zeros(c.family.design.shape[2]) for c in every]
    if fit.outliers.any():
        local, guesses = _local(fit, every)
        gains = np.maximum(gains, local)
        for i, gain, guess in _moved_targets(fit, every):
            if gain > gains[i]:
                gains[i], guesses[i] = gain, guess
    ranked = [(float(gains[i]), i) for i in np.argsort(-gains).tolist() if gains[i] > 0.0]
    offers = [(gain, every[i].hypothesis(guesses[i])) for gain, i in _best_per_place(ranked, every)]
    for space, behind in spaces:
        offers += [(gain + behind, h) for gain, h in _references(fit, space.adjustment)]
        offers += [(gain + behind, h) for gain, h in _scale_of_lengths(fit, space)]
    if fit.outliers.any():
        offers += [(_paid(fit, np.array(h.rows) - 1) + h.log_prior, h) for h in corrections(fit)]
        offers += [(_paid(fit, _rows_of(fit, h)) + h.log_prior, h) for h in omissions(fit) if h.targets]
    offers += _noises(fit)
    if fit.outliers.sum() > MANY:
        offers += _distances_aside(fit, every)
    offers.sort(key=lambda offer: -offer[0])
    return offers


def _plain(fit: Fit) -> tuple[Adjustment, float] | None:
    """Least-squares fit of all readings, and its deficit of log evidence; None if it equals the robust fit."""
    if not fit.outliers.any():
        return None
    solution = solve(fit.whole, fit.state)
    if solution.factor is None or not solution.converged:
        return None
    behind = -0.5 * (solution.cost - fit.solution.cost) - fit.outlier_terms
    return replace(fit.adjustment, problem=fit.whole, solution=solution), min(behind, 0.0)


def _best_per_place(ranked: Sequence[tuple[float, int]], every: Sequence[Candidate]) -> list[tuple[float, int]]:
    """Best time of each kind of hypothesis at each place."""
    places, best = set[tuple[str, str, str]](), []
    for gain, i in ranked:
        candidate = every[i]
        key = candidate.family.kind, candidate.family.acts_on, candidate.name
        if key not in places:
            places.add(key)
            best.append((gain, i))
    return best


def _exact(space: ResidualSpace, every: Sequence[Candidate]) -> Floats:
    """Log evidence (h,) of candidates in a residual space."""
    gains = np.full(len(every), -np.inf)
    chosen = np.arange(len(every))
    sizes = np.array([space.size * c.family.design.shape[2] for c in every], dtype=np.int64)
    if sizes.sum() > EXACT:
        chosen = np.argsort(-_rough(space, every))
        chosen = chosen[np.cumsum(sizes[chosen]) <= EXACT]
    by_rank: dict[int, list[int]] = {}
    for i in chosen.tolist():
        by_rank.setdefault(every[i].family.design.shape[2], []).append(i)
    for rank, group in by_rank.items():
        step = max(1, AT_ONCE // (space.size * rank))
        for batch in (group[k : k + step] for k in range(0, len(group), step)):
            rows = np.hstack([_signature(space, every[i]) for i in batch])
            projected = space.project(rows).reshape(space.size, len(batch), rank)
            size = np.linalg.norm(rows, axis=0).reshape(len(batch), rank)
            unit = projected / np.where(size > 0, size, 1.0)
            gram = np.einsum("mhi,mhj->hij", unit, unit)
            score = np.einsum("mhi,m->hi", unit, space.residual)
            strength, turn = np.linalg.eigh(gram)
            along = np.einsum("hij,hi->hj", turn, score)
            visible = strength > UNCHECKED
            drop = np.sum(np.where(visible, along**2 / np.where(visible, strength, 1.0), 0.0), axis=1)
            shown = visible.sum(axis=1)
            value = np.array([_evidence(d, r) for d, r in zip(drop.tolist(), shown.tolist(), strict=True)])
            gains[batch] = value + [every[i].log_prior for i in batch]
    return gains


def _evidence(drop: float, rank: int) -> float:
    return 0.5 * drop + float(occam(np.sqrt(drop), rank)) if rank else -np.inf


def _signature(space: ResidualSpace, candidate: Candidate) -> Floats:
    design = np.zeros_like(candidate.family.design)
    design[candidate.rows] = candidate.family.design[candidate.rows]
    return space.whiten(design)


def _rough(space: ResidualSpace, every: Sequence[Candidate]) -> Floats:
    """Log evidence (h,) of candidates by their own rows alone, with the redundancy of each."""
    use, count = space.use, int(space.use.sum())
    residual, share = np.zeros(use.shape), np.zeros(use.shape)
    residual[use], share[use] = space.residual[:count], np.maximum(space.redundancy[:count], 1e-3)
    gains = np.empty(len(every))
    weighted = {id(c.family): np.where(use[:, :, None], c.family.design / space.sigma[:, :, None], 0.0) for c in every}
    for i, c in enumerate(every):
        g, r, q = weighted[id(c.family)][c.rows], residual[c.rows], share[c.rows]
        gram = np.einsum("nki,nk,nkj->ij", g, q, g)
        score = np.einsum("nki,nk->i", g, r)
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        strength, turn = np.linalg.eigh(gram / np.outer(scale, scale))
        visible = strength > 1e-3
        along = turn[:, visible].T @ (score / scale)
        gains[i] = _evidence(float(np.sum(along**2 / strength[visible])), int(visible.sum())) + c.log_prior
    return gains


def _local(fit: Fit, every: Sequence[Candidate]) -> tuple[Floats, list[Floats]]:
    """Log evidence (h,) gained by shifts whose readings are no longer outliers, with the network unchanged.

    Also returned is a guess of each shift. If a change begins during the measurement, the network may have followed the
    later readings; its negative is then visible before.
    """
    gains = np.full(len(every), -np.inf)
    guesses = [np.zeros(c.family.design.shape[2]) for c in every]
    price = -log_prior_of("outlier", int(fit.whole.use.sum())) - float(occam(10.0, 1))
    weighted = {
        id(c.family): np.where(fit.whole.use[:, :, None], c.family.design / fit.problem.sigma[:, :, None], 0.0)
        for c in every
    }
    gross = np.asarray(fit.outliers.any(axis=1))
    trials = list[tuple[int, float, LocalShift]]()
    for i, c in enumerate(every):
        for sign, rows in ((1.0, c.rows), (-1.0, c.before)):
            out = int(gross[rows].sum())
            if 4 * out < len(rows) or 3 * out < c.family.design.shape[2] or not out:
                continue
            shift = LocalShift.of(weighted[id(c.family)][rows], fit.whitened[rows], fit.outliers[rows])
            trials += [(i, sign, shift)] if shift.is_fitted else []
    fits = fitted_shifts([shift for *_, shift in trials], price)
    for (i, sign, _), (saved, guess) in zip(trials, fits, strict=True):
        gain = saved + float(occam(10.0, len(guess))) + every[i].log_prior
        if gain > gains[i]:
            gains[i], guesses[i] = gain, sign * guess
    return gains, guesses


def _moved_targets(fit: Fit, every: Sequence[Candidate]) -> Iterator[tuple[int, float, Floats]]:
    """Moved targets from their positions before and after a time: index, log evidence, and displacement (3,) [m].

    The network places a target that moved far between both positions, so that no reading to it fits.
    """
    gross, sightings = np.asarray(fit.outliers.any(axis=1)), fit.adjustment.sightings
    moved = [i for i, c in enumerate(every) if c.family.kind == "target-moved"]
    share = {every[i].name: float(gross[np.append(every[i].rows, every[i].before)].mean()) for i in moved}
    suspects = sorted((name for name in share if share[name] > HALF), key=lambda name: -share[name])[:PLACES]
    price = -log_prior_of("outlier", int(fit.whole.use.sum())) - float(occam(10.0, 1))
    sigma = fit.problem.sigma
    for i in (i for i in moved if every[i].name in suspects):
        parts = every[i].before, every[i].rows
        points = [point for rows in parts if (point := _place(fit, rows)) is not None]
        if len(points) < len(parts):
            continue
        displacement = np.zeros((len(sightings), 3))
        for rows, point in zip(parts, points, strict=True):
            displacement[rows] = point - fit.state.target_points[sightings.target[rows]]
        both = np.concatenate(parts)
        rest = (fit.residuals - exact_target_change(sightings, displacement))[both] / sigma[both]
        used = fit.whole.use[both]
        saved = sum(
            sign * float(np.minimum(0.5 * w[used] ** 2, price).sum())
            for sign, w in ((1.0, fit.whitened[both]), (-1.0, rest))
        )
        yield i, saved + float(occam(10.0, 3)) + every[i].log_prior, points[1] - points[0]


def _place(fit: Fit, rows: Ints) -> Floats | None:
    """Position (3,) [m] of a target from some pointings to it, with the stations unchanged.

    It is None if it is not unique.
    """
    rows = rows[fit.whole.use[rows].any(axis=1)]
    sight, station = Sight.of(fit.recording).at(rows), fit.recording.station[rows]
    usable = replace(sight, readings=np.where(fit.whole.use[rows], sight.readings, np.nan))
    return fit_point(usable, fit.state.station_positions[station], fit.state.station_rotations[station])


def _distances_aside(fit: Fit, every: Sequence[Candidate]) -> list[tuple[float, Hypothesis]]:
    """Offsets and scale errors of distances at the places with most outliers, from a network without these distances.

    Distances with large errors displace the target or station, so that its angles have large residuals too. If gross
    pointings are as frequent in the whole recording, no place is tried.
    """
    gross = np.asarray((fit.outliers & fit.is_gross).any(axis=1))
    if gross.mean() > HALF:
        return []
    tried = [c for c in every if c.family.acts_on == "distance" and np.isneginf(c.since)]
    share = {id(c): float(gross[c.rows].mean()) for c in tried}
    price = -log_prior_of("outlier", int(fit.whole.use.sum())) - float(occam(10.0, 1))
    offers, fits = list[tuple[float, Hypothesis]](), dict[str, Fit | None]()
    for c in sorted(tried, key=lambda c: -share[id(c)]):
        if c.name not in fits:
            if len(fits) == PLACES or not share[id(c)] > HALF:
                continue
            fits[c.name] = fit.without_distances(c.rows)
        aside = fits[c.name]
        if aside is None:
            continue
        use = c.rows[fit.whole.use[c.rows, 0]]
        g = c.family.design[use, 0, 0] / fit.problem.sigma[use, 0]
        r = aside.residuals_of(fit.recording)[use, 0] / fit.problem.sigma[use, 0]
        acts = g != 0.0
        if not acts.any():
            continue
        guess = float(np.median(r[acts] / g[acts]))
        rest = float(np.minimum(0.5 * (r - g * guess) ** 2, price).sum())
        gain = aside.log_evidence - rest - fit.log_evidence + float(occam(10.0, 1)) + c.log_prior
        offers.append((gain, c.hypothesis(np.array([guess]))))
    return offers


def _paid(fit: Fit, rows: Ints) -> float:
    """Log evidence that the outliers among some rows cost."""
    out = fit.outliers[rows]
    w = np.abs(fit.whitened[rows][out])
    return -float(np.sum(occam(w, 1))) - len(w) * log_prior_of("outlier", int(fit.whole.use.sum()))


def _rows_of(fit: Fit, hypothesis: Hypothesis) -> Ints:
    """Rows with pointings to the targets of a hypothesis."""
    at = [fit.recording.targets.index(name) for name in hypothesis.targets]
    return np.flatnonzero(np.isin(fit.recording.target, at))


def _references(fit: Fit, adjustment: Adjustment) -> list[tuple[float, Hypothesis]]:
    problem = relaxed_references(adjustment.problem, adjustment.state)
    solution = adjustment.solution if problem is adjustment.problem else solve(problem, adjustment.state)
    tests: dict[tuple[str, str], ReferenceTest] = {}
    if solution.factor is not None:
        tests = {(t.kind, t.name): t for t in reference_tests(problem, solution)}
    offers = []
    for h in omissions(fit):
        test = tests.get((h.acts_on, h.name))
        if test is not None and test.rank:
            offers.append((_evidence(test.chi2_drop, test.rank) + h.log_prior, h))
    return offers


def _scale_of_lengths(fit: Fit, space: ResidualSpace) -> list[tuple[float, Hypothesis]]:
    """Hypothesis of a common scale error of all reference lengths (or of the distances), with its gain."""
    scale = GaugeScale()
    if any(h.kind == "reference-scale" for h in fit.hypotheses) or len(fit.problem.gauge) < SEVERAL:
        return []
    drop, rank = space.chi2_drop(space.signature(scale))
    prior = log_prior_of("reference-scale", 1)
    common = Hypothesis("reference-scale", "length", (), (), prior, Shift(scale))
    return [(_evidence(drop, rank) + prior, common)] if rank else []


def _noises(fit: Fit) -> list[tuple[float, Hypothesis]]:
    """Hypotheses of changed noise, with their gains; outliers by the declared noise may be none by another."""
    return [_noise(fit, h, readings) for h, readings in noises(fit)]


def _noise(fit: Fit, hypothesis: Hypothesis, readings: Bools) -> tuple[float, Hypothesis]:
    """Hypothesis of changed noise with its gain and a guess, for the best number of remaining outliers."""
    within, out = readings & fit.problem.use, readings & fit.outliers
    sizes = np.sort(np.abs(fit.whitened[out]))  # as many of the smaller ones as is best are outliers no more
    squares = np.sum(fit.whitened[within] ** 2) + np.append(0.0, np.cumsum(sizes**2))
    redundancy = np.nansum(fit.redundancy[within]) + np.arange(len(sizes) + 1)
    factor, gain = variance_factor(squares, redundancy)
    # `variance_factor` compares with all of them within the declared noise; but outliers have paid another price
    price = -occam(sizes, 1) - log_prior_of("outlier", int(fit.whole.use.sum()))
    gain = gain + np.append(0.0, np.cumsum(price - 0.5 * sizes**2)) + occam_of_variance(redundancy)
    best = int(np.argmax(gain))
    change = NoiseFactor(readings, float(factor[best]))
    return float(gain[best]) + hypothesis.log_prior, replace(hypothesis, change=change)
