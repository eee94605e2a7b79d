"""Hypotheses of centring errors: random displacements of reflectors at one set-up, at all set-ups, or on one target.

Each component of the displacement at an occupation (a reflector set on a target for a time) has the prior N(0, s^2).
Z is the matrix of whitened changes by unit displacements, projected off the columns of all unknowns; d_j and V are the
eigenvalues and eigenvectors of Z'Z. With the whitened residuals r and the scores z = V'Z'r, the log restricted
likelihood ratio of the variance component s^2 is

    log L = sum_j [ z_j^2 s^2 / (1 + s^2 d_j) - log(1 + s^2 d_j) ] / 2.

References
----------
Patterson and Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 58 (1971) 545.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ltsim.adjustment.identification.equal_displacements import common_displacement_length
from ltsim.adjustment.identification.evidence import (
    LOG_PRIOR_ODDS_OF_CENTRING,
    log_occam_factor_of_shift,
    log_occam_factor_of_variance,
    log_prior_of_kind,
)
from ltsim.adjustment.identification.fit import NetworkFit
from ltsim.adjustment.identification.hypothesis import CauseHypothesis, CentringChange
from ltsim.adjustment.residual_space import MAX_SCREENED_ENTRIES, ResidualSpace
from ltsim.adjustment.significance import MIN_MEAN_REPEATS, MIN_REPEATS_FOR_VARIANCE
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE, SQRT_MACHINE_EPSILON
from ltsim.core.units import MILLIMETRE
from ltsim.geometry.rigid import cross_matrix
from ltsim.physics.effects.motions import reading_change_by_displacement
from ltsim.physics.model.nuisances import CentringErrors
from ltsim.recordings.centring_errors import CentringUncertainty
from ltsim.recordings.occupations import target_occupations
from ltsim.recordings.recording import Recording
from ltsim.solve.gauss_newton import MAX_ITERATIONS

MIN_OUTLIER_FRACTION_FOR_LOCAL_FIT = 0.25
"""Limit of the fraction of outliers among the pointings of a set-up or target. If it is exceeded, centring errors are
also estimated with the rest of the network unchanged, because large centring errors make readings outliers."""
CENTRING_SIGMA_GRID = np.geomspace(1e-6, 1.0, 241)
"""Standard deviations [m] of centring errors at which their likelihood is computed, in steps of 6 %. Smaller steps are
not necessary: an estimate from a hundred components has a relative standard deviation of 7 %."""


@dataclass(frozen=True)
class _CentringPlace:
    """Stations and targets where centring errors are tested: one set-up, one target, or all set-ups."""

    centring_uncertainty: CentringUncertainty
    """Declaration of the centring errors, with their stations and targets and a provisional standard deviation."""
    occupation_indices: Ints
    """Index (n,) of the occupation (one placement of a reflector on a target) of each of n pointings; -1 if not
    tested."""
    requires_common_length: bool = False
    """True for a set-up without repeated pointings, where only displacements of one length are tested."""


def centring_hypotheses(fit: NetworkFit, residual_space: ResidualSpace) -> list[tuple[float, CauseHypothesis]]:
    """Hypotheses of centring errors, each preceded by its gain of log evidence in a linear approximation at a fit.

    `residual_space` contains the whitened residuals of the fit, and the projection of design columns off all its
    unknowns.
    """
    places = [
        place
        for place in _centring_places(fit.recording, residual_space.is_used_reading)
        if not place.requires_common_length
    ]
    squares = np.zeros(residual_space.is_used_reading.shape)
    squares[residual_space.is_used_reading] = (
        residual_space.whitened_residuals[: int(residual_space.is_used_reading.sum())] ** 2
    )
    largest_first = sorted(places, key=lambda place: -float(squares[place.occupation_indices >= 0].mean()))
    offers, entries = list[tuple[float, CauseHypothesis]](), 0
    for place in largest_first:
        entries += 3 * (int(place.occupation_indices.max()) + 1) * residual_space.n_equations
        if entries > MAX_SCREENED_ENTRIES:
            break
        offers.append(
            _log_evidence_gain_and_hypothesis(
                place, *best_centring_sigma(residual_space, place.occupation_indices)[:2], len(places)
            )
        )
    return offers


def _log_evidence_gain_and_hypothesis(
    place: _CentringPlace, log_likelihood_ratio: float, sigma: float, n_places: int
) -> tuple[float, CauseHypothesis]:
    """Gain of log evidence by centring errors at the stations and targets `place`, and the hypothesis of these errors.

    `log_likelihood_ratio` is the gain without the prior probability, `sigma` [m] the standard deviation of the
    displacements, and `n_places` the number of set-ups and targets that share the prior probability.
    """
    centring, prior = place.centring_uncertainty, log_prior_of_kind("centring", n_places) + LOG_PRIOR_ODDS_OF_CENTRING
    new_sigma = centring.model_copy(update={"sigma_mm": sigma / MILLIMETRE})
    change = CentringChange(new_sigma, place.requires_common_length)
    targets = () if len(centring.targets) > 1 else centring.targets
    return log_likelihood_ratio + prior, CauseHypothesis(
        "centring", "position", centring.stations, targets, prior, change
    )


def local_centring_hypotheses(fit: NetworkFit) -> list[tuple[float, CauseHypothesis]]:
    """Hypotheses of large centring errors, each preceded by its gain of log evidence.

    The effect of large displacements is not linear, and the affected readings were rejected as outliers. Displacements
    are therefore fitted to all readings of a set-up or target, with the rest of the network unchanged. Only set-ups and
    targets with many outliers are tested.
    """
    places = _centring_places(fit.recording, fit.problem_with_all_readings.is_used_reading)
    offers = []
    for place in places:
        rows = np.flatnonzero(place.occupation_indices >= 0)
        if fit.is_outlier[rows].any(axis=1).mean() > MIN_OUTLIER_FRACTION_FOR_LOCAL_FIT:
            offers.append(
                _log_evidence_gain_and_hypothesis(
                    place, *_local_log_evidence_gain_and_sigma(fit, place, rows), len(places)
                )
            )
    return offers


def _local_log_evidence_gain_and_sigma(fit: NetworkFit, place: _CentringPlace, rows: Ints) -> tuple[float, float]:
    """Gain of log evidence by displacements of reflectors, and their standard deviation [m], for a set-up or target.

    A displacement for each placement of a reflector is fitted to the pointings `rows` at `place` by Gauss-Newton
    iterations. At a set-up the common rigid motion of all reflectors is removed, because the pose of the set-up absorbs
    it.
    """
    used, sigma = fit.problem_with_all_readings.is_used_reading[rows], fit.problem.reading_sigmas[rows]
    sightings = fit.adjustment.sightings
    _, first, of = np.unique(place.occupation_indices[rows], return_index=True, return_inverse=True)
    displacement = np.zeros((len(first), 3))
    residual = np.where(used, fit.residuals[rows], 0.0)
    for _ in range(MAX_ITERATIONS):
        moved = np.zeros((len(place.occupation_indices), 3))
        moved[rows] = displacement[of]
        offsets = moved if sightings.sight_vector_offsets is None else moved + sightings.sight_vector_offsets
        residual = np.where(used, (fit.residuals - reading_change_by_displacement(sightings, moved))[rows], 0.0)
        slope = replace(sightings, sight_vector_offsets=offsets).target_derivatives[rows] / sigma[:, :, None]
        slope = np.where(used[:, :, None], slope, 0.0)
        normal, score = np.zeros((len(first), 3, 3)), np.zeros((len(first), 3))
        np.add.at(normal, of, np.einsum("nki,nkj->nij", slope, slope))
        np.add.at(score, of, np.einsum("nki,nk->ni", slope, residual / sigma))
        step = np.einsum("nij,nj->ni", np.linalg.pinv(normal, hermitian=True), score)
        displacement = displacement + step
        if np.abs(step).max() < SQRT_MACHINE_EPSILON:
            break
    motion = np.zeros((3 * len(first), 0))
    if place.centring_uncertainty.stations:
        arm = sightings.sight_vectors[rows[first]]
        motion = np.concatenate([np.tile(np.eye(3), (len(first), 1, 1)), -cross_matrix(arm)], axis=2).reshape(-1, 6)
    free = displacement.ravel() - motion @ np.linalg.lstsq(motion, displacement.ravel())[0]
    components = len(free) - motion.shape[1]
    variance = float(free @ free) / components
    saved = _negative_log_evidence(fit, fit.whitened_residuals[rows][used]) - _negative_log_evidence(
        fit, (residual / sigma)[used]
    )
    strength = np.linalg.eigvalsh(normal).clip(0.0)
    determinant = float(np.mean(np.log1p(variance * strength)))
    gain = saved - 0.5 * components * (1.0 + determinant) + float(log_occam_factor_of_variance(components))
    common = None
    if place.centring_uncertainty.stations:
        common = common_displacement_length(displacement, sightings.sight_vectors[rows[first]])
    if common is not None:
        gain += common.log_evidence_gain + common.log_prior_ratio
    if place.requires_common_length and (common is None or not common.is_smr_exchange):
        gain = -np.inf
    return gain, float(np.sqrt(variance))


def _negative_log_evidence(fit: NetworkFit, whitened_residuals: Floats) -> float:
    """Negative log evidence of whitened residuals (r,), each being noise or an outlier, whichever is likelier."""
    prior = log_prior_of_kind("outlier", int(fit.problem_with_all_readings.is_used_reading.sum()))
    outlier = -log_occam_factor_of_shift(np.abs(whitened_residuals), 1) - prior
    return float(np.minimum(0.5 * whitened_residuals**2, outlier).sum())


def _centring_places(recording: Recording, is_used_reading: Bools) -> list[_CentringPlace]:
    """Set-ups, targets, and all set-ups together, if they have enough repeated pointings for a test of centring errors.

    Set-ups without repeated pointings are included too, for a test of displacements of one length. Targets that only
    one set-up measures are left out, because they do not show displacements. For all set-ups together the repeated
    pointings must be in one face; otherwise displacements would fit any unmodelled error that is equal in both faces.
    """
    is_used = np.asarray(is_used_reading.any(axis=1))
    target_station_pairs = np.unique(np.stack([recording.target[is_used], recording.station[is_used]]), axis=1)
    is_shared = np.bincount(target_station_pairs[0], minlength=len(recording.targets)) > 1
    shared = tuple(name for name, is_tied in zip(recording.targets, is_shared.tolist(), strict=True) if is_tied)
    centrings = [CentringUncertainty(sigma_mm=1.0, stations=(name,), targets=shared) for name in recording.stations]
    centrings += [CentringUncertainty(sigma_mm=1.0, targets=(name,)) for name in shared]
    places = []
    for centring in (*centrings, CentringUncertainty(sigma_mm=1.0, targets=shared)):
        occupation = np.where(is_used, target_occupations(recording, centring), -1)
        face = recording.face * (not centring.stations and len(centring.targets) > 1)
        visit = occupation * (int(recording.face.max(initial=0)) + 1) + face
        count = len(np.unique(visit[occupation >= 0]))
        is_repeated = (occupation >= 0).sum() >= MIN_MEAN_REPEATS * count
        if count >= MIN_REPEATS_FOR_VARIANCE and (is_repeated or centring.stations):
            places.append(_CentringPlace(centring, occupation, requires_common_length=not is_repeated))
    return places


class CentringSigmaEstimate(NamedTuple):
    """Restricted maximum likelihood estimate of the standard deviation of centring errors."""

    log_evidence_gain: float
    """Gain of log evidence by the centring errors, without the prior probability of the hypothesis."""
    sigma: float
    """Standard deviation [m] of each component of a displacement."""
    n_determined_components: float
    """Effective number of displacement components that the readings determine. The relative variance of the estimated
    variance is 2 divided by this number of components.
    """


def best_centring_sigma(residual_space: ResidualSpace, occupation_indices: Ints) -> CentringSigmaEstimate:
    """Restricted maximum likelihood estimate of the standard deviation of centring errors.

    `residual_space` contains the whitened residuals of a network, and the projection of design columns off all its
    unknowns. `occupation_indices` (n,) number the placements of reflectors on targets for n pointings; -1 without
    centring errors.
    """
    design_columns = residual_space.whitened_design(CentringErrors(1.0, occupation_indices))
    projected = residual_space.project(design_columns)
    strength, turn = np.linalg.eigh(projected.T @ projected)
    visible = strength > NORMAL_EQUATIONS_TOLERANCE * float(np.max(np.sum(design_columns**2, axis=0)))
    strength, score = strength[visible], (turn[:, visible].T @ (projected.T @ residual_space.whitened_residuals)) ** 2
    variance = CENTRING_SIGMA_GRID[:, None] ** 2
    ratio = 0.5 * np.sum(score * variance / (1.0 + variance * strength) - np.log1p(variance * strength), axis=1)
    best = int(np.argmax(ratio))
    determined = float(np.sum(1.0 - 1.0 / (1.0 + variance[best] * strength)))
    gain = float(ratio[best] + log_occam_factor_of_variance(determined))
    return CentringSigmaEstimate(gain, float(CENTRING_SIGMA_GRID[best]), determined)
