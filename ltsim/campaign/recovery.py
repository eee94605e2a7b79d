"""Recovery: is what was injected found again, within the stated uncertainty? A check for continuous integration.

Each trial simulates a recording, calibrates it, and divides the errors of what was found by their stated sigmas.
Which errors the instrument has is one of two modes:

* `drawn`: every parameter from its prior. For a correct model and a correct covariance the z-scores are standard
  normal, priors included: mean, standard deviation and coverage are checked on both sides.
* `stated`: as the scenario states them (what it draws is drawn). A fixed truth is not what a prior speaks of: an
  estimate leans to the prior's mean and scatters less than its sigma says. So the intervals have to hold the injected
  value at least as often as they promise, and the z-scores may not scatter more.

Chi-square, targets and stations are checked as a whole. Tolerances are those of the specification (mean within 0.1,
standard deviation within 5 %, coverage within 1.5 %), or those of chance where few trials make chance wider: a correct
model fails in one run of a hundred.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

from ltsim.arrays import Bools, Floats
from ltsim.calibrate import Calibration, calibrate_distance, calibrate_network
from ltsim.errors import ConvergenceError, SetupError
from ltsim.model.construction import Construction
from ltsim.notebook import Columns, Shown, by_row
from ltsim.recording import Recording
from ltsim.simulate.fieldwork import fieldwork
from ltsim.simulate.scenario import Scenario
from ltsim.simulate.simulator import measure
from ltsim.simulate.truth import Truth
from ltsim.workers import parallel

FALSE_ALARM = 0.01
"""Chance that a correct model fails any of the checks."""
COVERED = 0.95
MEAN_WITHIN, SPREAD_WITHIN, COVERAGE_WITHIN = 0.1, 0.05, 0.015
CHI2_WITHIN, WHOLE_WITHIN = 0.02, 0.05
Errors = Literal["drawn", "stated"]
ONE_DEGREE = float(np.sqrt(2.0))
"""Standard deviation of a mean square over its mean where all that it averages is one number."""
"""Rounding to the resolution adds a little to the noise that the set-up states."""


@dataclass(frozen=True)
class Trial:
    """Errors over stated sigmas of one calibration.

    Attributes
    ----------
    z : (p,) float
        Of the parameters.
    sigma : (p,) float
        Stated, as a share of the prior sigma.
    targets, stations : float
        Mean square of the errors over sigma of all target coordinates, and of all poses but the first station's; NaN
        where levels or control points define the frame.
    chi2 : float
    dof : int
    leaning : float
        What a truth that was not drawn from the prior adds to the chi-square to expect.
    """

    z: Floats
    sigma: Floats
    targets: float
    stations: float
    chi2: float
    dof: int
    leaning: float = 0.0


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
class Recovery(Shown):
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
        level = FALSE_ALARM / (3 * len(self.names) + 3)
        check = parameter_checks if self.errors == "drawn" else stated_checks
        found += [c for i, name in enumerate(self.names) for c in check(name, self.z[:, i], level)]
        found.append(chi_square_check(self.converged, level))
        for what in ("targets", "stations"):
            squares = np.array([getattr(trial, what) for trial in self.converged])
            if np.all(np.isfinite(squares)):
                whole = mean_check(what, "mean squared error over variance", squares, level)
                found.append(whole if self.errors == "drawn" else replace(whole, low=0.0))
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


def stated_checks(name: str, z: Floats, level: float) -> list[Check]:
    """Spread and coverage of z-scores (N,) around a truth that was not drawn: at most, and at least."""
    _, spread, coverage = parameter_checks(name, z, level)
    return [replace(spread, low=0.0), replace(coverage, high=1.0)]


def chi_square_check(trials: Sequence[Trial], level: float) -> Check:
    """Chi-square of all trials together over what is to be expected of it."""
    dof, leaning = sum(trial.dof for trial in trials), sum(trial.leaning for trial in trials)
    tails = stats.chi2.ppf([level / 2, 1 - level / 2], dof) / dof
    low, high = min(1 - CHI2_WITHIN, float(tails[0])), max(1 + CHI2_WITHIN, float(tails[1]))
    found = sum(trial.chi2 for trial in trials) / (dof + leaning)
    return Check("chi-square", "chi2/dof of all trials", found, low, high)


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
    """The mode that a scenario suggests: `stated` where it states an error of the instrument."""
    return "stated" if set(scenario.instrument.errors) - {"draw"} else "drawn"


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
    return score(found, truth, fixed_errors(work.scenario))


def fixed_errors(scenario: Scenario) -> Callable[[str], bool]:
    """Whether a parameter of the instrument is not drawn, by its name."""
    stated, draws = set(scenario.instrument.errors), scenario.instrument.draws
    return lambda name: not draws or name in stated


def calibrated(recording: Recording, method: str, construction: Construction) -> Calibration:
    """Calibrate by one of the methods."""
    if method == "network":
        return calibrate_network(recording, construction, advise=False, weigh=False)
    return calibrate_distance(recording, construction, method=method, advise=False)


def score(found: Calibration, truth: Truth, fixed: Callable[[str], bool] = lambda name: False) -> Trial:
    """Errors of a calibration over their stated sigmas; parameters that are `fixed` were not drawn from their prior.

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
    targets, stations = _network_scores(found, truth)
    return Trial(
        z=(found.values.ravel() - true) / found.sigma.ravel(),
        sigma=(found.sigma / found.prior_sigma).ravel(),
        targets=targets,
        stations=stations,
        chi2=found.fit.chi2,
        dof=found.fit.dof,
        leaning=_leaning(found, true, np.array([fixed(name) for name in found.names])),
    )


def _leaning(found: Calibration, true: Floats, fixed: Bools) -> float:
    """Expected chi-square with parameters fixed at their true values (p,), less that with all drawn from the prior.

    With C the covariance in prior sigmas and u the fixed values: u' (1 - C) u less the trace of (1 - C) over them.
    """
    if found.method != "network" or not fixed.any():
        return 0.0
    prior = found.prior_sigma[0]
    told = (np.eye(len(prior)) - found.covariance / np.outer(prior, prior))[np.ix_(fixed, fixed)]
    size = true[fixed] / prior[fixed]
    return float(size @ told @ size - np.trace(told))


def _network_scores(found: Calibration, truth: Truth) -> tuple[float, float]:
    """Mean square of error over sigma of targets and poses, where the first station is held; NaN in another frame."""
    adjustment = found.adjustment
    if adjustment is None or adjustment.problem.free.shape[1] < 6:
        return float("nan"), float("nan")
    # The truth moved to where the first station is held.
    held, origin = adjustment.state, truth.position[0]
    turn = truth.rotation[0] @ held.rotation[0].T
    points = (truth.points - origin) @ turn + held.position[0]
    sigma = np.sqrt(np.einsum("tii->ti", found.target_covariance))
    targets = float(np.mean(((found.points - points) / sigma) ** 2))
    squares = []
    for i, station in enumerate(found.stations[1:], start=1):
        there = (truth.position[i] - origin) @ turn + held.position[0]
        moved = (station.position - there) / station.sigma_position
        apart = Rotation.from_quat(station.quaternion) * Rotation.from_matrix(turn.T @ truth.rotation[i]).inv()
        squares += [moved**2, (apart.as_rotvec() / station.sigma_rotation) ** 2]
    return targets, float(np.mean(squares)) if squares else float("nan")
