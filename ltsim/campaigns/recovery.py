"""Recovery: is what was injected found again, within the stated uncertainty? A check for continuous integration.

Each trial simulates a recording, calibrates it, and divides the errors of what was found by their stated sigmas.
Which errors the instrument has is one of two modes:

* `drawn`: every parameter from its prior. For a correct model and a correct covariance the z-scores are standard
  normal, priors included.
* `stated`: as the scenario states them (what it draws is drawn). A fixed truth is not what a prior speaks of: an
  estimate leans to the prior's mean and scatters less than its sigma says. Both follow from the covariance: with C in
  prior sigmas and the truth t, an estimate errs by -C t on average, with covariance C - C C; so the errors less that
  mean over that deviation are standard normal too. Besides, the stated intervals have to hold the injected value at
  least as often as they promise.

Mean, standard deviation and coverage are checked on both sides. Chi-square, targets and stations are checked as a
whole. Tolerances are those of the specification (mean within 0.1, standard deviation within 5 %, coverage within
1.5 %), or those of chance where few trials make chance wider: a correct model fails in one run of a hundred.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

from ltsim.arrays import Floats
from ltsim.calibration import Calibration, calibrate_distance, calibrate_network
from ltsim.errors import ConvergenceError, SetupError
from ltsim.model.construction import Construction
from ltsim.recording import Recording
from ltsim.results import Columns, Result, by_row
from ltsim.simulation.fieldwork import fieldwork
from ltsim.simulation.physics import instrument_law
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.simulator import measure
from ltsim.simulation.truth import Truth
from ltsim.workers import parallel

FALSE_ALARM = 0.01
"""Chance that a correct model fails any of the checks."""
COVERED = 0.95
MEAN_WITHIN, SPREAD_WITHIN, COVERAGE_WITHIN = 0.1, 0.05, 0.015
CHI2_WITHIN, WHOLE_WITHIN = 0.02, 0.05
Errors = Literal["drawn", "stated"]
NOISELESS = 1e-4
"""Share of a stated variance under which the error is the prior's, not the noise's."""
ONE_DEGREE = float(np.sqrt(2.0))
"""Standard deviation of a mean square over its mean where all that it averages is one number."""
"""Rounding to the resolution adds a little to the noise that the set-up states."""


@dataclass(frozen=True)
class Trial:
    """Errors over stated sigmas of one calibration."""

    z: Floats
    """(p,): of the parameters."""
    sigma: Floats
    """(p,): stated, as a share of the prior sigma."""
    targets: float
    stations: float
    """Mean square of the errors over sigma of all target coordinates, and of all poses but the first station's; NaN
    where levels or control points define the frame.
    """
    chi2: float
    dof: int
    standard: Floats
    """(p,): z-scores that are standard normal for the truth as it was made, stated or drawn; NaN where noise has no
    part.
    """
    expected: float
    spread: float
    """Mean and standard deviation of chi-square for that truth; NaN where they are not known."""


@dataclass(frozen=True)
class Check:
    """One number that has to lie between two bounds."""

    what: str
    statistic: str
    value: float
    low: float
    high: float

    @property
    def passed(self) -> bool:
        """Within the bounds; NaN fails."""
        return self.low <= self.value <= self.high

    def sentence(self) -> str:
        """What was found and what was allowed."""
        verdict = "passes" if self.passed else "fails"
        return f"{self.what} {verdict}: {self.statistic} {self.value:.3f}, allowed {self.low:.3f} to {self.high:.3f}"


@dataclass(frozen=True, repr=False)
class Recovery(Result):
    """All trials of a recovery check with `errors` drawn or stated; a trial that did not converge is None."""

    names: tuple[str, ...]
    trials: tuple[Trial | None, ...]
    errors: Errors = "drawn"

    def _lines(self) -> list[str]:
        failures = [check.sentence() for check in self.failures()]
        verdict = "fails" if failures else "everything is recovered within its stated uncertainty"
        return [
            f"Recovery, errors {self.errors}: {len(self.trials)} trials, {len(self.converged)} converged: {verdict}",
            *failures,
        ]

    def _tables(self) -> Mapping[str, Callable[[], Columns]]:
        return {"checks": lambda: by_row([vars(check) | {"passed": check.passed} for check in self.checks()])}

    @property
    def converged(self) -> list[Trial]:
        """Trials that converged."""
        return [trial for trial in self.trials if trial is not None]

    @property
    def z(self) -> Floats:
        """(N, p) errors of the parameters over their stated sigmas."""
        return np.stack([trial.z for trial in self.converged])

    def checks(self) -> list[Check]:
        """All checks; bounds are shared out so that a correct model fails any in one run of a hundred."""
        lost = len(self.trials) - len(self.converged)
        found = [Check("convergence", "trials that did not converge", lost, 0, 0)]
        if len(self.converged) < 2:
            return found
        level = FALSE_ALARM / (4 * len(self.names) + 3)
        standard = np.stack([trial.standard for trial in self.converged])
        for i, name in enumerate(self.names):
            if np.all(np.isfinite(standard[:, i])):
                found += parameter_checks(name, standard[:, i], level)
            if self.errors == "stated":
                coverage = parameter_checks(name, self.z[:, i], level)[-1]
                found.append(replace(coverage, statistic=f"{coverage.statistic}, as stated", high=1.0))
        if all(np.isfinite(trial.expected) for trial in self.converged):
            found.append(chi_square_check(self.converged, level))
        for what in ("targets", "stations"):
            squares = np.array([getattr(trial, what) for trial in self.converged])
            if np.all(np.isfinite(squares)):
                found.append(mean_check(what, "mean squared error over variance", squares, level))
        return found

    def failures(self) -> list[Check]:
        """Checks that fail."""
        return [check for check in self.checks() if not check.passed]


def parameter_checks(name: str, z: Floats, level: float) -> list[Check]:
    """Mean, standard deviation and coverage of z-scores (N,); `level` is the false-alarm rate of each."""
    count = len(z)
    shift = max(MEAN_WITHIN, float(stats.norm.isf(level / 2) / np.sqrt(count)))
    tails = stats.chi2.ppf([level / 2, 1 - level / 2], count - 1) / (count - 1)
    inside = stats.binom.ppf([level / 2, 1 - level / 2], count, COVERED) / count
    covered = float(np.mean(np.abs(z) <= stats.norm.isf(0.5 * (1 - COVERED))))
    return [
        Check(name, "mean z-score", float(z.mean()), -shift, shift),
        Check(
            name,
            "standard deviation of the z-scores",
            float(z.std(ddof=1)),
            float(min(1 - SPREAD_WITHIN, np.sqrt(tails[0]))),
            float(max(1 + SPREAD_WITHIN, np.sqrt(tails[1]))),
        ),
        Check(
            name,
            "coverage of 95 % intervals",
            covered,
            float(min(COVERED - COVERAGE_WITHIN, inside[0])),
            float(max(COVERED + COVERAGE_WITHIN, inside[1])),
        ),
    ]


def chi_square_check(trials: Sequence[Trial], level: float) -> Check:
    """Chi-square of all trials together over what is to be expected of it, as a scaled chi-square (Satterthwaite)."""
    mean, variance = sum(trial.expected for trial in trials), sum(trial.spread**2 for trial in trials)
    freedom = 2 * mean**2 / variance
    tails = stats.chi2.ppf([level / 2, 1 - level / 2], freedom) / freedom
    low, high = min(1 - CHI2_WITHIN, float(tails[0])), max(1 + CHI2_WITHIN, float(tails[1]))
    return Check("chi-square", "chi2/dof of all trials", sum(trial.chi2 for trial in trials) / mean, low, high)


def mean_check(what: str, statistic: str, values: Floats, level: float) -> Check:
    """The mean of values (N,), one a trial, against one.

    Chance is judged by their spread relative to their median (median absolute deviation): values that are all too
    large, or a few that are far off, do not make their own limits wider.
    """
    middle = float(np.median(values))
    apart = float(np.median(np.abs(values - middle)))
    relative = min(apart / (stats.norm.ppf(0.75) * middle), ONE_DEGREE) if middle > 0 else ONE_DEGREE
    within = max(WHOLE_WITHIN, float(stats.t.isf(level / 2, len(values) - 1)) * relative / np.sqrt(len(values)))
    return Check(what, statistic, float(values.mean()), max(1 - within, 0.0), 1 + within)


def recover(
    scenario: Scenario,
    trials: int,
    *,
    seed: int = 0,
    jobs: int = 1,
    method: str = "network",
    construction: Construction | None = None,
    errors: Errors = "drawn",
) -> Iterator[Trial | None]:
    """Run the trials one by one, in order; the same for any number of jobs.

    Parameters
    ----------
    scenario : Scenario
    trials, seed, jobs : int
    method : str
        `network`, `distance` or `distance-l1`.
    construction : Construction, optional
        Of the calibrator; default that of the simulated instrument.
    errors : str
        `drawn` from the prior whatever the scenario says of them, or as it has them `stated`.

    Raises
    ------
    SetupError
        When the calibrator's parameters are not among those that are drawn.
    """
    made = from_prior(scenario) if errors == "drawn" else scenario
    work = ((made, seed, index, method, construction) for index in range(trials))
    return parallel(run_trial, work, min(jobs, trials), batch=4)


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


def run_trial(
    scenario: Scenario, seed: int, index: int, method: str, construction: Construction | None
) -> Trial | None:
    """One trial; None where the calibration did not converge."""
    key = ("recover", index)
    work = fieldwork(scenario, seed, *key)
    recording, truth = measure(work, seed, *key)
    try:
        found = calibrated(recording, method, construction or work.construction)
    except ConvergenceError:
        return None
    law = instrument_law(work.scenario, work.construction)
    names = work.construction.names_of(tuple(work.scenario.trackers))
    return score(found, truth, dict(zip(names, zip(*(x.ravel() for x in law), strict=True), strict=True)))


def calibrated(recording: Recording, method: str, construction: Construction) -> Calibration:
    """Calibrate by one of the methods."""
    if method == "network":
        return calibrate_network(recording, construction, advise=False, weigh=False)
    return calibrate_distance(recording, construction, method=method, advise=False)


def score(found: Calibration, truth: Truth, law: Mapping[str, tuple[float, float]]) -> Trial:
    """Errors of a calibration over their stated sigmas.

    Parameters
    ----------
    found : Calibration
    truth : Truth
    law : mapping of str to (float, float)
        Mean and standard deviation [SI] from which each true parameter was drawn; 0 for a stated one.

    Raises
    ------
    SetupError
        When the truth does not hold all of the calibration's parameters.
    """
    unknown = [name for name in found.names if name not in truth.instrument]
    if unknown:
        raise SetupError(
            f"the calibrator's parameter {unknown[0]} is not one that the simulated instrument "
            f"({truth.construction}) has; recover with its own construction"
        )
    true = np.array([truth.instrument[name] for name in found.names])
    prior = found.prior_sigma.ravel()
    mean, drawn = (np.array([law[name][i] for name in found.names]) / prior for i in (0, 1))
    error, stated = (found.values.ravel() - true) / prior, found.sigma.ravel() / prior
    left = stated**2 - found.missed**2 @ (1.0 - drawn**2)
    noisy = left > NOISELESS * stated**2
    standard = np.where(noisy, (error + found.missed @ mean) / np.sqrt(np.where(noisy, left, 1.0)), np.nan)
    targets, stations = _network_scores(found, truth, mean, drawn)
    return Trial(
        error / stated, stated, targets, stations, found.fit.chi2, found.fit.dof, standard, *_chi2(found, mean, drawn)
    )


def _chi2(found: Calibration, mean: Floats, drawn: Floats) -> tuple[float, float]:
    """Mean and standard deviation of chi-square with truths of a mean and a spread (p,) [prior sigmas]."""
    dof, sigma = found.fit.dof, found.fit.chi2_sigma
    if found.method != "network":
        return (dof, sigma) if _as_the_prior(mean, drawn) and sigma is not None else (np.nan, np.nan)
    told = np.eye(len(mean)) - found.missed
    lean = float(mean @ told @ mean)
    return dof + lean - float(np.diag(told) @ (1.0 - drawn**2)), float(np.sqrt(2 * dof + 4 * lean))


def _as_the_prior(mean: Floats, drawn: Floats) -> bool:
    """Whether truths of a mean and a spread (p,) [prior sigmas] are drawn from the prior."""
    return not np.any(mean) and bool(np.all(drawn == 1.0))


def _network_scores(found: Calibration, truth: Truth, mean: Floats, drawn: Floats) -> tuple[float, float]:
    """Mean square of error over sigma of targets and poses, where the first station is held; NaN in another frame.

    Both as they are to be expected of truths of a mean and a spread (p,) [prior sigmas]; of stated ones for the network
    method alone.
    """
    adjustment, plain = found.adjustment, _as_the_prior(mean, drawn)
    unknown = found.method != "network" and not plain
    if adjustment is None or unknown or adjustment.problem.free.shape[1] < 6:
        return float("nan"), float("nan")
    # The truth moved to where the first station is held.
    held, origin = adjustment.state, truth.position[0]
    turn = truth.rotation[0] @ held.rotation[0].T
    unknowns, size = adjustment.problem.unknowns, np.zeros(adjustment.problem.unknowns.size)
    bias, less = size.copy(), size.copy()
    if not plain:
        pick = np.zeros((len(size), len(mean)))
        pick[unknowns.instrument.ravel(), np.arange(len(mean))] = 1.0 / found.prior_sigma.ravel()
        missed = adjustment.factor.covariance_columns(pick)
        bias, less = -missed @ mean, missed**2 @ (1.0 - drawn**2)
    points = (truth.points - origin) @ turn + held.position[0]
    variance = np.einsum("tii->ti", found.target_covariance) - less[unknowns.target]
    targets = float(np.mean((found.points - points - bias[unknowns.target]) ** 2 / variance))
    squares = []
    for i, station in enumerate(found.stations[1:], start=1):
        there = (truth.position[i] - origin) @ turn + held.position[0]
        apart = Rotation.from_quat(station.quaternion) * Rotation.from_matrix(turn.T @ truth.rotation[i]).inv()
        error = np.concatenate([station.position - there, apart.as_rotvec()]) - bias[unknowns.pose[i]]
        sigma = np.concatenate([station.sigma_position, station.sigma_rotation])
        squares.append(error**2 / (sigma**2 - less[unknowns.pose[i]]))
    return targets, float(np.mean(squares)) if squares else float("nan")
