"""Recovery: is what was injected found again, within the stated uncertainty? A check for continuous integration.

Each trial draws the instrument's parameters from their priors, simulates a recording, calibrates it, and divides the
errors of what was found by their stated sigmas. For a correct model and a correct covariance these z-scores are
standard normal, priors included: the truth was drawn from them. Three things are checked for every parameter, and
chi-square, targets and stations as a whole.

Tolerances are those of the specification (mean within 0.1, standard deviation within 5 %, coverage within 1.5 %), or
those of chance where few trials make chance wider: a correct model fails in one run of a hundred.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

from ltsim.arrays import Floats
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
    """

    z: Floats
    sigma: Floats
    targets: float
    stations: float
    chi2: float
    dof: int


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
    """All trials of a recovery check; a trial that did not converge is None."""

    names: tuple[str, ...]
    trials: tuple[Trial | None, ...]

    def _lines(self) -> list[str]:
        failures = [check.sentence() for check in self.failures()]
        verdict = "fails" if failures else "everything is recovered within its stated uncertainty"
        return [f"Recovery: {len(self.trials)} trials, {len(self.converged)} converged: {verdict}", *failures]

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
        found += [c for i, name in enumerate(self.names) for c in parameter_checks(name, self.z[:, i], level)]
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
    """Chi-square of all trials together over their degrees of freedom."""
    dof = sum(trial.dof for trial in trials)
    tails = stats.chi2.ppf([level / 2, 1 - level / 2], dof) / dof
    low, high = min(1 - CHI2_WITHIN, float(tails[0])), max(1 + CHI2_WITHIN, float(tails[1]))
    return Check("chi-square", "chi2/dof of all trials", sum(trial.chi2 for trial in trials) / dof, low, high)


def mean_check(what: str, statistic: str, values: Floats, level: float) -> Check:
    """The mean of values (N,), one a trial, against one."""
    error = float(values.std(ddof=1)) / np.sqrt(len(values))
    within = max(WHOLE_WITHIN, float(stats.t.isf(level / 2, len(values) - 1) * error))
    return Check(what, statistic, float(values.mean()), 1 - within, 1 + within)


def recover(
    scenario: Scenario,
    trials: int,
    *,
    seed: int = 0,
    jobs: int = 1,
    method: str = "network",
    construction: Construction | None = None,
) -> Iterator[Trial | None]:
    """Run the trials one by one, in order; the same for any number of jobs.

    Parameters
    ----------
    scenario : Scenario
        Whatever it says of the instrument's errors, they are drawn from the prior.
    trials, seed, jobs : int
    method : str
        `network`, `distance` or `distance-l1`.
    construction : Construction, optional
        Of the calibrator; default that of the simulated instrument.

    Raises
    ------
    SetupError
        When the calibrator's parameters are not among those that are drawn.
    """
    drawn = from_prior(scenario)
    work = ((drawn, seed, index, method, construction) for index in range(trials))
    return parallel(run_trial, work, min(jobs, trials), batch=4)


def from_prior(scenario: Scenario) -> Scenario:
    """The scenario with an instrument whose errors are drawn from the prior that the calibrator will use."""
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
    return score(found, truth)


def calibrated(recording: Recording, method: str, construction: Construction) -> Calibration:
    """Calibrate by one of the methods."""
    if method == "network":
        return calibrate_network(recording, construction, advise=False)
    return calibrate_distance(recording, construction, method=method, advise=False)


def score(found: Calibration, truth: Truth) -> Trial:
    """Errors of a calibration over their stated sigmas.

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
    )


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
