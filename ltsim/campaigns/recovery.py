"""Recovery: is what was injected found again, within the stated uncertainty? A check for continuous integration.

Each trial simulates a recording (`lt.simulate(..., trial=N, geometry="per-trial")`), has it calibrated, by ltsim or by
a calibrator of one's own, and divides the errors of what was found by their stated sigmas.
Which errors the instrument has is one of two modes:

* `drawn`: every parameter from its prior. For a correct model and a correct covariance the z-scores are standard
  normal, priors included.
* `stated`: as the scenario states them (what it draws is drawn). A fixed truth is not what a prior speaks of: an
  estimate leans to the prior's mean and scatters less than its sigma says. Both follow from the covariance: with C in
  prior sigmas and the truth t, an estimate errs by -C t on average, with covariance C - C C; so the errors less that
  mean over that deviation are standard normal too. Besides, the stated intervals have to hold the injected value at
  least as often as they promise.

A calibrator of one's own is not known to use a prior: with drawn errors its z-scores are to be standard normal, with
stated ones its intervals have to hold them. Chi-square, targets and stations are checked of ltsim's own alone.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy import stats

from ltsim.arrays import Floats
from ltsim.calibration.beside import Wanted
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.distance import calibrate_distance
from ltsim.calibration.network import calibrate_network
from ltsim.calibration.verbs import wanted
from ltsim.campaigns.recovery_checks import (
    COVERED,
    FALSE_ALARM,
    chi_square_check,
    mean_check,
    parameter_checks,
    tolerance_check,
)
from ltsim.campaigns.schema import CHECKS, TRIALS, Errors, RecoveryCheck
from ltsim.campaigns.scoring import Calibrator, Trial, checked_command, estimates_by, score, score_estimates
from ltsim.effects.effect import Effect
from ltsim.effects.verbs import each_of
from ltsim.errors import ConvergenceError, LtsimError, SetupError, option, unknown_name
from ltsim.model.construction import Construction, construction as construction_called
from ltsim.recording import Recording
from ltsim.results import Columns, Result, Table
from ltsim.simulation.fieldwork import fieldwork
from ltsim.simulation.physics import construction_of, instrument_law
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.simulator import measure, place_key
from ltsim.simulation.verbs import ScenarioSource, scenario as scenario_of, simulate
from ltsim.units import in_unit
from ltsim.workers import parallel


class RecoveryTolerance(NamedTuple):
    """What an error may be: in the parameter's unit, and as it was given."""

    value: float
    words: str


@dataclass(frozen=True, repr=False)
class Recovery(Result):
    """All trials of a recovery check with `errors` drawn or stated; a trial that gave no result is None."""

    trials: tuple[Trial | None, ...]
    errors: Errors = "drawn"
    tolerance: Mapping[str, RecoveryTolerance] = field(default_factory=dict)
    """By parameter; only these are checked, if there are any."""
    seconds: float = 0.0
    """How long the trials took."""

    def _lines(self) -> list[str]:
        failures = [check.sentence() for check in self.failures()]
        verdict = "fails" if failures else f"everything is recovered within {self.what}"
        return [
            f"Recovery, errors {self.errors}: {len(self.trials)} trials, {len(self.converged)} converged: {verdict}",
            *failures,
        ]

    @property
    def what(self) -> str:
        """Within what everything is to be recovered."""
        return "the given tolerances" if self.tolerance else "its stated uncertainty"

    def _tables(self) -> Mapping[str, Callable[[], Table | Columns]]:
        return {
            "checks": lambda: CHECKS.filled(self.checks()),
            "parameters": self.parameters,
            "trials": lambda: TRIALS.filled(self.rows()),
        }

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters."""
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
        """One row a trial and parameter, in its unit: `trials.csv`."""
        return [
            {"trial": number, "parameter": name, "unit": trial.units[k], "truth": trial.truth[k],
             "estimate": trial.estimate[k], "sigma": trial.sigma[k], "z": trial.z[k],
             "ltsim_estimate": None if trial.other is None else trial.other.estimate[k]}
            for number, trial in enumerate(self.trials)
            if trial is not None
            for k, name in enumerate(trial.names)
        ]  # fmt: skip

    def parameters(self) -> Columns:
        """What became of each parameter, beside ltsim's own calibrator where another one is checked."""
        error, z = self._stacked("estimate") - self._stacked("truth"), self.z
        columns: dict[str, Sequence[object]] = {
            "parameter": self.names,
            "unit": self.converged[0].units,
            "rms_error": np.sqrt(np.mean(error**2, axis=0)).tolist(),
            "mean_z": z.mean(axis=0).tolist(),
            "deviation_z": z.std(axis=0, ddof=1).tolist(),
            "coverage_95": np.mean(np.abs(z) <= stats.norm.isf(0.5 * (1 - COVERED)), axis=0).tolist(),
        }
        if self.converged[0].other is None:
            return columns
        own = np.stack([t.other.estimate - t.truth for t in self.converged if t.other is not None])
        gap, count = np.abs(error[: len(own)]) - np.abs(own), len(own)
        half = stats.t.isf(0.025, count - 1) * gap.std(axis=0, ddof=1) / np.sqrt(count)
        return columns | {
            "ltsim_rms_error": np.sqrt(np.mean(own**2, axis=0)).tolist(),
            "larger_than_ltsim": gap.mean(axis=0).tolist(),
            "larger_low": (gap.mean(axis=0) - half).tolist(),
            "larger_high": (gap.mean(axis=0) + half).tolist(),
        }

    def checks(self) -> list[RecoveryCheck]:
        """All checks; bounds are shared out so that a correct model fails any in one run of a hundred."""
        lost = len(self.trials) - len(self.converged)
        found = [RecoveryCheck.of("convergence", "trials that did not converge", lost, 0, 0)]
        if len(self.converged) < 2:
            return found
        chosen = [k for k, name in enumerate(self.names) if not self.tolerance or name in self.tolerance]
        level = FALSE_ALARM / (4 * len(chosen) + 3)
        standard, z = self._stacked("standard"), self.z
        error = self._stacked("estimate") - self._stacked("truth")
        for k in chosen:
            name = self.names[k]
            if np.all(np.isfinite(standard[:, k])):
                found += parameter_checks(name, standard[:, k], level)
            if self.errors == "stated" and np.all(np.isfinite(z[:, k])):
                coverage = parameter_checks(name, z[:, k], level)[-1]
                said = f"{coverage.statistic}, as stated"
                found.append(RecoveryCheck.of(name, said, coverage.value or 0.0, coverage.low, 1.0))
            if self.tolerance:
                given = self.tolerance[name]
                found.append(tolerance_check(name, error[:, k], given.value, given.words))
        return found if self.tolerance else found + self._whole(level)

    def _whole(self, level: float) -> list[RecoveryCheck]:
        parts, found = [trial.network for trial in self.converged], []
        if all(np.isfinite(part.expected) for part in parts):
            chi2, expected, spread = (np.array([getattr(p, n) for p in parts]) for n in ("chi2", "expected", "spread"))
            found.append(chi_square_check(chi2, expected, spread, level))
        for what in ("targets", "stations"):
            squares = np.array([getattr(part, what) for part in parts])
            if np.all(np.isfinite(squares)):
                found.append(mean_check(what, "mean squared error over variance", squares, level))
        return found

    def failures(self) -> list[RecoveryCheck]:
        """Checks that fail."""
        return [check for check in self.checks() if not check.passed]


@dataclass(frozen=True)
class How:
    """By what a recording is calibrated: ltsim's own method, or a calibrator of one's own beside it."""

    method: str = "network"
    construction: Construction | None = None
    extra_effects: tuple[Wanted, ...] = ()
    calibrator: Calibrator | None = None
    errors: Errors = "drawn"
    """Whether instruments have errors from the prior, or as the scenario states them."""


def recover(
    source: ScenarioSource,
    *,
    trials: int = 200,
    method: str = "network",
    construction: str | None = None,
    with_effects: str | Effect | Sequence[str | Effect] = (),
    calibrator: Calibrator | None = None,
    tolerance: Mapping[str, str] | None = None,
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
        How many recordings to simulate.
    method, with_effects
        Of ltsim's calibrator, as of `calibrate`.
    construction : str, optional
        Of ltsim's calibrator; by default that of the scenario.
    calibrator : callable or str, optional
        One of your own, checked beside ltsim's: a command ``CMD {recording} {out}`` that reads a recording and writes
        parameters as JSON; in Python also a function that takes a recording and gives value, sigma (or None) and unit
        of each parameter by name. Effects are named ``head-sag:sag``.
    tolerance : mapping of str to str, optional
        Within which 95 % of a parameter's errors should lie, as `2 urad` for `beam-tilt`; only such parameters are
        checked then.
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
        `failures()` lists the checks that fail; a correct model fails any in one run of a hundred.

    Examples
    --------
    >>> import ltsim as lt
    >>> lt.recover("paper-workshop", trials=12).failures()
    []
    """
    if trials < 1:
        raise SetupError(f"{option('trials')} is {trials}, expected 1 or more")
    scenario, given = scenario_of(source), tolerance or {}
    own, mode = construction_of(scenario), errors or errors_of(scenario)
    if own.name == "dh" and construction not in (None, "dh"):
        raise SetupError(f"the scenario's instrument is a dh one: recover with {option('construction')} dh")
    if mode not in ("drawn", "stated"):
        raise unknown_name("mode of errors", mode, ("drawn", "stated"))
    if isinstance(calibrator, str):
        checked_command(calibrator)
    elif calibrator is not None:
        jobs = 1
    named = each_of(with_effects)
    seen = simulate(scenario, seed=seed).recording if named else None
    extra_effects = tuple(wanted(text, seen) for text in named if seen is not None)
    built = own if construction is None else construction_called(construction)
    how = How(method, built, extra_effects, calibrator, mode)
    began, found, within = time.monotonic(), [], dict[str, RecoveryTolerance]()
    for trial in run_trials(scenario, trials, how, seed=seed, jobs=jobs):
        if trial is not None:
            within = within or _within(given, trial)
        found.append(trial)
        progress(1)
    return Recovery(tuple(found), mode, within, time.monotonic() - began)


def run_trials(scenario: Scenario, trials: int, how: How, *, seed: int = 0, jobs: int = 1) -> Iterator[Trial | None]:
    """Run the trials one by one, in order; the same for any number of jobs.

    Raises SetupError when the calibrator's parameters are not among those that are drawn.
    """
    made = from_prior(scenario) if how.errors == "drawn" else scenario
    work = ((made, seed, index, how) for index in range(trials))
    return parallel(run_trial, work, min(jobs, trials), batch=4)


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


def from_prior(scenario: Scenario) -> Scenario:
    """The scenario with instruments whose errors are drawn from the priors that the calibrator will use."""
    drawn = {"errors": {"draw": True}, "error_factor": 1.0}
    named = {name: tracker.model_copy(update=drawn) for name, tracker in scenario.instruments.items()}
    return scenario.model_copy(
        update={"instrument": scenario.instrument.model_copy(update=drawn), "instruments": named}
    )


def run_trial(scenario: Scenario, seed: int, index: int, how: How) -> Trial | None:
    """One trial; None where the calibration gave no result."""
    work = fieldwork(scenario, seed, *place_key(index, "per-trial"))
    recording, truth = measure(work, seed, index)
    law = instrument_law(work.scenario, work.construction)
    names = work.construction.names_of(tuple(work.scenario.trackers))
    laws = dict(zip(names, zip(*(x.ravel() for x in law), strict=True), strict=True))
    try:
        found = calibrated(recording, how, how.construction or work.construction)
        own = score(found, truth, laws)
    except (ConvergenceError, LtsimError) as problem:
        if how.calibrator is None and not isinstance(problem, ConvergenceError):
            raise
        own = None
    if how.calibrator is None:
        return own
    estimates = estimates_by(how.calibrator, recording, f"trial {index}")
    return None if estimates is None else score_estimates(estimates, truth, how.errors, own)


def calibrated(recording: Recording, how: How, construction: Construction) -> Calibration:
    """Calibrate by one of ltsim's methods."""
    if how.method == "network":
        return calibrate_network(recording, construction, advise=False, weigh=False, extra_effects=how.extra_effects)
    return calibrate_distance(recording, construction, method=how.method, advise=False)
