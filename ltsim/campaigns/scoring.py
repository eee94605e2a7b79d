"""Scores of calibrators relative to a known truth: errors divided by declared sigmas, and their expected distribution.

A foreign calibrator is a program, or a function, that takes a recording and gives parameters. The program is called
with the folder of a recording and the name of a file to write: a `calibration.json`, or

    {"format": "ltsim-estimates/1",
     "parameters": [{"name": "beam-tilt", "value": 5.9, "sigma": 2.5, "unit": "urad"},
                    {"name": "head-sag:sag", "value": 3.1, "unit": "urad"}]}

A parameter without a sigma can be judged by a tolerance only.
"""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError
from scipy.spatial.transform import Rotation

from ltsim.calibration.calibration import Calibration
from ltsim.campaigns.schema import ErrorOrigin
from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import CalibratorError, RecordError, SetupError
from ltsim.core.parallel import SAFE_PATH
from ltsim.core.units import SI_PER_UNIT, has_same_kind
from ltsim.core.values import ValueEquality
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.recordings import Recording, write as write_recording
from ltsim.recordings.files import quoted_text
from ltsim.recordings.result_file import read_json
from ltsim.recordings.setup import Finite
from ltsim.simulation.truth import Truth

MIN_NOISE_FRACTION = 1e-4
"""Fraction of a declared variance below which the error comes from the prior and not from noise."""
MAX_LINE_LENGTH = 300
"""Largest number of characters of an external program's last line in a message."""
RECORDING_PLACEHOLDER = "{recording}"
"""Word of a calibrator command that is replaced by the path of the recording."""
OUTPUT_PLACEHOLDER = "{out}"
"""Word of a calibrator command that is replaced by the path of the output file."""


class ParameterEstimate(NamedTuple):
    """Parameter estimated by a calibrator, in a unit that `ltsim effects` lists."""

    value: Finite
    sigma: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None
    unit: str


ExternalCalibrator = str | Callable[[Recording], Mapping[str, ParameterEstimate | tuple[float, float | None, str]]]
"""External calibrator: a command with the words {recording} and {out}, or a function that returns value, sigma and unit
by name.
"""
_ESTIMATES_ADAPTER = TypeAdapter(dict[str, ParameterEstimate])


def split_command(command: str) -> list[str]:
    """Words of a command; raises SetupError for a command without {recording} or {out}."""
    for place in (RECORDING_PLACEHOLDER, OUTPUT_PLACEHOLDER):
        if place not in command:
            expected = f"'CMD {RECORDING_PLACEHOLDER} {OUTPUT_PLACEHOLDER}'"
            raise SetupError(f"--calibrator '{quoted_text(command)}' lacks {place}: expected {expected}")
    try:
        return shlex.split(command)
    except ValueError as problem:
        raise SetupError(f"--calibrator '{quoted_text(command)}': {problem}") from None


def run_external_calibrator(
    calibrator: ExternalCalibrator, recording: Recording, origin: str
) -> dict[str, ParameterEstimate]:
    """Parameters that an external calibrator estimates from a recording, by name.

    Raises CalibratorError when it ends without a result (a status other than 0, None); SetupError or RecordError, with
    `origin`, when it cannot be started or its result does not follow the format.
    """
    if not isinstance(calibrator, str):
        given = calibrator(recording)
        if given is None:
            raise CalibratorError(f"the calibrator gave no result (None) for {origin}")
        return _validated_estimates(given, f"the calibrator's result of {origin}")
    words = split_command(calibrator)
    with TemporaryDirectory() as place:
        folder, out = Path(place) / "recording", Path(place) / "estimates.json"
        write_recording(recording, folder)
        filled = [
            word.replace(RECORDING_PLACEHOLDER, str(folder)).replace(OUTPUT_PLACEHOLDER, str(out)) for word in words
        ]
        try:
            environment = {name: value for name, value in os.environ.items() if name != SAFE_PATH}  # of our processes
            done = subprocess.run(
                filled, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, check=False, env=environment
            )
        except OSError as problem:
            raise SetupError(f"--calibrator: {quoted_text(words[0])} cannot be started ({problem.strerror})") from None
        if done.returncode:
            lines = done.stderr.decode("utf-8", "replace").split("\n")
            last = next((line.strip() for line in reversed(lines) if line.strip()), "")
            detail = f"its last line was: {quoted_text(last, MAX_LINE_LENGTH)}" if last else "standard error is empty"
            what = f"'{quoted_text(calibrator)}' ended with status {done.returncode}"
            raise CalibratorError(f"{what} for {origin}; {detail}")
        try:
            content = read_json(out / "calibration.json" if out.is_dir() else out, "list of parameters")
            listed = {e["name"]: [e["value"], e.get("sigma"), e["unit"]] for e in content["parameters"]}
        except (RecordError, OSError, KeyError, TypeError) as problem:
            message = f"the result is no list of parameters with name, value and unit ({problem!r})"
            raise RecordError(message, file=origin) from None
        return _validated_estimates(listed, origin)


def _validated_estimates(answer: object, origin: str) -> dict[str, ParameterEstimate]:
    try:
        estimates = _ESTIMATES_ADAPTER.validate_python(answer)
    except ValidationError as problem:
        first = problem.errors()[0]
        place = " ".join(str(part) for part in first["loc"])
        raise RecordError(f"{place}: {first['msg']}; expected value, sigma and unit by name", file=origin) from None
    lost = next((entry.unit for entry in estimates.values() if entry.unit not in SI_PER_UNIT), None)
    if lost is not None:
        raise RecordError(f"'{quoted_text(lost)}' is not a unit, expected one of {', '.join(SI_PER_UNIT)}", file=origin)
    if not estimates:
        raise RecordError("no parameter in the result; expected at least one", file=origin)
    return estimates


@dataclass(frozen=True)
class NetworkScore:
    """Scores of a trial for the whole network; NaN for a score that does not exist."""

    target_mean_square: float = np.nan
    """Mean square of error divided by standard deviation, over all target coordinates."""
    station_mean_square: float = np.nan
    """Mean square of error divided by standard deviation, over all poses except the first one."""
    chi2: float = np.nan
    dof: float = np.nan
    expected_chi2: float = np.nan
    """Mean of chi-square over the noise and over the distribution of the truth."""
    chi2_deviation: float = np.nan
    """Standard deviation of chi-square over the noise and over the distribution of the truth."""


@dataclass(frozen=True)
class TrialScore(ValueEquality):
    """Estimates of p parameters by a calibrator in one trial, with the true values, in units of display."""

    parameter_names: tuple[str, ...]
    parameter_units: tuple[str, ...]
    estimates: Floats
    declared_sigmas: Floats
    """Standard deviations that the calibrator declares, (p,); NaN for none."""
    true_values: Floats
    standard_z_scores: Floats
    """z-scores (p,) that are standard normal for a correct calibrator, also with truths that are not drawn from the
    prior. NaN for parameters without influence of noise, and for a calibrator with unknown prior.
    """
    network_score: NetworkScore = NetworkScore()
    is_external: bool = False
    """True for an external calibrator, whose prior is unknown."""
    ltsim_estimates: TrialScore | None = None
    """Estimates of ltsim's calibrator from the same recording; None if there is no external calibrator."""

    @property
    def z_scores(self) -> Floats:
        """Errors divided by declared sigmas, (p,)."""
        return (self.estimates - self.true_values) / self.declared_sigmas


class TrueParameter(NamedTuple):
    """True value of a parameter [SI], and its unit of display."""

    value: float
    unit: str


def true_parameters(truth: Truth) -> dict[str, TrueParameter]:
    """True parameters by name; those of effects as ``head-sag:sag``, followed by their place if they have one."""
    values = {name: TrueParameter(value, truth.units[name]) for name, value in truth.instrument_values.items()}
    for applied in truth.applied_effects:
        place = f" {applied.effect.place_text}" if applied.effect.place_text else ""
        for parameter, value in zip(applied.effect.parameters, applied.parameter_values, strict=True):
            values[f"{applied.effect.name}:{parameter.name}{place}"] = TrueParameter(float(value), parameter.unit)
    return values


def check_true_parameters(names: Sequence[str], true_names: Collection[str], truth: Truth) -> None:
    """Check that parameters have true values; raises SetupError for another one."""
    unknown = [name for name in names if name not in true_names]
    if unknown:
        raise SetupError(
            f"the simulated instrument ({truth.construction}) has no parameter {unknown[0]}, "
            "which the calibrator gives; recover with the same construction"
        )


@dataclass(frozen=True)
class ExpectedTruth:
    """Distribution of the true values of P parameters [prior sigma], and bias of the estimates by the prior."""

    mean_truth: Floats
    """Mean of the distribution of the true parameters, (P,); the true values if they were not drawn."""
    truth_sigmas: Floats
    """Standard deviation of the distribution of the true parameters, (P,); 0 for declared values."""
    bias_matrix: Floats
    """Matrix (P, P) of the bias by the prior: without noise, estimate minus truth is -bias_matrix @ truth."""
    network_columns: Ints
    """Columns of these parameters in the design of the adjusted network, (P,); empty for a method without a network."""
    prior_sigmas: Floats
    """Prior standard deviations of the parameters, (P,) [SI]."""

    @classmethod
    def from_calibration(
        cls, calibration: Calibration, truth: Truth, distribution: Mapping[str, tuple[float, float]]
    ) -> ExpectedTruth:
        """Distribution of the truth of a simulated recording; `distribution` as in `score_calibration`."""
        prior = calibration.prior_sigma.ravel()
        mean, drawn = np.array([distribution[name] for name in calibration.instrument_parameter_names]).T / prior
        adjustment = calibration.adjustment
        if adjustment is None or calibration.method != "network":
            return cls(mean, drawn, calibration.arrays.bias_operator, np.zeros(0, dtype=np.int64), prior)
        model, unknowns = adjustment.problem.model, adjustment.problem.unknowns
        reflectors = [
            np.linalg.solve(e.covariance_root, _true_incidence_parameters(truth) - e.mean_parameters)
            for e in model.incidence_errors
        ]
        more = np.concatenate([np.zeros(0), *reflectors])
        columns = np.concatenate(
            [unknowns.instrument_columns.ravel(), *(unknowns.extra_columns[at] for at in model.incidence_columns)]
        )
        is_free = np.concatenate([~calibration.is_fixed.ravel(), np.ones(len(more), dtype=bool)])
        units = np.concatenate([prior, np.ones(len(more))])
        missed = adjustment.reduced_covariance[columns[:, None], columns] / np.outer(units, units)
        missed = np.where(is_free[:, None] & is_free, missed, 0.0)
        return cls(np.append(mean, more), np.append(drawn, 0.0 * more), missed, columns, units)

    @property
    def is_drawn_from_prior(self) -> bool:
        """True if the true parameters were drawn from the prior."""
        return not np.any(self.mean_truth) and bool(np.all(self.truth_sigmas == 1.0))

    @property
    def missing_variance(self) -> Floats:
        """Fraction (P,) by which the variance of the truth is smaller than that of the prior."""
        return 1.0 - self.truth_sigmas**2


def _true_incidence_parameters(truth: Truth) -> Floats:
    """True parameters (14,) [SI] of the range error over incidence (effect `smr-incidence`) of all reflectors."""
    total = SmrIncidence().parameters_from_table
    for applied in truth.applied_effects:
        if isinstance(applied.effect, SmrIncidence) and not applied.effect.place_text:
            total = total + applied.effect.parameters_from_table + applied.parameter_values
    return total


def score_calibration(
    calibration: Calibration, truth: Truth, distribution: Mapping[str, tuple[float, float]]
) -> TrialScore:
    """Score of ltsim's calibration relative to a truth; raises SetupError for a parameter without a true value.

    `distribution` holds mean and standard deviation [SI] from which each true parameter was drawn; 0 for a declared
    one.
    """
    check_true_parameters(calibration.instrument_parameter_names, truth.instrument_values, truth)
    expected = ExpectedTruth.from_calibration(calibration, truth, distribution)
    count = len(calibration.instrument_parameter_names)
    true = np.array([truth.instrument_values[name] for name in calibration.instrument_parameter_names])
    prior = calibration.prior_sigma.ravel()
    error, sigma_scaled = (calibration.estimates.ravel() - true) / prior, calibration.sigma.ravel() / prior
    missed = expected.bias_matrix[:count]
    variance = sigma_scaled**2 - missed**2 @ expected.missing_variance
    noisy = variance > MIN_NOISE_FRACTION * sigma_scaled**2
    standard = np.where(noisy, (error + missed @ expected.mean_truth) / np.sqrt(np.where(noisy, variance, 1.0)), np.nan)
    network = NetworkScore(
        *_network_scores(calibration, truth, expected),
        calibration.fit.chi2,
        calibration.fit.dof,
        *_expected_chi2(calibration, expected),
    )
    units = tuple(truth.units[name] for name in calibration.instrument_parameter_names)
    factor = np.array([SI_PER_UNIT[unit] for unit in units])
    instrument = np.stack(
        [calibration.estimates.ravel() / factor, calibration.sigma.ravel() / factor, true / factor, standard]
    )
    more = true_parameters(truth)
    fitted = {name: entry for name, entry in _effect_parameters(calibration).items() if name in more}
    plain = np.all(expected.truth_sigmas[:count] == 1.0) and not np.any(
        expected.mean_truth[:count]
    )  # else priors move effects too
    extra = np.array(
        [[e.value, e.sigma or np.nan, more[name].value / SI_PER_UNIT[e.unit]] for name, e in fitted.items()]
    )
    extra = extra.reshape(-1, 3).T
    z = (1.0 if plain else np.nan) * (extra[0] - extra[2]) / extra[1]
    value, sigma, right, scores = np.concatenate([instrument, np.vstack([extra, z])], axis=1)
    names, shown = (
        tuple(calibration.instrument_parameter_names) + tuple(fitted),
        units + tuple(e.unit for e in fitted.values()),
    )
    return TrialScore(names, shown, value, sigma, right, scores, network)


def _effect_parameters(calibration: Calibration) -> dict[str, ParameterEstimate]:
    """Estimates of the parameters of effects in a calibration, by the names of `true_parameters`."""
    return {
        f"{entry.effect}:{parameter.name}" + (f" {entry.place_text}" if entry.place_text else ""): ParameterEstimate(
            parameter.value, parameter.sigma, parameter.unit
        )
        for entry in calibration.effects
        for parameter in entry.parameters
        if isinstance(parameter.value, float) and parameter.sigma
    }


def _expected_chi2(calibration: Calibration, expected: ExpectedTruth) -> tuple[float, float]:
    """Mean and standard deviation of chi-square, over noise and true parameters; NaN if they are unknown."""
    dof, sigma = calibration.fit.dof, calibration.fit.chi2_sigma
    if calibration.method != "network":
        return (dof, sigma) if expected.is_drawn_from_prior and sigma is not None else (np.nan, np.nan)
    resolved, mean = np.eye(len(expected.mean_truth)) - expected.bias_matrix, expected.mean_truth
    lean = float(mean @ resolved @ mean)
    return dof + lean - float(np.diag(resolved) @ expected.missing_variance), float(np.sqrt(2 * dof + 4 * lean))


def _network_scores(calibration: Calibration, truth: Truth, expected: ExpectedTruth) -> tuple[float, float]:
    """Mean squares of error divided by standard deviation: of all targets, and of the poses of stations.

    Bias and variance by the prior are taken into account, so that both have expectation one. NaN for a datum other than
    the first station, and for a distance method if the truth was not drawn from the prior.
    """
    adjustment = calibration.adjustment
    unknown = calibration.method != "network" and not expected.is_drawn_from_prior
    if adjustment is None or unknown or adjustment.problem.free_motions.shape[1] < 6:
        return float("nan"), float("nan")
    # The truth moved to where the first station is held.
    held, origin = adjustment.state, truth.station_positions[0]
    turn = truth.station_rotations[0] @ held.station_rotations[0].T
    unknowns, size = adjustment.problem.unknowns, np.zeros(adjustment.problem.unknowns.n_columns)
    bias, less = size.copy(), size.copy()
    if not expected.is_drawn_from_prior:
        pick = np.zeros((len(size), len(expected.mean_truth)))
        pick[expected.network_columns, np.arange(len(expected.mean_truth))] = 1.0 / expected.prior_sigmas
        missed = adjustment.factorised_normals.covariance_columns(pick)
        bias, less = -missed @ expected.mean_truth, missed**2 @ expected.missing_variance
    points = (truth.target_points - origin) @ turn + held.station_positions[0]
    variance = np.einsum("tii->ti", calibration.target_covariance) - less[unknowns.target_columns]
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
    estimates: Mapping[str, ParameterEstimate], truth: Truth, errors: ErrorOrigin, reference: TrialScore | None
) -> TrialScore:
    """Score of an external calibrator in a trial, with ltsim's estimates of the same parameters.

    Parameters are in the order and units of the truth. Raises SetupError for a parameter without a true value, or with
    a unit of another kind.
    """
    true = true_parameters(truth)
    check_true_parameters(tuple(estimates), true, truth)
    names = tuple(name for name in true if name in estimates)
    units = tuple(true[name].unit for name in names)
    for name, unit in zip(names, units, strict=True):
        if not has_same_kind(estimates[name].unit, unit):
            raise SetupError(
                f"the calibrator's {name} is in {estimates[name].unit}, expected {unit} or a unit of that kind"
            )
    factor = np.array([SI_PER_UNIT[unit] for unit in units])
    scale = np.array([SI_PER_UNIT[estimates[name].unit] for name in names]) / factor
    value = scale * np.array([estimates[name].value for name in names])
    sigma = scale * np.array([estimates[name].sigma or np.nan for name in names])
    right = np.array([true[name].value for name in names]) / factor
    standard = (value - right) / sigma if errors == "drawn" else np.full(len(value), np.nan)
    other = None
    if reference is not None:
        places = [
            reference.parameter_names.index(name) if name in reference.parameter_names else None for name in names
        ]
        same = np.array([np.nan if k is None else reference.estimates[k] for k in places])
        other = TrialScore(names, units, same, np.full(len(same), np.nan), right, standard)
    return TrialScore(names, units, value, sigma, right, standard, is_external=True, ltsim_estimates=other)
