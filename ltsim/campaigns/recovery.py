"""Recovery of injected errors within their declared uncertainty: a check for continuous integration.

Each trial simulates a recording (`lt.simulate(..., trial=N, geometry="per-trial")`), has it calibrated, by ltsim or by
a foreign calibrator, and divides the errors of the estimates by their declared sigmas.
Which errors the instrument has is one of two modes:

* `drawn`: every parameter from its prior. For a correct model and a correct covariance the z-scores are standard
  normal, priors included.
* `stated`: as the scenario declares them (drawn entries are drawn). With a fixed truth the prior biases the estimate
  towards its mean and narrows its scatter. Both follow from the covariance: with C in prior sigmas and the truth t, the
  mean error is -C t and its covariance C - C C, so errors reduced by that mean and divided by that deviation are
  standard normal too. In addition, the declared intervals have to contain the injected value at least as often as they
  promise.

The prior of a foreign calibrator is unknown: with drawn errors its z-scores have to be standard normal; with stated
ones their mean has to be 0, their spread at most 1, and its intervals have to contain the truth. A parameter that has
neither sigmas nor a tolerance is not checked, and a run with such a parameter does not pass unless that is allowed.
Chi-square, targets and stations are checked of ltsim's calibrator alone.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy import stats

from ltsim.calibration.verbs import requested_effect
from ltsim.campaigns.recovery_checks import (
    COVERED,
    FALSE_ALARM,
    FEWEST,
    chi_square_check,
    fixed_truth_checks,
    mean_check,
    parameter_checks,
    tolerance_check,
)
from ltsim.campaigns.recovery_trials import FailedTrial, How, run_trials
from ltsim.campaigns.schema import CHECKS, TRIALS, Errors, RecoveryCheck
from ltsim.campaigns.scoring import Calibrator, Trial, checked_command
from ltsim.core.arguments import check_bounds
from ltsim.core.arrays import Floats
from ltsim.core.errors import RecordError, SetupError, option, unknown_name
from ltsim.core.results import Columns, Result, Table
from ltsim.core.units import in_unit
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.verbs import each_of
from ltsim.physics.model.construction import construction as construction_called
from ltsim.simulation.physics import construction_of
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.verbs import ScenarioSource, scenario as scenario_of, simulate

MOST_FAILURES = 3
"""Trials in which a foreign calibrator may end without a result before the run ends: a command that cannot work
fails at once, and the check of convergence fails with the first."""


class RecoveryTolerance(NamedTuple):
    """Largest permitted error: in the parameter's unit, and as it was given."""

    value: float
    words: str


@dataclass(frozen=True, repr=False)
class Recovery(Result):
    """All trials of a recovery check with `errors` drawn or stated; a trial that gave no result is None."""

    trials: tuple[Trial | None, ...]
    errors: Errors = "drawn"
    tolerance: Mapping[str, RecoveryTolerance] = field(default_factory=dict)
    """Tolerance by parameter; only these parameters are checked, if there are any."""
    seconds: float = 0.0
    """Duration of the trials [s]."""
    problem: str = ""
    """Reason of the failure of the last trial without a result."""
    allow_unchecked: bool = False
    """Parameters that nothing is checked of do not keep the run from passing."""

    def _lines(self) -> list[str]:
        return [
            f"Recovery, errors {self.errors}: {len(self.trials)} trials, {len(self.converged)} converged: "
            f"{self.verdict()}",
            *self.problems(),
        ]

    @property
    def passed(self) -> bool:
        """True where all checks pass and no parameter is without one, unless that is allowed."""
        return not self.failures() and (self.allow_unchecked or not self.unchecked())

    def verdict(self) -> str:
        """The result in a few words."""
        unchecked = self.unchecked()
        if self.failures():
            return "the check fails"
        if not unchecked:
            return f"everything is recovered within {self.what}"
        checked = len(self.names) - len(unchecked)
        if not checked:
            return "no parameter is checked"
        return f"{checked} of {len(self.names)} parameters are recovered within {self.what}, the others are not checked"

    def problems(self) -> list[str]:
        """Sentences about all that keeps the run from passing, and about parameters that are not checked."""
        sentences = [check.sentence() for check in self.failures()]
        if self.problem and len(self.converged) < len(self.trials):
            sentences.insert(1, self.problem)
        if unchecked := self.unchecked():
            example = f"{option('tolerance')} {unchecked[0]}='2 {self.converged[0].units[0]}'"
            sentences.append(
                f"{', '.join(unchecked)} {'is' if len(unchecked) == 1 else 'are'} not checked: the calibrator declares "
                f"no sigma in every trial; declare one, or give a tolerance such as {example}, "
                f"or take {option('allow_unchecked=True')}"
            )
        return sentences

    def unchecked(self) -> tuple[str, ...]:
        """Parameters that nothing is checked of: neither a sigma in each trial nor a tolerance."""
        if self.tolerance or not self.converged:
            return ()
        judged = np.all(np.isfinite(self.z), axis=0)
        return tuple(name for name, checked in zip(self.names, judged, strict=True) if not checked)

    @property
    def what(self) -> str:
        """Limits within which everything is to be recovered."""
        return "the given tolerances" if self.tolerance else "its stated uncertainty"

    def _tables(self) -> Mapping[str, Callable[[], Table | Columns]]:
        return {
            "checks": lambda: CHECKS.filled(self.checks()),
            "parameters": self.parameters,
            "trials": lambda: TRIALS.filled(self.rows()),
        }

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.converged[0].names if self.converged else ()

    @property
    def converged(self) -> list[Trial]:
        """Trials that gave a result."""
        return [trial for trial in self.trials if trial is not None]

    def _stacked(self, what: str) -> Floats:
        return np.stack([getattr(trial, what) for trial in self.converged])

    @property
    def z(self) -> Floats:
        """(N, p) errors of the parameters over their stated sigmas."""
        return self._stacked("z")

    def rows(self) -> list[dict[str, object]]:
        """Rows of `trials.csv`, one per trial and parameter, in the parameter's unit."""
        return [
            {"trial": number, "parameter": name, "unit": trial.units[k], "truth": trial.truth[k],
             "estimate": trial.estimate[k], "sigma": trial.sigma[k], "z": trial.z[k],
             "ltsim_estimate": None if trial.other is None else trial.other.estimate[k]}
            for number, trial in enumerate(self.trials)
            if trial is not None
            for k, name in enumerate(trial.names)
        ]  # fmt: skip

    def parameters(self) -> Columns:
        """Statistics of each parameter's errors, with those of ltsim's calibrator where a foreign one is checked."""
        if len(self.converged) < FEWEST:
            return {"parameter": self.names}
        error, z = self._stacked("estimate") - self._stacked("truth"), self.z
        columns: dict[str, Sequence[object]] = {
            "parameter": self.names,
            "unit": self.converged[0].units,
            "rms_error": np.sqrt(np.mean(error**2, axis=0)).tolist(),
            "mean_z": z.mean(axis=0).tolist(),
            "deviation_z": z.std(axis=0, ddof=1).tolist(),
            "coverage_95": np.mean(np.abs(z) <= stats.norm.isf(0.5 * (1 - COVERED)), axis=0).tolist(),
        }
        both = [k for k, trial in enumerate(self.converged) if trial.other is not None]
        if len(both) < FEWEST:
            return columns
        reference = np.stack([t.other.estimate - t.truth for t in self.converged if t.other is not None])
        gap, count = np.abs(error[both]) - np.abs(reference), len(both)
        half = stats.t.isf(0.025, count - 1) * gap.std(axis=0, ddof=1) / np.sqrt(count)
        return columns | {
            "ltsim_rms_error": np.sqrt(np.mean(reference**2, axis=0)).tolist(),
            "larger_than_ltsim": gap.mean(axis=0).tolist(),
            "larger_low": (gap.mean(axis=0) - half).tolist(),
            "larger_high": (gap.mean(axis=0) + half).tolist(),
        }

    def checks(self) -> list[RecoveryCheck]:
        """All checks; bounds are shared out so that a correct model fails any in one run of a hundred."""
        lost = len(self.trials) - len(self.converged)
        checks = [RecoveryCheck.of("convergence", "trials that did not converge", lost, 0, 0)]
        if len(self.converged) < FEWEST:
            return checks
        chosen = [k for k, name in enumerate(self.names) if not self.tolerance or name in self.tolerance]
        level = FALSE_ALARM / (4 * len(chosen) + 3)
        checks += [check for k in chosen for check in self._of_parameter(k, level)]
        return checks if self.tolerance else checks + self._whole(level)

    def _of_parameter(self, k: int, level: float) -> list[RecoveryCheck]:
        """Checks of a parameter; z-scores are checked where every trial has one."""
        name, standard, z = self.names[k], self._stacked("standard")[:, k], self.z[:, k]
        foreign, checks = self.converged[0].foreign, list[RecoveryCheck]()
        if np.all(np.isfinite(standard)):
            checks += parameter_checks(name, standard, level)
        if self.errors == "stated" and np.all(np.isfinite(z)):
            mean, spread, coverage = fixed_truth_checks(name, z, level)
            checks += [mean, spread] if foreign else []  # of ltsim's own the standardised z-scores say both
            checks.append(coverage)
        if self.tolerance:
            given = self.tolerance[name]
            error = self._stacked("estimate")[:, k] - self._stacked("truth")[:, k]
            checks.append(tolerance_check(name, error, given.value, given.words))
        return checks

    def _whole(self, level: float) -> list[RecoveryCheck]:
        parts, checks = [trial.network for trial in self.converged], []
        if all(np.isfinite(part.expected) for part in parts):
            chi2, expected, spread = (np.array([getattr(p, n) for p in parts]) for n in ("chi2", "expected", "spread"))
            checks.append(chi_square_check(chi2, expected, spread, level))
        for what in ("targets", "stations"):
            squares = np.array([getattr(part, what) for part in parts])
            if np.all(np.isfinite(squares)):
                checks.append(mean_check(what, "mean squared error over variance", squares, level))
        return checks

    def failures(self) -> list[RecoveryCheck]:
        """Checks that fail."""
        return [check for check in self.checks() if not check.passed]


def recover(
    source: ScenarioSource,
    *,
    trials: int = 200,
    method: str = "network",
    construction: str | None = None,
    with_effects: str | Effect | Sequence[str | Effect] = (),
    calibrator: Calibrator | None = None,
    tolerance: Mapping[str, str] | None = None,
    allow_unchecked: bool = False,
    errors: Errors | None = None,
    seed: int = 0,
    jobs: int = 1,
    progress: Callable[[int], None] = lambda trials: None,
) -> Recovery:
    """Make an instrument with errors, measure, calibrate, compare with the truth; many times.

    Parameters
    ----------
    source : Scenario, str or Path
    trials : int
        How many recordings to simulate, at least two.
    method, with_effects
        Of ltsim's calibrator, as of `calibrate`.
    construction : str, optional
        Of ltsim's calibrator; by default that of the scenario.
    calibrator : callable or str, optional
        One of your own, checked beside ltsim's: a command ``CMD {recording} {out}`` that reads a recording and writes
        parameters as JSON; in Python also a function that takes a recording and gives value, sigma (or None) and unit
        of each parameter by name. Effects are named ``head-sag:sag``. Three trials without a result end the run.
    tolerance : mapping of str to str, optional
        Within which 95 % of a parameter's errors should lie, as `2 urad` for `beam-tilt`; only such parameters are
        checked then.
    allow_unchecked : bool
        Pass although the calibrator declares no sigma of a parameter and no tolerance is given, so that nothing is
        checked of it.
    errors : {`drawn`, `stated`}, optional
        Errors drawn from the prior, or as the scenario states them; default stated where it does.
    seed : int
        Root of all draws. Trial N is that of `simulate` with this seed and places of its own (`per-trial`).
    jobs : int
        Processes to work with; functions run in this one.
    progress : callable
        Told of every trial that is done.

    Returns
    -------
    Recovery
        `passed`, `problems()`; `failures()` lists the checks that fail; a correct model fails any in one run of a
        hundred.

    Examples
    --------
    >>> import ltsim as lt
    >>> lt.recover("paper-workshop", trials=12).failures()
    []
    """
    check_bounds(trials=trials, seed=seed, jobs=jobs)
    scenario, given = scenario_of(source), tolerance or {}
    true_construction, mode = construction_of(scenario), errors or errors_of(scenario)
    if true_construction.name == "dh" and construction not in (None, "dh"):
        raise SetupError(f"the scenario's instrument is a dh one: recover with {option('construction')} dh")
    if mode not in ("drawn", "stated"):
        raise unknown_name("mode of errors", mode, ("drawn", "stated"))
    if isinstance(calibrator, str):
        checked_command(calibrator)
    elif calibrator is not None:
        jobs = 1
    named = each_of(with_effects)
    example = simulate(scenario, seed=seed).recording if named else None
    extra_effects = tuple(requested_effect(text, example) for text in named if example is not None)
    built = true_construction if construction is None else construction_called(construction)
    how = How(method, built, extra_effects, calibrator, mode)
    began, done, within, problem = time.monotonic(), list[Trial | None](), dict[str, RecoveryTolerance](), ""
    failed = 0
    with closing(run_trials(scenario, trials, how, seed=seed, jobs=jobs)) as outcomes:
        for outcome in outcomes:
            if isinstance(outcome, FailedTrial):
                failed, problem = failed + outcome.foreign, outcome.reason
            else:
                within = within or _within(given, outcome)
                _check_same_parameters(outcome, done)
            done.append(None if isinstance(outcome, FailedTrial) else outcome)
            progress(1)
            if failed == MOST_FAILURES:
                problem = f"the run ended after {failed} failures of the calibrator: {problem}"
                break
    return Recovery(tuple(done), mode, within, time.monotonic() - began, problem, allow_unchecked)


def _check_same_parameters(trial: Trial, before: Sequence[Trial | None]) -> None:
    """Raise RecordError for a trial with other parameters than the first with a result."""
    first = next((other for other in before if other is not None), trial)
    if trial.names != first.names:
        differing = sorted({*trial.names} ^ {*first.names})[0]
        raise RecordError(f"trial {len(before)}: the calibrator gives {differing} in a part of the trials only")


def _within(tolerance: Mapping[str, str], trial: Trial) -> dict[str, RecoveryTolerance]:
    """Tolerances such as ``2 urad`` in the units of a trial's parameters; raises SetupError for another kind."""
    given = {}
    for name, words in tolerance.items():
        if name not in trial.names:
            raise SetupError(f"the tolerance of '{name}' is of none of the parameters {', '.join(trial.names)}")
        unit = trial.units[trial.names.index(name)]
        value = in_unit(words, unit)
        if value is None or not value > 0:
            raise SetupError(f"the tolerance of {name} is '{words}', expected a quantity such as '2 {unit}'")
        given[name] = RecoveryTolerance(value, words)
    return given


def errors_of(scenario: Scenario) -> Errors:
    """The mode that a scenario suggests: `stated` where it states an error of an instrument."""
    return "stated" if any(set(tracker.errors) - {"draw"} for tracker in scenario.trackers.values()) else "drawn"
