"""Shrinkage of a correction: parameters to apply to readings, so that new points are not expected to become worse.

The estimates and their covariance belong to the declared prior. The applied values may be smaller than the estimates:

* a parameter that the readings do not determine keeps the mean of its prior, usually 0;
* a parameter is not applied if the readings of targets are predicted better without it (`HeldOutTarget`);
* if the readings contradict the scale of the prior, the correction follows the scale that they make most likely;
* if the correction is expected to do harm under a plausible scale, the smallest plausible scale is used.

Let u be the parameters in prior standard deviations, N the information matrix of the readings, and b = N times the
estimate from the readings alone. If the prior is scaled by s, b is normal with the covariance N + s^2 N N. Its
likelihood does not depend on poses and targets and is the restricted likelihood of s (Patterson and Thompson,
Biometrika 58 (1971) 545). With a prior from earlier calibrations, u is the deviation from the mean of the prior.
Without a prior the scale is always estimated, and each combination of parameters is shrunk by the factor with the
smallest expected error.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special
from scipy.linalg import block_diag

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.remedies.detectability import MAX_EXAMINED_VARIANTS
from ltsim.adjustment.significance import FAMILY_WISE_LEVEL, GLOBAL_TEST_LEVEL
from ltsim.calibration.evidence import cosine_sine_pairs
from ltsim.calibration.prior_conflict import MAX_SIGMA0_FOR_WIDENING, informative_parameter_mask, sigma0_of_readings
from ltsim.calibration.schema import RecommendedCorrection
from ltsim.core.arrays import Floats, Ints
from ltsim.core.notation import names_text
from ltsim.core.units import MICROMETRE
from ltsim.geometry.rigid import remove_rigid_motion
from ltsim.physics.effects import parameter_text
from ltsim.recordings.recording import Recording
from ltsim.solve.design import to_dense

CANDIDATE_PRIOR_SCALES = np.geomspace(1e-4, 1e4, 161)
"""Scales of the prior (factors on the declared standard deviations) that are tested, in steps of 12 %."""
MIN_REJECTION_LOG_LIKELIHOOD_RATIO = 0.5 * float(special.chdtri(1, FAMILY_WISE_LEVEL))
"""Limit of the log-likelihood ratio of the most likely scale of the prior to the declared scale 1. If it is exceeded,
the declared scale is rejected."""
MAX_PLAUSIBLE_LOG_LIKELIHOOD_RATIO = 0.5 * float(special.chdtri(1, 2.0 * GLOBAL_TEST_LEVEL))
"""Largest log-likelihood ratio of the most likely scale of the prior to another plausible scale."""
MAX_PRIOR_SCALE = 30.0
"""Largest plausible scale of the prior. A misfit that needs a larger scale is not caused by the instrument."""
MIN_APPLIED_TO_ESTIMATED_CORRECTION_RATIO = 0.02
"""Smallest ratio of the applied to the estimated correction (rms change of a point) of an applied correction."""
MIN_HELD_OUT_IMPROVEMENT = 2.0
"""Smallest decrease of the sum of squared held-out residuals for which a parameter is omitted."""
MAX_DENSE_UNKNOWNS = 500
"""Largest number of unknowns with a dense inverse or orthonormal basis; it limits the processor time."""
MIN_PREDICTED_TARGETS = 5
"""Smallest number of held-out targets for a test whether they are predicted better without a parameter."""


def recommend_correction(
    adjustment: Adjustment,
    parameter_names: Sequence[str],
    *,
    has_history_prior: bool = False,
    prior_widening_factor: float | None = None,
    noise_factor: float = 1.0,
) -> tuple[RecommendedCorrection, Floats]:
    """Recommended correction for the result, and the parameters to apply, shape (instruments, parameters) [SI].

    `prior_widening_factor` is the factor by which the declared prior was widened to represent no prior; the scale of
    the prior (factor on its sigmas) is then always estimated. With a prior from earlier calibrations
    (`has_history_prior`) all parameters are applied, and the scale is at least 1. `noise_factor` multiplies the noise;
    it is above 1 after a rejected fit.
    """
    prior = adjustment.problem.prior
    held, mean = prior.is_fixed.ravel(), prior.mean.ravel()
    free_indices = np.flatnonzero(~held)
    dropped_terms = np.zeros(0, dtype=np.int64) if has_history_prior else parameters_to_drop(adjustment, noise_factor)
    used_terms = np.setdiff1d(free_indices, dropped_terms)
    root = block_diag(*prior.whitening_matrices)[np.ix_(free_indices, free_indices)]
    columns_of_free = adjustment.problem.unknowns.instrument_columns.ravel()[free_indices]
    precision = np.linalg.inv(root @ adjustment.retained_covariance[np.ix_(columns_of_free, columns_of_free)] @ root.T)
    vector = precision @ root @ (adjustment.state.instrument_parameters.ravel() - mean)[free_indices]
    used_positions, unit = np.searchsorted(free_indices, used_terms), prior_widening_factor or 1.0
    spread = np.linalg.inv(root)[np.ix_(used_positions, used_positions)] / unit
    scale = noise_factor * unit
    information = (precision[np.ix_(used_positions, used_positions)] - np.eye(len(used_terms))) / scale**2
    least, is_scale_estimated = (1.0 if has_history_prior else 0.0), prior_widening_factor is not None
    sigma0 = sigma0_of_readings(adjustment)
    evidence = ScaledPrior(
        information,
        vector[used_positions] / (noise_factor**2 * unit),
        min_scale=least,
        is_scale_estimated=is_scale_estimated,
        sigma0=sigma0,
    )
    by_unit = spread.T @ point_error_matrix(adjustment)[np.ix_(used_terms, used_terms)] @ spread
    weighted_mean: Floats = np.asarray(np.linalg.solve(spread, mean[used_terms]), dtype=np.float64)
    applied, note = evidence.shrunk_correction(by_unit, weighted_mean)
    before, after = evidence.point_errors(by_unit, applied, weighted_mean)
    unapplied_parameters = tuple(parameter_names[k] for k in dropped_terms)
    notes = [n for n in (evidence.scale_sentence, note) if n]
    if unapplied_parameters:
        words, plural = names_text(list(map(parameter_text, unapplied_parameters))), len(unapplied_parameters) > 1
        terms, they = ("terms", "they are") if plural else ("term", "it is")
        notes.append(f"held-out targets are predicted better without the {terms} {words}: {they} not applied")
    applied_values = mean * held
    applied_values[used_terms] = spread @ applied
    if not has_history_prior:
        applied_values = np.where(informative_parameter_mask(adjustment) | held, applied_values, mean)
    correction = RecommendedCorrection(
        prior_scale=evidence.most_likely_scale,
        prior_scale_limits=evidence.plausible_scale_limits,
        uncorrected_error_um=before / MICROMETRE,
        corrected_error_um=after / MICROMETRE,
        noise_error_um=point_noise_rms(adjustment.recording, adjustment.problem.reading_sigmas) / MICROMETRE,
        unapplied_parameters=unapplied_parameters,
        sentences=tuple(notes),
    )
    return correction, applied_values.reshape(prior.mean.shape)


class ScaledPrior:
    """Likelihood of the scale of a prior (factor on its standard deviations), and the parameters estimated with it.

    Parameters
    ----------
    information : (parameters, parameters) float
        Information matrix of the readings in inverse prior variances.
    information_vector : (parameters,) float
        Information matrix times the estimate from the readings alone.
    min_scale : float
        Smallest permitted scale of the prior.
    is_scale_estimated : bool
        True if the scale is always estimated, because there is no prior.
    sigma0 : float
        sigma0 of the readings. If it is large, no scale above 1 is accepted.
    """

    def __init__(
        self,
        information: Floats,
        information_vector: Floats,
        *,
        min_scale: float = 0.0,
        is_scale_estimated: bool = False,
        sigma0: float = 1.0,
    ) -> None:
        self._is_scale_estimated, self._sigma0 = is_scale_estimated, sigma0
        strength, self._basis = np.linalg.eigh(0.5 * (information + information.T))
        self._strength = np.maximum(strength, 1e-12 * float(strength.max(initial=1.0)))
        self._information_vector = self._basis.T @ information_vector
        self._scales = CANDIDATE_PRIOR_SCALES[0.99 * min_scale < CANDIDATE_PRIOR_SCALES]
        ratio = 1.0 + self._scales[:, None] ** 2 * self._strength
        gain = self._scales[:, None] ** 2 * self._information_vector**2 / ratio
        self._log_likelihoods = 0.5 * np.sum(gain - np.log(ratio), axis=1)
        self._best_index = int(np.argmax(self._log_likelihoods))

    @property
    def most_likely_scale(self) -> float:
        """Scale of the prior (factor on the declared standard deviations) with the largest likelihood."""
        return float(self._scales[self._best_index])

    @property
    def plausible_scale_limits(self) -> tuple[float, float]:
        """Smallest and largest plausible scale of the prior (factor on the declared standard deviations)."""
        min_log_likelihood = self._log_likelihoods[self._best_index] - MAX_PLAUSIBLE_LOG_LIKELIHOOD_RATIO
        near_indices = np.flatnonzero(self._log_likelihoods > min_log_likelihood)
        return float(self._scales[near_indices[0]]), float(self._scales[near_indices[-1]])

    @property
    def rejects_declared_scale(self) -> bool:
        """True if the readings reject the declared standard deviations of the prior (scale 1)."""
        nominal_index = int(np.argmin(np.abs(np.log(self._scales))))
        return bool(
            self._log_likelihoods[self._best_index] - self._log_likelihoods[nominal_index]
            > MIN_REJECTION_LOG_LIKELIHOOD_RATIO
        )

    @property
    def _exceeds_plausible_scale(self) -> bool:
        """True if the most likely scale is so large that the misfit has another cause."""
        max_scale = MAX_PRIOR_SCALE if self._sigma0 < MAX_SIGMA0_FOR_WIDENING else 1.0
        return self.rejects_declared_scale and not self._is_scale_estimated and self.most_likely_scale > max_scale

    @property
    def scale_of_applied_values(self) -> float:
        """Scale of the prior for the applied parameters: 1, unless this scale is rejected or there is no prior."""
        return (
            self.most_likely_scale
            if (self.rejects_declared_scale and not self._exceeds_plausible_scale) or self._is_scale_estimated
            else 1.0
        )

    @property
    def scale_sentence(self) -> str:
        """Sentence for users on the scale of the prior (factor on its sigmas); empty if the scale is 1 by default."""
        if not (self.rejects_declared_scale or self._is_scale_estimated):
            return ""
        low, high = self.plausible_scale_limits
        factor, limits = f"{self.most_likely_scale:.2g} times", f"({low:.2g} to {high:.2g})"
        if self._exceeds_plausible_scale:
            why = f" and contradict each other by {self._sigma0:.2g} times their noise"
            cause = "the noise is larger than declared, or a systematic effect acts"
            if self.most_likely_scale > MAX_PRIOR_SCALE:
                why, cause = ", which no instrument has", "another cause must explain the misfit"
            why = f"the readings require parameters {factor} as large as the declared prior{why}"
            return f"{why}; no correction is applied, because {cause}"
        if not self._is_scale_estimated:
            if low <= self._scales[0]:
                return f"the errors of the instrument are insignificant: their rms is at most {high:.2g} prior sigmas"
            size = f"{'larger' if self.most_likely_scale > 1.0 else 'smaller'} than their prior sigmas"
            return f"the errors of the instrument are {size}: prior sigmas {factor} as large are most likely {limits}"
        counts = f"{int(np.sum(self._strength > self.most_likely_scale**-2))} of {len(self._strength)} combinations"
        usual = f"without a prior, {factor} the usual prior sigmas are most likely {limits}"
        return f"{usual}; more than half of the estimate is applied in {counts}"

    def estimate_at_scale(self, prior_scale: float) -> Floats:
        """Estimate (parameters,) in prior sigmas for a prior whose sigmas are `prior_scale` times the declared ones."""
        return self._basis @ (self._information_vector / (self._strength + prior_scale**-2))

    def shrunk_correction(self, point_error_matrix: Floats, prior_mean: Floats | float = 0.0) -> tuple[Floats, str]:
        """Parameters to apply (parameters,), shrunk towards the prior mean where necessary, and a sentence for users.

        The mean square error of a new point is the quadratic form `point_error_matrix` (parameters, parameters) of the
        errors of the parameters. `prior_mean` (parameters,) is the mean of the prior.
        """
        if self._exceeds_plausible_scale:
            return np.zeros(len(self._information_vector)), ""
        full = prior_mean + self.estimate_at_scale(self.scale_of_applied_values)
        cautious = prior_mean + self.estimate_at_scale(self.plausible_scale_limits[0])
        if full @ point_error_matrix @ (full - 2.0 * cautious) <= 0.0:
            return full, ""
        share = float(np.sqrt((cautious @ point_error_matrix @ cautious) / (full @ point_error_matrix @ full)))
        if share < MIN_APPLIED_TO_ESTIMATED_CORRECTION_RATIO:
            return np.zeros_like(
                full
            ), "no correction is applied, because it would probably increase the errors of new points"
        limit = "more would probably increase the errors of new points"
        return cautious, f"only {100 * share:.0f} % of the correction is applied, because {limit}"

    def point_errors(
        self, point_error_matrix: Floats, applied_values: Floats, prior_mean: Floats | float = 0.0
    ) -> tuple[float, float]:
        """Expected rms errors [m] of a new point due to instrument errors: uncorrected, and with the applied values."""
        scale = self.scale_of_applied_values
        posterior_mean = prior_mean + self.estimate_at_scale(scale)
        spread = (self._basis / (self._strength + scale**-2)) @ self._basis.T
        remaining_variance = float(np.sum(spread * point_error_matrix))
        bias = posterior_mean - applied_values
        return float(np.sqrt(posterior_mean @ point_error_matrix @ posterior_mean + remaining_variance)), float(
            np.sqrt(bias @ point_error_matrix @ bias + remaining_variance)
        )


def point_noise_rms(recording: Recording, sigma: Floats) -> float:
    """Rms error [m] of measured points due to noise with standard deviations `sigma` (pointings, 3) [m, rad, rad]."""
    is_complete = recording.is_measured.all(axis=1)
    if not is_complete.any():
        return 0.0
    (range_, _, elevation), (along, aside, above) = recording.readings[is_complete].T, sigma[is_complete].T
    transverse_noise = range_ * np.cos(elevation) * aside
    return float(np.sqrt(np.mean(along**2 + transverse_noise**2 + (range_ * above) ** 2)))


def point_error_matrix(adjustment: Adjustment) -> Floats:
    """Matrix of the quadratic form that gives the mean square error of a new point from errors of the parameters.

    The shape is (parameters, parameters) [m^2 / SI^2]. The mean is over the pointings of each set-up, in the frame of
    the instrument. The part that a rigid motion of the set-up explains is removed, because it needs no calibration.
    """
    recording, state = adjustment.recording, adjustment.state
    count, size = state.instrument_parameters.shape
    form = np.zeros((count * size, count * size))
    is_complete = recording.is_measured.all(axis=1)
    for number in range(len(recording.stations)):
        rows = np.flatnonzero(is_complete & (recording.station == number))
        if not len(rows):
            continue
        instrument = int(recording.instrument[rows[0]])
        readings, values = recording.readings[rows], state.instrument_parameters[instrument]
        points, _, by_value = adjustment.construction.linearise(readings, values)
        error = remove_rigid_motion(by_value.reshape(-1, size), points)
        block = slice(instrument * size, (instrument + 1) * size)
        form[block, block] += error.T @ error
    return form / max(int(is_complete.sum()), 1)


@dataclass(frozen=True)
class HeldOutTarget:
    """Prediction of the readings of one target from the readings of all other targets.

    Let r (rows,) be the residuals of the target's observations and A (rows, unknowns) their design matrix by poses and
    parameters, both after elimination of the coordinates of the target. With the covariance C of poses and parameters
    from all readings and S = (1 - A C A')^-1, the held-out residual is S r. A parameter fixed at zero changes the
    prediction by a rank-one update, so that one adjustment is sufficient for all targets and parameters.
    """

    held_out_residual: Floats
    """Observations of the target minus their prediction from all other targets, whitened, shape (rows,)."""
    residual_parameter_cross_covariance: Floats
    """Covariance of the held-out residuals with the instrument parameters, shape (rows, parameters)."""
    parameter_covariance: Floats
    """Covariance of the instrument parameters estimated without this target, shape (parameters, parameters)."""
    estimate_shift: Floats
    """Estimates of the parameters from all targets minus estimates without this target, shape (parameters,) [SI]."""

    def sum_of_squares(self, parameters: Floats, fixed_indices: Ints) -> float:
        """Sum of squared held-out residuals if the parameters with the indices `fixed_indices` are zero.

        `parameters` (parameters,) are the estimates from all readings.
        """
        if not len(fixed_indices):
            return float(self.held_out_residual @ self.held_out_residual)
        change = np.linalg.solve(
            self.parameter_covariance[np.ix_(fixed_indices, fixed_indices)],
            self.estimate_shift[fixed_indices] - parameters[fixed_indices],
        )
        residual = self.held_out_residual - self.residual_parameter_cross_covariance[:, fixed_indices] @ change
        return float(residual @ residual)


def parameters_to_drop(adjustment: Adjustment, noise_factor: float = 1.0) -> Ints:
    """Indices of the parameters without which held-out targets are predicted better, in the vector of all instruments.

    Parameters are dropped one after the other, beginning with the one that degrades the predictions most. None is
    dropped in a large network, or in a network with few targets. `noise_factor` multiplies the noise of the readings.
    """
    none = np.zeros(0, dtype=np.int64)
    unknowns = adjustment.problem.unknowns
    if unknowns.n_retained > MAX_DENSE_UNKNOWNS:
        return none
    targets = held_out_targets(adjustment)
    if len(targets) < MIN_PREDICTED_TARGETS:
        return none
    parameter_values = adjustment.state.instrument_parameters.ravel()
    gone, now = none, sum(t.sum_of_squares(parameter_values, none) for t in targets)
    candidates = _informative_parameter_groups(adjustment)
    while candidates:
        tried = [np.concatenate([gone, term]) for term in candidates]
        after = [sum(t.sum_of_squares(parameter_values, fixed) for t in targets) for fixed in tried]
        best = int(np.argmin(after))
        if now - after[best] <= MIN_HELD_OUT_IMPROVEMENT * noise_factor**2:
            break
        gone, now = tried[best], after[best]
        del candidates[best]
    return np.sort(gone)


def _informative_parameter_groups(adjustment: Adjustment) -> list[Ints]:
    """Indices of each estimated parameter about which the readings have information; cosine and sine form one group."""
    prior, open_ = adjustment.problem.prior, informative_parameter_mask(adjustment)
    sines = {i: j for _, i, j in cosine_sine_pairs(adjustment.construction.parameter_names)}
    term_groups = [[k, sines[k]] if k in sines else [k] for k in range(prior.mean.shape[1]) if k not in sines.values()]
    terms = [[i * prior.mean.shape[1] + k for k in term] for i in range(len(prior.mean)) for term in term_groups]
    chosen = [[k for k in term if open_[k]] for term in terms]
    return [np.array(term, dtype=np.int64) for term in chosen if term]


def held_out_targets(adjustment: Adjustment) -> list[HeldOutTarget]:
    """Predictions of every target that has redundant readings and whose coordinates can be eliminated.

    The declared coordinates of a target are held out and predicted together with its readings.
    """
    problem, unknowns = adjustment.problem, adjustment.problem.unknowns
    system, n_retained = adjustment.solution.system, adjustment.problem.unknowns.n_retained
    control_targets = np.repeat(
        problem.control_rows.point_indices, problem.control_rows.is_declared_coordinate.sum(axis=1)
    )
    lengths = np.full(len(problem.gauge_rows), -1)
    row_target = np.concatenate(
        [adjustment.recording.target[np.nonzero(problem.is_used_reading)[0]], lengths, control_targets]
    )
    target_indices = np.flatnonzero(unknowns.target_columns[:, 0] >= n_retained)
    target_indices = target_indices[:: max(1, -(-len(target_indices) // MAX_EXAMINED_VARIANTS))]
    held_out = []
    for target in target_indices.tolist():
        rows = np.flatnonzero(row_target == target)
        if len(rows) > 3:
            design = to_dense(system.design[rows])
            reduced = _eliminate_target(
                design[:, unknowns.target_columns[target]], design[:, :n_retained], system.whitened_residuals[rows]
            )
            held_out.append(_hold_out_target(adjustment, *reduced))
    return held_out


def _eliminate_target(target_design: Floats, design: Floats, residual: Floats) -> tuple[Floats, Floats]:
    """Design matrix and residuals (rows,) after elimination of coordinates with the design `target_design`."""
    basis = np.linalg.qr(target_design)[0]
    return design - basis @ (basis.T @ design), residual - basis @ (basis.T @ residual)


def _hold_out_target(adjustment: Adjustment, design: Floats, residual: Floats) -> HeldOutTarget:
    """Prediction of a target's observations, from design matrix and residuals after elimination of its coordinates."""
    covariance, at = adjustment.retained_covariance, adjustment.problem.unknowns.instrument_columns.ravel()
    spread = covariance @ design.T
    inverse = np.linalg.inv(np.eye(len(residual)) - design @ spread)
    by_parameter = inverse @ spread[at].T
    parameter_covariance = covariance[np.ix_(at, at)] + spread[at] @ by_parameter
    held_out_residual = inverse @ residual
    return HeldOutTarget(held_out_residual, by_parameter, parameter_covariance, spread[at] @ held_out_residual)
