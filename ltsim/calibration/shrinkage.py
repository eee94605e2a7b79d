"""Shrinkage of the correction: the values to apply to readings, so that new points are not expected to become worse.

The estimates and their covariance are those of the declared prior. The applied values may be smaller:

* a term that predicts targets worse than going without it, when they take no part in its estimation (`HeldOutTarget`);
* where the readings contradict the scale of the prior, the correction follows the scale that they make most likely;
* where the correction is expected to do harm under a plausible scale, the correction of the smallest plausible scale.

With u the parameters in prior sigmas, N the information of the readings and b = N times the estimate by them alone,
b is normal with covariance N + s^2 N N under a prior of s times the declared sigmas: its likelihood, free of poses and
targets, is the restricted likelihood of s (Patterson and Thompson, Biometrika 58 (1971) 545). A prior from earlier
calibrations has a mean; u is then the deviation from it. Without a prior the scale is
estimated in any case, and each combination of the parameters is shrunk by the factor that minimises the expected error.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special
from scipy.linalg import block_diag

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.remedies.undetermined import MAX_UNINFORMATIVE_GAIN
from ltsim.adjustment.significance import FAMILY_LEVEL, GLOBAL_LEVEL
from ltsim.calibration.evidence import cosine_sine_pairs
from ltsim.calibration.prior_conflict import MAX_SIGMA0_FOR_WIDENING, sigma0_of_readings
from ltsim.calibration.schema import RecommendedCorrection
from ltsim.core.arrays import Floats, Ints
from ltsim.core.notation import listing
from ltsim.core.units import MICROMETRE
from ltsim.geometry.rigid import remove_rigid_motion
from ltsim.recordings.recording import Recording
from ltsim.solve.design import to_dense

PRIOR_SCALES = np.geomspace(1e-4, 1e4, 161)
"""Tested scales of the prior: steps of 12 %."""
MIN_LOG_LIKELIHOOD_EXCESS_REJECTED = 0.5 * float(special.chdtri(1, FAMILY_LEVEL))
"""Smallest excess of the maximum log-likelihood over that of the declared scale (1) at which this scale is rejected
(likelihood ratio test).
"""
MAX_LOG_LIKELIHOOD_DEFICIT_PLAUSIBLE = 0.5 * float(special.chdtri(1, 2.0 * GLOBAL_LEVEL))
"""Largest deficit of the log-likelihood of a plausible scale: one-sided likelihood ratio test."""
MAX_PRIOR_SCALE = 30.0
"""Largest plausible scale of the prior: no instrument exceeds its whole specification by more, so that a larger misfit
has another cause."""
MIN_RELATIVE_CORRECTION = 0.02
"""Smallest applied correction, relative to the estimate (rms effect on a point); a smaller one is not applied."""
MIN_HELD_OUT_IMPROVEMENT = 2.0
"""Decrease of the held-out sum of squares above which a term is not applied: Akaike's penalty of one parameter, 2 in
units of chi-square.
"""
MAX_DENSE_UNKNOWNS = 400
"""Largest number of poses and parameters of a network in which held-out targets are tested (cost of
a dense inverse).
"""
MAX_HELD_OUT_TARGETS = 150
"""Largest number of held-out targets (run time); of more targets, an evenly distributed selection is held out."""
MIN_PREDICTED_TARGETS = 5
"""Smallest number of mutually predicted targets for a test with held-out targets."""


def recommend_correction(
    adjustment: Adjustment,
    names: Sequence[str],
    *,
    history_prior: bool = False,
    prior_widening_factor: float | None = None,
    factor: float = 1.0,
) -> tuple[RecommendedCorrection, Floats]:
    """Correction that is worth applying, and its values (I, p) [SI]; `names` (I p) are those of the parameters.

    A prior widened by the factor `prior_widening_factor` represents no prior: its scale is then estimated in any case.
    With a prior from earlier calibrations (`history_prior`) all terms are applied, because more than the targets of
    this recording supports them, and the estimated scale is 1 at least. `factor` multiplies the noise of the readings:
    in a
    rejected fit they support a correction as far as their scatter allows.
    """
    prior = adjustment.problem.prior
    held, mean = prior.is_fixed.ravel(), prior.mean.ravel()
    free_indices = np.flatnonzero(~held)
    dropped_terms = np.zeros(0, dtype=np.int64) if history_prior else terms_to_drop(adjustment, factor)
    used_terms = np.setdiff1d(free_indices, dropped_terms)
    root = block_diag(*prior.whitening_matrices)[np.ix_(free_indices, free_indices)]
    columns_of_free = adjustment.problem.unknowns.instrument_columns.ravel()[free_indices]
    precision = np.linalg.inv(root @ adjustment.reduced_covariance[np.ix_(columns_of_free, columns_of_free)] @ root.T)
    vector = precision @ root @ (adjustment.state.instrument_parameters.ravel() - mean)[free_indices]
    used_positions = np.searchsorted(free_indices, used_terms)
    unit = prior_widening_factor or 1.0
    spread = np.linalg.inv(root)[np.ix_(used_positions, used_positions)] / unit
    information = (precision[np.ix_(used_positions, used_positions)] - np.eye(len(used_terms))) / (factor * unit) ** 2
    least, is_free = (1.0 if history_prior else 0.0), prior_widening_factor is not None
    sigma0 = sigma0_of_readings(adjustment)
    evidence = ScaledPrior(
        information, vector[used_positions] / (factor**2 * unit), min_scale=least, is_free=is_free, sigma0=sigma0
    )
    by_unit = spread.T @ point_error_form(adjustment)[np.ix_(used_terms, used_terms)] @ spread
    weighted_mean: Floats = np.asarray(np.linalg.solve(spread, mean[used_terms]), dtype=np.float64)
    applied, note = evidence.shrunk_correction(by_unit, weighted_mean)
    before, after = evidence.point_errors(by_unit, applied, weighted_mean)
    not_applied = tuple(names[k] for k in dropped_terms)
    notes = [n for n in (evidence.scale_sentence, note) if n]
    if not_applied:
        words, plural = listing([name.replace("-", " ") for name in not_applied]), len(not_applied) > 1
        terms, they = ("terms", "they are") if plural else ("term", "it is")
        notes.append(f"held-out targets are predicted better without the {terms} {words}: {they} not applied")
    values = mean * held
    values[used_terms] = spread @ applied
    correction = RecommendedCorrection(
        prior_scale=evidence.most_likely_scale,
        plausible_scale=evidence.plausible_scale_limits,
        uncorrected_um=before / MICROMETRE,
        corrected_um=after / MICROMETRE,
        noise_um=point_noise_rms(adjustment.recording, adjustment.problem.sigma) / MICROMETRE,
        not_applied=not_applied,
        sentences=tuple(notes),
    )
    return correction, values.reshape(prior.mean.shape)


class ScaledPrior:
    """Likelihood information on parameters in prior sigmas, evaluated for priors of other scales.

    Parameters
    ----------
    information : (q, q) float
    information_vector : (q,) float
        Information times the estimate from the readings alone.
    min_scale : float
        Smallest permitted scale of the prior.
    is_free : bool
        True if the scale is estimated in any case: 1 is then only its unit.
    sigma0 : float
        sigma0 of the readings; if it is large, no scale above 1 is accepted.
    """

    def __init__(
        self,
        information: Floats,
        information_vector: Floats,
        *,
        min_scale: float = 0.0,
        is_free: bool = False,
        sigma0: float = 1.0,
    ) -> None:
        self._is_free, self._sigma0 = is_free, sigma0
        strength, self._basis = np.linalg.eigh(0.5 * (information + information.T))
        self._strength = np.maximum(strength, 1e-12 * float(strength.max(initial=1.0)))
        self._information_vector = self._basis.T @ information_vector
        self._scales = PRIOR_SCALES[0.99 * min_scale < PRIOR_SCALES]
        ratio = 1.0 + self._scales[:, None] ** 2 * self._strength
        gain = self._scales[:, None] ** 2 * self._information_vector**2 / ratio
        self._log_likelihoods = 0.5 * np.sum(gain - np.log(ratio), axis=1)
        self._best_index = int(np.argmax(self._log_likelihoods))

    @property
    def most_likely_scale(self) -> float:
        """Most likely scale."""
        return float(self._scales[self._best_index])

    @property
    def plausible_scale_limits(self) -> tuple[float, float]:
        """Smallest and largest plausible scale."""
        near_indices = np.flatnonzero(
            self._log_likelihoods > self._log_likelihoods[self._best_index] - MAX_LOG_LIKELIHOOD_DEFICIT_PLAUSIBLE
        )
        return float(self._scales[near_indices[0]]), float(self._scales[near_indices[-1]])

    @property
    def rejects_declared_scale(self) -> bool:
        """True if the readings reject the declared scale."""
        nominal_index = int(np.argmin(np.abs(np.log(self._scales))))
        return bool(
            self._log_likelihoods[self._best_index] - self._log_likelihoods[nominal_index]
            > MIN_LOG_LIKELIHOOD_EXCESS_REJECTED
        )

    @property
    def _exceeds_plausible_scale(self) -> bool:
        max_scale = MAX_PRIOR_SCALE if self._sigma0 < MAX_SIGMA0_FOR_WIDENING else 1.0
        return self.rejects_declared_scale and not self._is_free and self.most_likely_scale > max_scale

    @property
    def scale_of_applied_values(self) -> float:
        """Scale of the applied values: 1 unless the readings reject it."""
        return (
            self.most_likely_scale
            if (self.rejects_declared_scale and not self._exceeds_plausible_scale) or self._is_free
            else 1.0
        )

    @property
    def scale_sentence(self) -> str:
        """Sentence on a rejected or estimated scale; empty without either."""
        if not (self.rejects_declared_scale or self._is_free):
            return ""
        low, high = self.plausible_scale_limits
        scale_phrase = f"{self.most_likely_scale:.2g} times as large is most likely ({low:.2g} to {high:.2g})"
        if self._exceeds_plausible_scale:
            contradict = f" and contradict each other by {self._sigma0:.2g} times their noise"
            why = ", which no instrument has" if self.most_likely_scale > MAX_PRIOR_SCALE else contradict
            return (
                f"the readings require parameters {self.most_likely_scale:.2g} times the declared priors{why}: "
                "another cause explains the misfit, and no correction is applied"
            )
        if not self._is_free:
            return f"the readings contradict the declared priors: {scale_phrase}; the correction uses this scale"
        share = self._strength / (self._strength + self.most_likely_scale**-2)
        phrase = f"{int(np.sum(share > 0.5))} of {len(share)} combinations are applied by more than half"
        return f"without a prior, parameters of the usual proportions and {scale_phrase}; {phrase}, the others hardly"

    def estimate(self, prior_scale: float) -> Floats:
        """Estimate (q,) under a scale."""
        return self._basis @ (self._information_vector / (self._strength + prior_scale**-2))

    def shrunk_correction(self, point_error_form: Floats, prior_mean: Floats | float = 0.0) -> tuple[Floats, str]:
        """Correction (q,) that does not increase errors under any plausible scale, and a sentence if it is shrunk.

        `point_error_form` (q, q) is the mean square of a new point's error as a form of the parameters' errors,
        `prior_mean` (q,) the prior's mean.
        """
        if self._exceeds_plausible_scale:
            return np.zeros(len(self._information_vector)), ""
        full, cautious = (
            prior_mean + self.estimate(self.scale_of_applied_values),
            prior_mean + self.estimate(self.plausible_scale_limits[0]),
        )
        if full @ point_error_form @ (full - 2.0 * cautious) <= 0.0:
            return full, ""
        share = float(np.sqrt((cautious @ point_error_form @ cautious) / (full @ point_error_form @ full)))
        if share < MIN_RELATIVE_CORRECTION:
            return np.zeros_like(full), "no correction is applied: it is likely to increase the errors of new points"
        limit = "more is likely to increase the errors of new points"
        return cautious, f"{100 * share:.0f} % of the correction is applied: {limit}"

    def point_errors(
        self, point_error_form: Floats, applied_values: Floats, prior_mean: Floats | float = 0.0
    ) -> tuple[float, float]:
        """Expected rms error [m] of a new point due to the constants, without a correction and with the applied one."""
        scale = self.scale_of_applied_values
        mean = prior_mean + self.estimate(scale)
        spread = (self._basis / (self._strength + scale**-2)) @ self._basis.T
        remaining_variance = float(np.sum(spread * point_error_form))
        bias = mean - applied_values
        return float(np.sqrt(mean @ point_error_form @ mean + remaining_variance)), float(
            np.sqrt(bias @ point_error_form @ bias + remaining_variance)
        )


def point_noise_rms(recording: Recording, sigma: Floats) -> float:
    """Rms displacement [m] of a point by noise (n, 3) of one reading, over all complete pointings."""
    is_complete = recording.is_measured.all(axis=1)
    if not is_complete.any():
        return 0.0
    (range_, _, elevation), (along, aside, above) = recording.readings[is_complete].T, sigma[is_complete].T
    transverse_noise = range_ * np.cos(elevation) * aside
    return float(np.sqrt(np.mean(along**2 + transverse_noise**2 + (range_ * above) ** 2)))


def point_error_form(adjustment: Adjustment) -> Floats:
    """Mean square error of a point as a quadratic form (I p, I p) of the parameters' errors [m^2 / SI^2].

    The mean is over the pointings of each set-up, in the frame of the instrument; the part that a rigid motion of the
    set-up explains is removed, because it needs no calibration.
    """
    recording, state = adjustment.recording, adjustment.state
    count, size = state.instrument_parameters.shape
    total = np.zeros((count * size, count * size))
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
        total[block, block] += error.T @ error
    return total / max(int(is_complete.sum()), 1)


@dataclass(frozen=True)
class HeldOutTarget:
    """Residuals of one target's readings when it is held out and the other targets predict them.

    After elimination of its place they check each other. With r their residual (m,) and A (m, K) their design by poses
    and parameters, both so reduced, C the covariance of these from all readings, H = A C A' and S = (1 - H)^-1, the
    held-out residual is S r; a term fixed at zero changes the prediction by a rank-one update for each of its
    parameters. All matrices are m x m or p x p: one adjustment is sufficient for all targets and terms.
    """

    held_out_residual: Floats
    """Held-out residual S r, (m,)."""
    parameter_covariance: Floats
    """Covariance S B' of the prediction with the parameters, B = C A', (m, q)."""
    covariance: Floats
    """Covariance of the parameters from the other targets, (q, q)."""
    estimate_shift: Floats
    """Difference b S r of the estimates from all readings and from the other targets, (q,)."""

    def sum_of_squares(self, parameters: Floats, fixed_indices: Ints) -> float:
        """Sum of squares with the parameters `fixed_indices` at zero.

        `parameters` (q,) are the estimates from all readings.
        """
        if not len(fixed_indices):
            return float(self.held_out_residual @ self.held_out_residual)
        change = np.linalg.solve(
            self.covariance[np.ix_(fixed_indices, fixed_indices)],
            self.estimate_shift[fixed_indices] - parameters[fixed_indices],
        )
        residual = self.held_out_residual - self.parameter_covariance[:, fixed_indices] @ change
        return float(residual @ residual)


def terms_to_drop(adjustment: Adjustment, factor: float = 1.0) -> Ints:
    """Indices, in the flat vector of parameters (I p), of terms without which held-out targets are predicted better.

    Backward elimination, the worst term first. Empty in a large network or one with few targets. `factor` multiplies
    the noise of the readings.
    """
    none = np.zeros(0, dtype=np.int64)
    unknowns = adjustment.problem.unknowns
    if unknowns.n_reduced > MAX_DENSE_UNKNOWNS:
        return none
    targets = held_out_targets(adjustment)
    if len(targets) < MIN_PREDICTED_TARGETS:
        return none
    values = adjustment.state.instrument_parameters.ravel()
    gone, now = none, sum(t.sum_of_squares(values, none) for t in targets)
    candidates = _informative_terms(adjustment)
    while candidates:
        tried = [np.concatenate([gone, term]) for term in candidates]
        after = [sum(t.sum_of_squares(values, fixed) for t in targets) for fixed in tried]
        best = int(np.argmin(after))
        if now - after[best] <= MIN_HELD_OUT_IMPROVEMENT * factor**2:
            break
        gone, now = tried[best], after[best]
        del candidates[best]
    return np.sort(gone)


def _informative_terms(adjustment: Adjustment) -> list[Ints]:
    """Indices of each estimated term with information: a cosine with its sine, or a single parameter."""
    prior, at = adjustment.problem.prior, adjustment.problem.unknowns.instrument_columns.ravel()
    remaining = np.diag(adjustment.reduced_covariance)[at] / prior.sigma.ravel() ** 2
    open_ = ~prior.is_fixed.ravel() & (remaining < 1.0 - MAX_UNINFORMATIVE_GAIN)
    sines = {i: j for _, i, j in cosine_sine_pairs(adjustment.construction.parameter_names)}
    each = [[k, sines[k]] if k in sines else [k] for k in range(prior.mean.shape[1]) if k not in sines.values()]
    terms = [[i * prior.mean.shape[1] + k for k in term] for i in range(len(prior.mean)) for term in each]
    chosen = [[k for k in term if open_[k]] for term in terms]
    return [np.array(term, dtype=np.int64) for term in chosen if term]


def held_out_targets(adjustment: Adjustment) -> list[HeldOutTarget]:
    """Held-out residuals of every target with redundant readings and eliminated coordinates.

    Control coordinates of a target are held out with its readings and predicted with them.
    """
    problem, unknowns = adjustment.problem, adjustment.problem.unknowns
    system, n_reduced = adjustment.solution.system, adjustment.problem.unknowns.n_reduced
    control_targets = np.repeat(
        problem.control_rows.place_indices, problem.control_rows.declared_components.sum(axis=1)
    )
    lengths = np.full(len(problem.gauge_rows), -1)
    row_target = np.concatenate(
        [adjustment.recording.target[np.nonzero(problem.used_readings)[0]], lengths, control_targets]
    )
    target_indices = np.flatnonzero(unknowns.target_columns[:, 0] >= n_reduced)
    target_indices = target_indices[:: max(1, -(-len(target_indices) // MAX_HELD_OUT_TARGETS))]
    held_out = []
    for target in target_indices.tolist():
        rows = np.flatnonzero(row_target == target)
        if len(rows) > 3:
            design = to_dense(system.design[rows])
            reduced = _eliminate_target(
                design[:, unknowns.target_columns[target]], design[:, :n_reduced], system.whitened_residuals[rows]
            )
            held_out.append(_hold_out_target(adjustment, *reduced))
    return held_out


def _eliminate_target(target_design: Floats, design: Floats, residual: Floats) -> tuple[Floats, Floats]:
    """Design (m, K) and residual (m,) of a target's rows after elimination of its place (m, 3)."""
    basis = np.linalg.qr(target_design)[0]
    return design - basis @ (basis.T @ design), residual - basis @ (basis.T @ residual)


def _hold_out_target(adjustment: Adjustment, design: Floats, residual: Floats) -> HeldOutTarget:
    covariance, at = adjustment.reduced_covariance, adjustment.problem.unknowns.instrument_columns.ravel()
    spread = covariance @ design.T
    inverse = np.linalg.inv(np.eye(len(residual)) - design @ spread)
    by_parameter = inverse @ spread[at].T
    parameter_covariance = covariance[np.ix_(at, at)] + spread[at] @ by_parameter
    held_out_residual = inverse @ residual
    return HeldOutTarget(held_out_residual, by_parameter, parameter_covariance, spread[at] @ held_out_residual)
