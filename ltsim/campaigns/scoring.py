"""Scores of calibrators relative to true values: errors divided by declared standard deviations (z-scores)."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ltsim.calibration.calibration import Calibration
from ltsim.campaigns.external_calibrator import ParameterEstimate
from ltsim.campaigns.schema import InstrumentErrorOrigin
from ltsim.core.arrays import Floats, Ints
from ltsim.core.equality import ValueEquality
from ltsim.core.errors import CalibratorError, InputError
from ltsim.core.units import SI_PER_UNIT, are_convertible_units
from ltsim.physics.effects.effect import effect_parameter_names
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.recordings.files import safe_excerpt
from ltsim.simulation.truth import Truth

MIN_NOISE_VARIANCE_FRACTION = 1e-4
"""Smallest fraction of the declared variance of a parameter that has to come from noise of the readings. Below it
nearly all of the error comes from the prior of the parameter, and the parameter has no z-score."""


@dataclass(frozen=True)
class NetworkScore:
    """Mean squared z-scores and chi-square of the adjusted network of a trial; NaN for a missing quantity."""

    target_mean_square_z: float = np.nan
    """Mean squared z-score (error / sigma) over all coordinates of targets."""
    station_mean_square_z: float = np.nan
    """Mean squared z-score (error / sigma) over all poses of stations except the first, which defines the datum."""
    chi2: float = np.nan
    """Chi-square of the network adjustment (weighted sum of squared residuals)."""
    dof: float = np.nan
    """Degrees of freedom of the network adjustment."""
    expected_chi2: float = np.nan
    """Expected chi-square, for random noise and random true parameters."""
    chi2_sigma: float = np.nan
    """Standard deviation of chi-square, for random noise and random true parameters."""


@dataclass(frozen=True)
class TrialScore(ValueEquality):
    """Estimates of parameters by a calibrator in one trial, with the true values, in display units."""

    parameter_names: tuple[str, ...]
    parameter_units: tuple[str, ...]
    estimates: Floats
    declared_sigmas: Floats
    """Standard deviations that the calibrator declares, (parameters,); NaN if it declares none."""
    true_values: Floats
    prior_independent_z_scores: Floats
    """Z-scores corrected for the influence of the prior of the parameters, (parameters,): errors minus their expected
    bias, divided by their expected standard deviation. Both expectations use the distribution from which the true
    values come. The scores are standard normal for a correct calibrator, even if the true values are not drawn from the
    prior. NaN for a parameter whose error does not come from noise. NaN for an external calibrator unless the true
    values are drawn from the prior."""
    network_score: NetworkScore = NetworkScore()
    is_from_external_calibrator: bool = False
    """True if the estimates are from an external calibrator, whose prior is unknown."""
    ltsim_score: TrialScore | None = None
    """Score of ltsim's calibrator for the same parameters and recording; None if no external calibrator is checked."""
    ltsim_parameter_names: tuple[str, ...] = ()
    """Names of all parameters that ltsim's calibrator estimates, if an external calibrator is checked."""

    @property
    def z_scores(self) -> Floats:
        """Errors (estimate - true value) divided by declared standard deviations, (parameters,)."""
        return (self.estimates - self.true_values) / self.declared_sigmas


class TrueParameter(NamedTuple):
    """True value of a parameter [SI], and its display unit."""

    value: float
    unit: str


def true_parameters(truth: Truth) -> dict[str, TrueParameter]:
    """True parameters by name; those of an effect are named ``head-sag:sag``, or ``head-sag:sag S2`` at a station."""
    instrument_values = {
        name: TrueParameter(value, truth.parameter_units[name]) for name, value in truth.instrument_values.items()
    }
    effects = [applied.effect for applied in truth.applied_effects]
    names = effect_parameter_names((e.name, e.place_text, [p.name for p in e.parameters]) for e in effects)
    effect_values = [
        TrueParameter(float(value), parameter.unit)
        for applied in truth.applied_effects
        for parameter, value in zip(applied.effect.parameters, applied.parameter_values, strict=True)
    ]
    return instrument_values | dict(zip(names, effect_values, strict=True))


def check_parameters_have_true_values(names: Sequence[str], true_names: Collection[str], truth: Truth) -> None:
    """Check that each parameter in `names` is in `true_names`; InputError for a parameter without a true value."""
    unknown = [name for name in names if name not in true_names]
    if unknown:
        raise InputError(
            f"the simulated instrument ({truth.construction}) has no parameter {unknown[0]}, "
            "which the calibrator estimates; recover with the same construction as in the scenario"
        )


@dataclass(frozen=True)
class TrueParameterDistribution:
    """Distribution of the true values of parameters, and bias of their estimates by the priors of the parameters.

    All values are divided by the prior standard deviations of the parameters.
    """

    mean_true_values: Floats
    """Mean of the distribution from which the true parameters are drawn, (parameters,); for declared parameters the
    declared values."""
    true_value_sigmas: Floats
    """Standard deviation of the distribution of the true parameters, (parameters,); 0 for declared values."""
    bias_matrix: Floats
    """Matrix (parameters, parameters) of the bias of the estimates by the priors of the parameters: without noise, the
    error of the estimates is the negative product of this matrix and the true values."""
    network_column_indices: Ints
    """Columns of the parameters in the design matrix of the adjusted network, (parameters,); empty for a calibration by
    distances, which adjusts no network."""
    prior_sigmas: Floats
    """Prior standard deviations of the parameters, (parameters,) [SI]."""

    @classmethod
    def from_calibration(
        cls, calibration: Calibration, truth: Truth, truth_distributions: Mapping[str, tuple[float, float]]
    ) -> TrueParameterDistribution:
        """Distribution of the true parameters of a simulated recording.

        `truth_distributions` holds mean and standard deviation [SI] of each true parameter by name; the standard
        deviation is 0 for a declared parameter.
        """
        prior = calibration.prior_sigma.ravel()
        mean, drawn = np.array([truth_distributions[name] for name in calibration.instrument_parameter_names]).T / prior
        adjustment = calibration.adjustment
        if adjustment is None or calibration.method != "network":
            return cls(mean, drawn, calibration.arrays.negative_bias_operator, np.zeros(0, dtype=np.int64), prior)
        model, unknowns = adjustment.problem.model, adjustment.problem.unknowns
        reflectors = [
            np.linalg.solve(e.covariance_root, _true_incidence_parameters(truth) - e.mean_parameters)
            for e in model.incidence_errors
        ]
        reflector_values = np.concatenate([np.zeros(0), *reflectors])
        columns = np.concatenate(
            [
                unknowns.instrument_columns.ravel(),
                *(unknowns.effect_columns[at] for at in model.incidence_parameter_slices),
            ]
        )
        is_free = np.concatenate([~calibration.is_fixed.ravel(), np.ones(len(reflector_values), dtype=bool)])
        units = np.concatenate([prior, np.ones(len(reflector_values))])
        missed = adjustment.retained_covariance[columns[:, None], columns] / np.outer(units, units)
        missed = np.where(is_free[:, None] & is_free, missed, 0.0)
        return cls(np.append(mean, reflector_values), np.append(drawn, 0.0 * reflector_values), missed, columns, units)

    @property
    def is_drawn_from_prior(self) -> bool:
        """True if the true parameters were drawn from the prior that the calibration assumes."""
        return not np.any(self.mean_true_values) and bool(np.all(self.true_value_sigmas == 1.0))

    @property
    def prior_variance_deficit_fraction(self) -> Floats:
        """Fraction (parameters,) by which the variance of the true parameters is below their prior variance."""
        return 1.0 - self.true_value_sigmas**2


def _true_incidence_parameters(truth: Truth) -> Floats:
    """True parameters (14,) [SI] of the effect `smr-incidence` (range error by incidence angle) of all reflectors."""
    incidence_parameters = SmrIncidence().parameter_values_of_table
    for applied in truth.applied_effects:
        if isinstance(applied.effect, SmrIncidence) and not applied.effect.place_text:
            incidence_parameters = (
                incidence_parameters + applied.effect.parameter_values_of_table + applied.parameter_values
            )
    return incidence_parameters


def score_calibration(
    calibration: Calibration, truth: Truth, truth_distributions: Mapping[str, tuple[float, float]]
) -> TrialScore:
    """Score of ltsim's calibration relative to true values; raises InputError for a parameter without a true value.

    `truth_distributions` holds, by name, mean and standard deviation [SI] of the distribution from which each true
    parameter was drawn; the standard deviation of a declared parameter is 0.
    """
    check_parameters_have_true_values(calibration.instrument_parameter_names, truth.instrument_values, truth)
    expected = TrueParameterDistribution.from_calibration(calibration, truth, truth_distributions)
    n_parameters = len(calibration.instrument_parameter_names)
    true = np.array([truth.instrument_values[name] for name in calibration.instrument_parameter_names])
    prior = calibration.prior_sigma.ravel()
    error, sigma_scaled = (calibration.estimates.ravel() - true) / prior, calibration.sigma.ravel() / prior
    missed = expected.bias_matrix[:n_parameters]
    variance = sigma_scaled**2 - missed**2 @ expected.prior_variance_deficit_fraction
    noisy = variance > MIN_NOISE_VARIANCE_FRACTION * sigma_scaled**2
    standard = np.where(
        noisy, (error + missed @ expected.mean_true_values) / np.sqrt(np.where(noisy, variance, 1.0)), np.nan
    )
    network = NetworkScore(
        *_network_mean_square_z(calibration, truth, expected),
        calibration.fit.chi2,
        calibration.fit.dof,
        *_expected_chi2(calibration, expected),
    )
    units = tuple(truth.parameter_units[name] for name in calibration.instrument_parameter_names)
    factor = np.array([SI_PER_UNIT[unit] for unit in units])
    instrument = np.stack(
        [calibration.estimates.ravel() / factor, calibration.sigma.ravel() / factor, true / factor, standard]
    )
    true_by_name = true_parameters(truth)
    fitted = {name: entry for name, entry in _effect_parameter_estimates(calibration).items() if name in true_by_name}
    plain = np.all(expected.true_value_sigmas[:n_parameters] == 1.0) and not np.any(
        expected.mean_true_values[:n_parameters]
    )  # otherwise priors bias the effects too
    effect_scores = np.array(
        [[e.value, e.sigma or np.nan, true_by_name[name].value / SI_PER_UNIT[e.unit]] for name, e in fitted.items()]
    )
    effect_scores = effect_scores.reshape(-1, 3).T
    z = (1.0 if plain else np.nan) * (effect_scores[0] - effect_scores[2]) / effect_scores[1]
    value, sigma, right, scores = np.concatenate([instrument, np.vstack([effect_scores, z])], axis=1)
    names, display_units = (
        tuple(calibration.instrument_parameter_names) + tuple(fitted),
        units + tuple(e.unit for e in fitted.values()),
    )
    return TrialScore(names, display_units, value, sigma, right, scores, network)


def _effect_parameter_estimates(calibration: Calibration) -> dict[str, ParameterEstimate]:
    """Estimates of effect parameters in a calibration, by name as in `true_parameters`."""
    effect_entries = calibration.effects
    names = effect_parameter_names((e.effect, e.place_text, [p.name for p in e.parameters]) for e in effect_entries)
    parameters = [parameter for entry in effect_entries for parameter in entry.parameters]
    return {
        name: ParameterEstimate(parameter.value, parameter.sigma, parameter.unit)
        for name, parameter in zip(names, parameters, strict=True)
        if isinstance(parameter.value, float) and parameter.sigma
    }


def _expected_chi2(calibration: Calibration, expected_truth: TrueParameterDistribution) -> tuple[float, float]:
    """Expectation and standard deviation of chi-square, for random noise and true parameters; NaN if unknown."""
    dof, sigma = calibration.fit.dof, calibration.fit.chi2_sigma
    if calibration.method != "network":
        return (dof, sigma) if expected_truth.is_drawn_from_prior and sigma is not None else (np.nan, np.nan)
    resolved, mean = (
        np.eye(len(expected_truth.mean_true_values)) - expected_truth.bias_matrix,
        expected_truth.mean_true_values,
    )
    lean = float(mean @ resolved @ mean)
    return dof + lean - float(np.diag(resolved) @ expected_truth.prior_variance_deficit_fraction), float(
        np.sqrt(2 * dof + 4 * lean)
    )


def _network_mean_square_z(
    calibration: Calibration, truth: Truth, expected: TrueParameterDistribution
) -> tuple[float, float]:
    """Mean squared z-scores (error / sigma): over all targets, and over the poses of stations.

    Bias and variance by the priors of the parameters are taken into account, so that the expectation of each is one.
    Both are NaN if the datum is not the first station, and for a calibration by distances if the true parameters were
    not drawn from the priors.
    """
    adjustment = calibration.adjustment
    unknown = calibration.method != "network" and not expected.is_drawn_from_prior
    if adjustment is None or unknown or adjustment.problem.free_motions.shape[1] < 6:
        return float("nan"), float("nan")
    # True stations and targets, moved rigidly so that the first station has its fixed pose.
    held, origin = adjustment.state, truth.station_positions[0]
    turn = truth.station_rotations[0] @ held.station_rotations[0].T
    unknowns, size = adjustment.problem.unknowns, np.zeros(adjustment.problem.unknowns.n_columns)
    bias, less = size.copy(), size.copy()
    if not expected.is_drawn_from_prior:
        pick = np.zeros((len(size), len(expected.mean_true_values)))
        pick[expected.network_column_indices, np.arange(len(expected.mean_true_values))] = 1.0 / expected.prior_sigmas
        missed = adjustment.factorised_normals.multiply_by_covariance(pick)
        bias, less = -missed @ expected.mean_true_values, missed**2 @ expected.prior_variance_deficit_fraction
    points = (truth.target_points - origin) @ turn + held.station_positions[0]
    variance = np.einsum("tii->ti", calibration.target_covariances) - less[unknowns.target_columns]
    targets = float(np.mean((calibration.target_points - points - bias[unknowns.target_columns]) ** 2 / variance))
    squares = []
    for i, station in enumerate(calibration.stations[1:], start=1):
        there, at = (truth.station_positions[i] - origin) @ turn + held.station_positions[0], unknowns.pose_columns[i]
        rotation = (
            Rotation.from_quat(station.quaternion) * Rotation.from_matrix(turn.T @ truth.station_rotations[i]).inv()
        )
        error = np.concatenate([station.position - there, rotation.as_rotvec()]) - bias[at]
        sigma = np.concatenate([station.sigma_position, station.sigma_rotation])
        squares.append(error**2 / (sigma**2 - less[at]))
    return targets, float(np.mean(squares)) if squares else float("nan")


def score_estimates(
    estimates: Mapping[str, ParameterEstimate],
    truth: Truth,
    error_origin: InstrumentErrorOrigin,
    full_ltsim_score: TrialScore | None,
) -> TrialScore:
    """Score of an external calibrator in a trial, with ltsim's score for the same parameters.

    Parameters are in the order and units of the truth file. `error_origin` is the origin of the true instrument errors,
    `full_ltsim_score` is ltsim's score for all parameters. CalibratorError is raised for a parameter without a true
    value, or with a unit of another quantity.
    """
    true = true_parameters(truth)
    unknown = next((name for name in estimates if name not in true), None)
    if unknown is not None:
        raise CalibratorError(
            f"the calibrator gives '{safe_excerpt(unknown)}', but the parameters of the simulated instrument "
            f"({truth.construction}) are {', '.join(true)}"
        )
    names = tuple(name for name in true if name in estimates)
    units = tuple(true[name].unit for name in names)
    for name, unit in zip(names, units, strict=True):
        if not are_convertible_units(estimates[name].unit, unit):
            raise CalibratorError(
                f"the calibrator's {name} is in {estimates[name].unit}, expected {unit} or a unit of that kind"
            )
    factor = np.array([SI_PER_UNIT[unit] for unit in units])
    scale = np.array([SI_PER_UNIT[estimates[name].unit] for name in names]) / factor
    value = scale * np.array([estimates[name].value for name in names])
    sigma = scale * np.array([estimates[name].sigma or np.nan for name in names])
    true_values = np.array([true[name].value for name in names]) / factor
    standard = (value - true_values) / sigma if error_origin == "drawn" else np.full(len(value), np.nan)
    ltsim_score = None
    if full_ltsim_score is not None:
        all_names = full_ltsim_score.parameter_names
        places = [all_names.index(name) if name in all_names else None for name in names]
        same = np.array([np.nan if k is None else full_ltsim_score.estimates[k] for k in places])
        ltsim_score = TrialScore(names, units, same, np.full(len(same), np.nan), true_values, standard)
    return TrialScore(
        names,
        units,
        value,
        sigma,
        true_values,
        standard,
        is_from_external_calibrator=True,
        ltsim_score=ltsim_score,
        ltsim_parameter_names=() if full_ltsim_score is None else full_ltsim_score.parameter_names,
    )
