"""Trials of a recovery check: a recording simulated, calibrated by ltsim or by a foreign calibrator, and scored."""

from collections.abc import Generator
from dataclasses import dataclass
from typing import NamedTuple

from ltsim.calibration.calibration import Calibration
from ltsim.calibration.distance import calibrate_distance
from ltsim.calibration.extra_effects import RequestedEffect
from ltsim.calibration.network import calibrate_network
from ltsim.campaigns.schema import Errors
from ltsim.campaigns.scoring import Calibrator, Trial, estimates_by, score, score_estimates
from ltsim.core.errors import CalibratorError, ConvergenceError, LtsimError
from ltsim.core.parallel import parallel
from ltsim.physics.model.construction import Construction
from ltsim.recordings import Recording
from ltsim.simulation.fieldwork import fieldwork
from ltsim.simulation.physics import instrument_law
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.simulator import measure, place_key


class FailedTrial(NamedTuple):
    """A trial without a result."""

    reason: str
    """Reason of the failure, as a sentence."""
    foreign: bool
    """True for a failure of a foreign calibrator."""


@dataclass(frozen=True)
class How:
    """Calibration of a recording: ltsim's method, or in addition a calibrator of the user."""

    method: str = "network"
    construction: Construction | None = None
    extra_effects: tuple[RequestedEffect, ...] = ()
    calibrator: Calibrator | None = None
    errors: Errors = "drawn"
    """Origin of the instruments' errors: drawn from the prior, or declared by the scenario."""


def run_trials(
    scenario: Scenario, trials: int, how: How, *, seed: int = 0, jobs: int = 1
) -> Generator[Trial | FailedTrial, None, None]:
    """Run the trials one by one, in order; the same for any number of jobs.

    Raises SetupError when the calibrator's parameters are not among those that are drawn.
    """
    made = from_prior(scenario) if how.errors == "drawn" else scenario
    work = ((made, seed, index, how) for index in range(trials))
    yield from parallel(run_trial, work, min(jobs, trials), batch=4)


def from_prior(scenario: Scenario) -> Scenario:
    """The scenario with instruments whose errors are drawn from the priors that the calibrator will use."""
    drawn = {"errors": {"draw": True}, "error_factor": 1.0}
    named = {name: tracker.model_copy(update=drawn) for name, tracker in scenario.instruments.items()}
    return scenario.model_copy(
        update={"instrument": scenario.instrument.model_copy(update=drawn), "instruments": named}
    )


def run_trial(scenario: Scenario, seed: int, index: int, how: How) -> Trial | FailedTrial:
    """Result of a trial: simulated, calibrated and compared with the truth."""
    work = fieldwork(scenario, seed, *place_key(index, "per-trial"))
    recording, truth = measure(work, seed, index)
    law = instrument_law(work.scenario, work.construction)
    names = work.construction.names_of(tuple(work.scenario.trackers))
    laws = dict(zip(names, zip(*(x.ravel() for x in law), strict=True), strict=True))
    reference = None
    try:
        reference = score(calibrated(recording, how, how.construction or work.construction), truth, laws)
    except LtsimError as problem:
        if how.calibrator is None and not isinstance(problem, ConvergenceError):
            raise
        reason = f"trial {index}: {problem}"
    if how.calibrator is None:
        return FailedTrial(reason, foreign=False) if reference is None else reference
    try:
        estimates = estimates_by(how.calibrator, recording, f"trial {index}")
    except CalibratorError as problem:
        return FailedTrial(str(problem), foreign=True)
    return score_estimates(estimates, truth, how.errors, reference)


def calibrated(recording: Recording, how: How, construction: Construction) -> Calibration:
    """Calibrate by one of ltsim's methods."""
    if how.method == "network":
        return calibrate_network(recording, construction, advise=False, weigh=False, extra_effects=how.extra_effects)
    return calibrate_distance(recording, construction, method=how.method, advise=False)
