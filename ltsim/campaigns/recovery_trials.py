"""Trials of a recovery check: simulated recording, its calibration by ltsim or an external calibrator, and scores."""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy import stats

from ltsim.calibration.calibration import Calibration
from ltsim.calibration.distance import calibrate_distance
from ltsim.calibration.network import calibrate_network
from ltsim.calibration.requested_effects import RequestedEffect
from ltsim.campaigns.external_calibrator import ExternalCalibrator, run_external_calibrator
from ltsim.campaigns.recovery_checks import (
    MIN_RECOVERY_TRIALS,
    NOMINAL_COVERAGE,
    RECOVERY_FALSE_ALARM_RATE,
    RecoveryCheck,
    fixed_true_value_checks,
    parameter_checks,
    tolerance_check,
    total_chi2_check,
    unit_mean_check,
)
from ltsim.campaigns.schema import InstrumentErrorOrigin
from ltsim.campaigns.scoring import (
    TrialScore,
    score_calibration,
    score_estimates,
)
from ltsim.core.arrays import Floats
from ltsim.core.equality import ValueEquality
from ltsim.core.errors import CalibratorError, ConvergenceError, LtsimError
from ltsim.core.parallel import run_parallel
from ltsim.core.results import Table, model_columns, number_columns, text_columns
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings import Recording
from ltsim.recordings.result_file import Entry, OptionalFloat
from ltsim.simulation.physics import instrument_error_distribution, make_scenario_construction
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.simulator import simulate

CONVERGENCE_CHECK_NAME = "convergence"
"""Name of the check that every trial has a result, in the table of checks."""


class RecoveryTolerance(NamedTuple):
    """Limit within which 95 % of the errors of a parameter must lie."""

    error_limit_95: float
    """Limit within which 95 % of the errors must lie, in the unit of the parameter."""
    text: str
    """Limit as the user gave it, with its unit."""


class RecoveredParameter(Entry):
    """Statistics of the errors of one parameter over the trials, in its unit; null for fewer than two trials."""

    parameter: str
    """Name of the parameter; for an effect ``EFFECT:PARAMETER``, followed by the station or target where the effect
    acts."""
    unit: str
    """Unit of the errors."""
    rms_error: OptionalFloat = None
    """Root mean square of the errors (estimate minus true value)."""
    mean_z: OptionalFloat = None
    """Mean of the z-scores (errors divided by declared standard deviations)."""
    standard_deviation_z: OptionalFloat = None
    """Standard deviation of the z-scores."""
    coverage_95: OptionalFloat = None
    """Fraction of the trials whose 95 % interval contains the true value."""
    ltsim_rms_error: OptionalFloat = None
    """Root mean square error of ltsim's estimates from the same recordings, if another calibrator is checked."""
    absolute_error_difference: OptionalFloat = None
    """Mean absolute error of the checked calibrator minus that of ltsim in the same recordings, positive if the errors
    of ltsim are smaller."""
    absolute_error_difference_low: OptionalFloat = None
    """Lower 95 % confidence limit of `absolute_error_difference`."""
    absolute_error_difference_high: OptionalFloat = None
    """Upper 95 % confidence limit of `absolute_error_difference`."""


RECOVERED_PARAMETERS_TABLE = Table(
    "parameters.csv", "errors of each parameter over the trials", model_columns(RecoveredParameter)
)
TRIALS_TABLE = Table(
    "trials.csv",
    "estimates of the trials with a result, one row per trial and parameter",
    (
        *number_columns(trial="number of the trial; `ltsim simulate --per-trial --trial NUMBER` makes its recording"),
        *text_columns(
            parameter="name of the parameter; for an effect EFFECT:PARAMETER and its station or target",
            unit="unit of truth, estimate and sigma",
        ),
        *number_columns("r", truth="true value", estimate="estimate of the calibrator", sigma="its declared sigma"),
        *number_columns(".6g", z="(estimate - truth) / sigma"),
        *number_columns(
            "r", ltsim_estimate="estimate of ltsim from the same recording, where another calibrator is checked"
        ),
    ),
)


class FailedTrial(NamedTuple):
    """Trial without a result, with the reason."""

    reason: str
    """Reason of the failure, as a sentence."""
    is_from_external_calibrator: bool
    """True if an external calibrator failed, false if ltsim's calibration failed."""


@dataclass(frozen=True)
class RecoverySettings:
    """Settings of a recovery check: ltsim's calibration method, and optionally an external calibrator."""

    method: str = "network"
    """Calibration method of ltsim, as for `calibrate`."""
    construction: GeometricErrorModel | None = None
    """Geometric error model of ltsim's calibration; None for the model of the scenario."""
    requested_effects: tuple[RequestedEffect, ...] = ()
    """Effects that ltsim's calibration estimates in addition to the instrument parameters."""
    calibrator: ExternalCalibrator | None = None
    """External calibrator that is checked; None to check ltsim's calibration."""
    error_origin: InstrumentErrorOrigin = "drawn"
    """Origin of the true errors of the instruments: drawn from the prior distribution of their parameters, or declared
    by the scenario."""


def run_recovery_trials(
    scenario: Scenario, trials: int, settings: RecoverySettings, *, seed: int = 0, jobs: int = 1
) -> Generator[TrialScore | FailedTrial, None, None]:
    """Score or failure of each of a number of `trials` drawn with `seed`, in the order of the trials.

    The result does not depend on the number of processes `jobs`.

    InputError is raised if the calibrator estimates a parameter that the scenario does not simulate.
    """
    drawn_scenario = scenario_with_errors_from_prior(scenario) if settings.error_origin == "drawn" else scenario
    tasks = ((drawn_scenario, seed, index, settings) for index in range(trials))
    yield from run_parallel(run_recovery_trial, tasks, min(jobs, trials), calls_per_batch=4)


def scenario_with_errors_from_prior(scenario: Scenario) -> Scenario:
    """Scenario in which all instrument errors are drawn from the prior distributions that the calibrator assumes."""
    error_fields = {"errors": {"draw": True}, "error_factor": 1.0}
    tracker_by_name = {name: tracker.model_copy(update=error_fields) for name, tracker in scenario.instruments.items()}
    return scenario.model_copy(
        update={"instrument": scenario.instrument.model_copy(update=error_fields), "instruments": tracker_by_name}
    )


def run_recovery_trial(
    scenario: Scenario, seed: int, trial_number: int, settings: RecoverySettings
) -> TrialScore | FailedTrial:
    """Score or failure of one trial: simulation, calibration, and comparison with the true parameters."""
    recording, truth = simulate(scenario, seed, trial_number, "per-trial")
    construction = make_scenario_construction(scenario)
    law = instrument_error_distribution(scenario, construction)
    names = construction.instrument_parameter_names(tuple(scenario.trackers_in_use))
    laws = dict(zip(names, zip(*(x.ravel() for x in law), strict=True), strict=True))
    reference = None
    try:
        reference = score_calibration(
            calibrate_by_settings(recording, settings, settings.construction or construction), truth, laws
        )
    except LtsimError as problem:
        if settings.calibrator is None and not isinstance(problem, ConvergenceError):
            raise
        reason = f"trial {trial_number}: {problem}"
    if settings.calibrator is None:
        return FailedTrial(reason, is_from_external_calibrator=False) if reference is None else reference
    try:
        estimates = run_external_calibrator(settings.calibrator, recording)
        return score_estimates(estimates, truth, settings.error_origin, reference)
    except CalibratorError as problem:
        return FailedTrial(f"trial {trial_number}: {problem}", is_from_external_calibrator=True)


def calibrate_by_settings(
    recording: Recording, settings: RecoverySettings, construction: GeometricErrorModel
) -> Calibration:
    """Calibration of a recording by the method of ltsim in `settings`, with the error model `construction`."""
    if settings.method == "network":
        return calibrate_network(
            recording,
            construction,
            recommend_measurements=False,
            choose_correction=False,
            requested_effects=settings.requested_effects,
        )
    return calibrate_distance(recording, construction, method=settings.method, advise=False)


@dataclass(frozen=True)
class RecoveryTrials(ValueEquality):
    """All trials of a recovery check, with statistics and checks of their scores."""

    trial_scores: tuple[TrialScore | None, ...]
    """Score of each trial; None for a trial without a result."""
    error_origin: InstrumentErrorOrigin = "drawn"
    """Origin of the true errors of the instruments: drawn from the prior distribution of their parameters, or declared
    by the scenario."""
    tolerance_by_parameter: Mapping[str, RecoveryTolerance] = field(default_factory=dict)
    """Tolerance by name of the parameter. If there is any, parameters without a tolerance are not checked."""
    run_time_s: float = 0.0
    """Run time of the trials [s]."""
    last_failure_reason: str = ""
    """Reason of the last failed trial; empty if no trial failed."""

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters that the checked calibrator estimates."""
        return self.available_trial_scores[0].parameter_names if self.available_trial_scores else ()

    @property
    def ltsim_parameter_names(self) -> tuple[str, ...]:
        """Names of all parameters that ltsim estimates in the same recordings; empty without an external calibrator."""
        return next((t.ltsim_parameter_names for t in self.available_trial_scores if t.ltsim_parameter_names), ())

    @property
    def available_trial_scores(self) -> list[TrialScore]:
        """Scores of the trials with a result."""
        return [trial for trial in self.trial_scores if trial is not None]

    def _attribute_by_trial(self, attribute: str) -> Floats:
        """Array (trials, parameters) of one attribute of `TrialScore`, for all trials with a result."""
        return np.stack([getattr(trial, attribute) for trial in self.available_trial_scores])

    @property
    def z_scores(self) -> Floats:
        """Errors divided by declared standard deviations, (trials, parameters), for the trials with a result."""
        return self._attribute_by_trial("z_scores")

    def unchecked_parameters(self) -> tuple[str, ...]:
        """Names of the parameters without a check: they have neither a sigma in each trial nor a tolerance."""
        if self.tolerance_by_parameter or not self.available_trial_scores:
            return ()
        is_checked = np.all(np.isfinite(self.z_scores), axis=0)
        return tuple(name for name, checked in zip(self.parameter_names, is_checked, strict=True) if not checked)

    def trial_rows(self) -> list[dict[str, object]]:
        """Rows of `trials.csv`, one per trial and parameter, in the unit of the parameter."""
        return [
            {"trial": number, "parameter": name, "unit": trial.parameter_units[k], "truth": trial.true_values[k],
             "estimate": trial.estimates[k], "sigma": trial.declared_sigmas[k], "z": trial.z_scores[k],
             "ltsim_estimate": None if trial.ltsim_score is None else trial.ltsim_score.estimates[k]}
            for number, trial in enumerate(self.trial_scores)
            if trial is not None
            for k, name in enumerate(trial.parameter_names)
        ]  # fmt: skip

    def parameter_statistics(self) -> tuple[RecoveredParameter, ...]:
        """Statistics of each parameter's errors, also for ltsim's calibrator if an external calibrator is checked."""
        columns: dict[str, Sequence[float]] = {}
        if len(self.available_trial_scores) >= MIN_RECOVERY_TRIALS:
            error, z = self._attribute_by_trial("estimates") - self._attribute_by_trial("true_values"), self.z_scores
            is_covered = np.abs(z) <= stats.norm.isf(0.5 * (1 - NOMINAL_COVERAGE))
            columns = {
                "rms_error": np.sqrt(np.mean(error**2, axis=0)).tolist(),
                "mean_z": z.mean(axis=0).tolist(),
                "standard_deviation_z": z.std(axis=0, ddof=1).tolist(),
                "coverage_95": np.mean(np.where(np.isfinite(z), is_covered, np.nan), axis=0).tolist(),
                **self._comparison_columns(error),
            }
        units = self.available_trial_scores[0].parameter_units if self.available_trial_scores else ()
        return tuple(
            RecoveredParameter(parameter=name, unit=unit, **{key: column[k] for key, column in columns.items()})
            for k, (name, unit) in enumerate(zip(self.parameter_names, units, strict=True))
        )

    def _comparison_columns(self, error: Floats) -> dict[str, Sequence[float]]:
        """Columns that compare the checked calibrator with ltsim's calibrator in the same recordings.

        `error` (trials, parameters) are the errors of the checked calibrator.
        """
        trial_indices = [k for k, trial in enumerate(self.available_trial_scores) if trial.ltsim_score is not None]
        if len(trial_indices) < MIN_RECOVERY_TRIALS:
            return {}
        reference = np.stack(
            [t.ltsim_score.estimates - t.true_values for t in self.available_trial_scores if t.ltsim_score is not None]
        )
        gap, count = np.abs(error[trial_indices]) - np.abs(reference), len(trial_indices)
        half_width = stats.t.isf(0.025, count - 1) * gap.std(axis=0, ddof=1) / np.sqrt(count)
        return {
            "ltsim_rms_error": np.sqrt(np.mean(reference**2, axis=0)).tolist(),
            "absolute_error_difference": gap.mean(axis=0).tolist(),
            "absolute_error_difference_low": (gap.mean(axis=0) - half_width).tolist(),
            "absolute_error_difference_high": (gap.mean(axis=0) + half_width).tolist(),
        }

    def checks(self) -> list[RecoveryCheck]:
        """All checks of a recovery run. A correct model fails at least one of them in one run of a hundred."""
        n_lost = len(self.trial_scores) - len(self.available_trial_scores)
        checks = [RecoveryCheck.from_value(CONVERGENCE_CHECK_NAME, "trials without a result", n_lost, 0, 0)]
        if len(self.available_trial_scores) < MIN_RECOVERY_TRIALS:
            return checks
        indices = [
            k
            for k, name in enumerate(self.parameter_names)
            if not self.tolerance_by_parameter or name in self.tolerance_by_parameter
        ]
        level = RECOVERY_FALSE_ALARM_RATE / (4 * len(indices) + 3)
        checks += [check for k in indices for check in self._parameter_checks(k, level)]
        return checks if self.tolerance_by_parameter else checks + self._network_checks(level)

    def _parameter_checks(self, parameter_index: int, alpha: float) -> list[RecoveryCheck]:
        """Checks of one parameter with false-alarm rate `alpha`; its z-scores are checked if every trial has one."""
        name, standard, z = (
            self.parameter_names[parameter_index],
            self._attribute_by_trial("prior_independent_z_scores")[:, parameter_index],
            self.z_scores[:, parameter_index],
        )
        foreign, checks = self.available_trial_scores[0].is_from_external_calibrator, list[RecoveryCheck]()
        if np.all(np.isfinite(standard)):
            checks += parameter_checks(name, standard, alpha)
        if self.error_origin == "stated" and np.all(np.isfinite(z)):
            mean, spread, coverage = fixed_true_value_checks(name, z, alpha)
            checks += [mean, spread] if foreign else []  # for ltsim's calibrator the standardised z-scores contain both
            checks.append(coverage)
        if self.tolerance_by_parameter:
            given = self.tolerance_by_parameter[name]
            error = (
                self._attribute_by_trial("estimates")[:, parameter_index]
                - self._attribute_by_trial("true_values")[:, parameter_index]
            )
            checks.append(tolerance_check(name, error, given.error_limit_95, given.text))
        return checks

    def _network_checks(self, alpha: float) -> list[RecoveryCheck]:
        """Checks of chi-square, targets and stations; `alpha` is the false-alarm rate of each check."""
        parts, checks = [trial.network_score for trial in self.available_trial_scores], []
        if all(np.isfinite(part.expected_chi2) for part in parts):
            names = ("chi2", "expected_chi2", "chi2_sigma")
            chi2, expected, spread = (np.array([getattr(p, n) for p in parts]) for n in names)
            checks.append(total_chi2_check(chi2, expected, spread, alpha))
        for what in ("targets", "stations"):
            squares = np.array([getattr(part, f"{what[:-1]}_mean_square_z") for part in parts])
            if np.all(np.isfinite(squares)):
                checks.append(unit_mean_check(what, "mean squared error over variance", squares, alpha))
        return checks
