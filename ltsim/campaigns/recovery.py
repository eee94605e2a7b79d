"""Recovery of true instrument errors by calibrations of simulated recordings, as a check for continuous integration.

Each trial simulates a recording (`lt.simulate(..., trial=N, geometry="per-trial")`) and calibrates it with ltsim or an
external calibrator. The errors of the estimates are divided by their declared standard deviations (z-scores). There are
two origins of the true errors of the instrument:

* `drawn`: every parameter is drawn from its prior. For a correct model and a correct covariance the z-scores are
  standard normal.
* `stated`: the scenario declares the parameters, or declares that they are drawn. The prior biases the estimate of a
  fixed parameter towards the prior mean and reduces its scatter. Bias and scatter follow from the covariance C of the
  estimates, in units of prior standard deviations: for the true parameters t the mean error is -C t, and the
  covariance of the errors is C - C C. Errors minus this mean, divided by the standard deviation from this covariance,
  are standard normal too. In addition, the declared 95 % intervals have to contain the true value in at least 95 % of
  the trials.

The prior of an external calibrator is unknown. With errors `drawn` its z-scores have to be standard normal. With errors
`stated` the mean of the z-scores has to be 0, their standard deviation at most 1, and the intervals have to contain the
true value. A parameter without a standard deviation and without a tolerance is not checked. A run with such a parameter
passes only if this is permitted. Chi-square, targets and stations are checked only for ltsim's calibrator.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from typing import ClassVar, Literal, Self, get_args

from pydantic import Field, PrivateAttr

from ltsim.calibration.distance import OBJECTIVE_NORM_BY_DISTANCE_METHOD
from ltsim.calibration.verbs import parse_requested_effect
from ltsim.campaigns.external_calibrator import ExternalCalibrator, split_calibrator_command
from ltsim.campaigns.recovery_checks import RECOVERY_CHECKS_TABLE, RecoveryCheck
from ltsim.campaigns.recovery_trials import (
    CONVERGENCE_CHECK_NAME,
    RECOVERED_PARAMETERS_TABLE,
    TRIALS_TABLE,
    FailedTrial,
    RecoveredParameter,
    RecoverySettings,
    RecoveryTolerance,
    RecoveryTrials,
    run_recovery_trials,
)
from ltsim.campaigns.schema import InstrumentErrorOrigin, NonNegativeInt
from ltsim.campaigns.scoring import TrialScore
from ltsim.core.arguments import check_argument_bounds, check_argument_choice, check_mapping_argument
from ltsim.core.errors import InputError, ModelError, option_text
from ltsim.core.notation import names_text
from ltsim.core.results import Table
from ltsim.core.units import parse_quantity_in_unit
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.verbs import effect_tuple
from ltsim.physics.model.construction import make_construction as construction_called
from ltsim.recordings.result_file import ResultFile
from ltsim.simulation.physics import make_scenario_construction
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.verbs import ScenarioSource, scenario as scenario_of, simulate

MAX_EARLY_FAILURES = 3
"""Number of failed trials of an external calibrator that ends a run, because a command that does not work fails in
every trial. One failed trial is enough for the convergence check to fail."""
MAX_LISTED_PARAMETERS = 3
"""Largest number of parameters that a sentence lists; tables and files contain all parameters."""


class Recovery(ResultFile):
    """Result of `recover`, with the content of `recovery.json`."""

    FILE: ClassVar[str] = "recovery.json"
    COMPANION_TABLES: ClassVar[Mapping[str, Table]] = {"trials": TRIALS_TABLE}
    format: Literal["ltsim-recovery/1"] = "ltsim-recovery/1"
    """Format and version of this file."""
    passed: bool
    """True if all checks passed and no parameter is unchecked, unless unchecked parameters are permitted."""
    error_origin: InstrumentErrorOrigin = "drawn"
    """Origin of the true instrument errors: `drawn` from the prior distribution of the parameters, or `stated`
    (declared) by the scenario."""
    trials: NonNegativeInt
    """Number of trials."""
    trials_with_result: NonNegativeInt
    """Number of trials in which the calibration converged."""
    seed: NonNegativeInt
    """Seed of the random draws."""
    checks: tuple[RecoveryCheck, ...]
    """Checks that a number lies between two limits. A correct model fails at least one of them in one run of 100."""
    parameters: tuple[RecoveredParameter, ...] = ()
    """Statistics of the errors of each parameter over the trials."""
    ltsim_parameters: tuple[str, ...] = ()
    """Names of all parameters that ltsim estimates in the same recordings, if another calibrator is checked."""
    unchecked_parameters: tuple[str, ...] = ()
    """Names of the parameters without a check: they have neither a sigma in each trial nor a tolerance."""
    allow_unchecked: bool = False
    """True if the run may pass with unchecked parameters."""
    tolerances: dict[str, str] = Field(default_factory=dict)
    """Tolerances of the user by parameter, such as `2 urad`. If there are any, parameters without a tolerance are not
    checked."""
    last_failure_reason: str = ""
    """Reason of the last failed trial; empty if no trial failed."""
    _arrays: RecoveryTrials | None = PrivateAttr(None)

    @classmethod
    def from_trials(cls, trials: RecoveryTrials, *, seed: int = 0, allow_unchecked: bool = False) -> Self:
        """Result of a recovery check from its trials.

        `seed` is the seed of the trials. With `allow_unchecked` the check may pass although parameters are unchecked.
        """
        checks, unchecked = tuple(trials.checks()), trials.unchecked_parameters()
        result = cls(
            passed=all(check.passed for check in checks) and (allow_unchecked or not unchecked),
            error_origin=trials.error_origin,
            trials=len(trials.trial_scores),
            trials_with_result=len(trials.available_trial_scores),
            seed=seed,
            checks=checks,
            parameters=trials.parameter_statistics(),
            ltsim_parameters=trials.ltsim_parameter_names,
            unchecked_parameters=unchecked,
            allow_unchecked=allow_unchecked,
            tolerances={name: tolerance.text for name, tolerance in trials.tolerance_by_parameter.items()},
            last_failure_reason=trials.last_failure_reason,
        )
        result._arrays = trials
        return result

    @property
    def arrays(self) -> RecoveryTrials:
        """Arrays of the trials; raises ModelError for a result that was read from a file."""
        if self._arrays is None:
            raise ModelError(
                "a result read from recovery.json has no arrays; trials.csv in its folder contains the trials"
            )
        return self._arrays

    def _summary_lines(self) -> list[str]:
        return [
            f"Recovery (errors {self.error_origin}): {self.trials} trials, {self.trials_with_result} with a result; "
            f"{self.verdict_text()}",
            *self.unestimated_parameter_sentences(),
            *self.failure_sentences(),
        ]

    def _table_makers(self) -> Mapping[str, Callable[[], Table]]:
        return {
            "checks": lambda: RECOVERY_CHECKS_TABLE.with_rows(self.checks),
            "parameters": lambda: RECOVERED_PARAMETERS_TABLE.with_rows(self.parameters),
            "trials": lambda: TRIALS_TABLE.with_rows(self.arrays.trial_rows()),
        }

    def failed_checks(self) -> list[RecoveryCheck]:
        """Recovery checks that failed: their statistic is outside its limits."""
        return [check for check in self.checks if not check.passed]

    def unestimated_parameter_sentences(self) -> list[str]:
        """Sentences on parameters that ltsim estimates but the checked calibrator does not; empty list without any."""
        more = [name for name in self.ltsim_parameters if name not in {p.parameter for p in self.parameters}]
        if not more:
            return []
        names = ", ".join(p.parameter for p in self.parameters)
        count = len(self.parameters)
        return [
            f"The calibrator estimates {count} parameter{'' if count == 1 else 's'} ({names}). In the comparison "
            f"ltsim estimates {len(self.ltsim_parameters)}, also {names_text(more, MAX_LISTED_PARAMETERS)}. These "
            "further parameters increase the uncertainty of the estimates of ltsim; the calibrator, which neglects "
            "them, has errors from their effects."
        ]

    def verdict_text(self) -> str:
        """Result in a few words, such as `everything is recovered within its declared uncertainty`."""
        phrase = "the given tolerances" if self.tolerances else "its declared uncertainty"
        if self.failed_checks():
            return "the check fails"
        names, count = [p.parameter for p in self.parameters], len(self.parameters)
        limited = [name for name in names if name in self.tolerances]
        if self.tolerances and len(limited) < count:
            verb = "is" if len(limited) == 1 else "are"
            checked_text = f"{len(limited)} of {count} parameters ({names_text(limited, MAX_LISTED_PARAMETERS)}) {verb}"
            return f"{checked_text} recovered within {phrase}, the others have no tolerance and are not checked"
        if not self.unchecked_parameters:
            return f"everything is recovered within {phrase}"
        checked = count - len(self.unchecked_parameters)
        if not checked:
            return "no parameter is checked"
        return f"{checked} of {count} parameters are recovered within {phrase}, the others are not checked"

    def failure_reason(self, check: RecoveryCheck) -> str:
        """Reason of a failed check: last error of a trial (convergence check), or value and limits (other checks)."""
        return (
            self.last_failure_reason
            if check.subject == CONVERGENCE_CHECK_NAME and self.last_failure_reason
            else check.sentence()
        )

    def failure_sentences(self) -> list[str]:
        """Sentences on each reason why the run does not pass, and on unchecked parameters."""
        sentences = [check.sentence() for check in self.failed_checks()]
        if self.last_failure_reason and self.trials_with_result < self.trials:
            sentences.insert(0, self.last_failure_reason)
        if unchecked := self.unchecked_parameters:
            example = f"{option_text('tolerance')} {unchecked[0]}='2 {self.parameters[0].unit}'"
            several = (
                f"{len(unchecked)} of {len(self.parameters)} parameters "
                f"({names_text(unchecked, MAX_LISTED_PARAMETERS)}) are"
            )
            sentence = f"{several if len(unchecked) > 1 else f'{unchecked[0]} is'} not checked: the calibrator does "
            sentence += "not declare the standard deviation in every trial"
            advice = (
                f"; let it declare one, or give a tolerance such as {example}, or {option_text('allow_unchecked=True')}"
            )
            sentences.append(sentence if self.allow_unchecked else sentence + advice)
        return sentences


def recover(
    source: ScenarioSource,
    *,
    trials: int = 200,
    method: str = "network",
    construction: str | None = None,
    with_effects: str | Effect | Sequence[str | Effect] = (),
    calibrator: ExternalCalibrator | None = None,
    tolerance: Mapping[str, str] | None = None,
    allow_unchecked: bool = False,
    errors: InstrumentErrorOrigin | None = None,
    seed: int = 0,
    jobs: int = 1,
    progress: Callable[[int], None] = lambda trials: None,
) -> Recovery:
    """Recovery check: many simulated recordings are calibrated, and estimates are compared with true parameters.

    Parameters
    ----------
    source : Scenario, str or Path
        Scenario, its file, or the name of a built-in scenario.
    trials : int
        Number of simulated recordings, at least two.
    method : str
        Calibration method of ltsim's calibrator, with the same names as for `calibrate`.
    with_effects : str, Effect or sequence of them
        Effects that ltsim's calibrator also estimates, in the same form as for `calibrate`.
    construction : str, optional
        Geometric error model of ltsim's calibrator; default the model of the scenario.
    calibrator : callable or str, optional
        External calibrator, compared with ltsim's calibrator: a command ``CMD {recording} {out}`` that reads a
        recording and writes parameters as JSON. In Python it can also be a function of a recording that returns value,
        sigma (or None) and unit of each parameter by name. Parameters of effects have names such as ``head-sag:sag``.
        A trial without a valid result (an error, no file, a value that is not finite) fails; the run ends after three
        failed trials.
    tolerance : mapping of str to str, optional
        Limit that 95 % of the errors of a parameter must not exceed, such as `2 urad` for `beam-tilt`; only parameters
        with a tolerance are then checked.
    allow_unchecked : bool
        True to pass although a parameter cannot be checked, because it has neither a declared standard deviation nor a
        tolerance.
    errors : {`drawn`, `stated`}, optional
        Instrument errors that are drawn from the prior distribution of the instrument parameters, or given by the
        scenario; default `stated` if the scenario gives any.
    seed : int
        Seed of all random draws. Trial N equals trial N of `simulate` with this seed and the geometry `per-trial`.
    jobs : int
        Number of processes; a function as calibrator runs in this process.
    progress : callable
        Callback that is called after every trial.

    Returns
    -------
    Recovery
        Result with `passed`, `checks` and `failure_sentences()`; `failed_checks()` lists the failed checks. A correct
        model fails at least one check in one run of a hundred.

    Examples
    --------
    >>> import ltsim as lt
    >>> lt.recover("paper-workshop", trials=12).failure_sentences()
    []
    """
    check_argument_bounds(trials=trials, seed=seed, jobs=jobs, required_argument="trials seed jobs")
    check_mapping_argument("tolerance", tolerance)
    check_argument_choice("method", method, ("network", *OBJECTIVE_NORM_BY_DISTANCE_METHOD))
    check_argument_choice("errors", errors, get_args(InstrumentErrorOrigin), allow_none=True)
    if calibrator is not None and not (isinstance(calibrator, str) or callable(calibrator)):
        raise InputError(f"{option_text('calibrator')} is {calibrator!r}, expected a command or a function")
    scenario, given = scenario_of(source), tolerance or {}
    true_construction, mode = make_scenario_construction(scenario), errors or default_origin_of_true_errors(scenario)
    if true_construction.name == "dh" and construction not in (None, "dh"):
        raise InputError(f"the scenario's instrument has the construction dh: set {option_text('construction')} to dh")
    if isinstance(calibrator, str):
        split_calibrator_command(calibrator)
    elif calibrator is not None:
        jobs = 1
    effects = effect_tuple(with_effects)
    example = simulate(scenario, seed=seed).recording if effects else None
    requested_effects = tuple(parse_requested_effect(text, example) for text in effects if example is not None)
    model = true_construction if construction is None else construction_called(construction)
    settings = RecoverySettings(method, model, requested_effects, calibrator, mode)
    began, done, within, problem = time.monotonic(), list[TrialScore | None](), dict[str, RecoveryTolerance](), ""
    failed = 0
    with closing(run_recovery_trials(scenario, trials, settings, seed=seed, jobs=jobs)) as outcomes:
        for given_outcome in outcomes:
            outcome = _failed_if_parameters_differ_from_first_trial(given_outcome, done)
            if isinstance(outcome, FailedTrial):
                failed, problem = failed + outcome.is_from_external_calibrator, outcome.reason
                done.append(None)
            else:
                within = within or _parse_tolerances(given, outcome)
                done.append(outcome)
            progress(1)
            if failed == MAX_EARLY_FAILURES:
                problem = f"the run ended after {failed} failures of the calibrator: {problem}"
                break
    result = RecoveryTrials(tuple(done), mode, within, time.monotonic() - began, problem)
    return Recovery.from_trials(result, seed=seed, allow_unchecked=allow_unchecked)


def _failed_if_parameters_differ_from_first_trial(
    outcome: TrialScore | FailedTrial, earlier_trials: Sequence[TrialScore | None]
) -> TrialScore | FailedTrial:
    """Outcome of a trial, or a failure if its parameters differ from those of the first trial with a result."""
    first_trial = next((other for other in earlier_trials if other is not None), None)
    if (
        first_trial is None
        or isinstance(outcome, FailedTrial)
        or outcome.parameter_names == first_trial.parameter_names
    ):
        return outcome
    differing = sorted({*outcome.parameter_names} ^ {*first_trial.parameter_names})[0]
    reason = f"trial {len(earlier_trials)}: the calibrator gives {differing} only in some of the trials"
    return FailedTrial(reason, is_from_external_calibrator=True)


def _parse_tolerances(tolerance: Mapping[str, str], trial: TrialScore) -> dict[str, RecoveryTolerance]:
    """Tolerances such as ``2 urad``, by parameter, in the units of the parameters in `trial`.

    InputError is raised for a unit of another quantity than the parameter's, such as a length for an angle.
    """
    given_values = {}
    for name, words in tolerance.items():
        if name not in trial.parameter_names:
            raise InputError(f"tolerance '{name}' belongs to none of the parameters {', '.join(trial.parameter_names)}")
        unit = trial.parameter_units[trial.parameter_names.index(name)]
        value = parse_quantity_in_unit(words, unit)
        if value is None or not value > 0:
            raise InputError(f"the tolerance of {name} is '{words}', expected a quantity such as '2 {unit}'")
        given_values[name] = RecoveryTolerance(value, words)
    return given_values


def default_origin_of_true_errors(scenario: Scenario) -> InstrumentErrorOrigin:
    """Origin of the true instrument errors for a scenario: `stated` if it declares any, otherwise `drawn`."""
    return "stated" if any(set(tracker.errors) - {"draw"} for tracker in scenario.trackers_in_use.values()) else "drawn"
