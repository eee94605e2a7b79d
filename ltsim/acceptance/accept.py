"""From an acceptance file to its answer."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ltsim.acceptance.files import AcceptanceFile, judged, predicted
from ltsim.acceptance.judged import by_network, read_measured
from ltsim.acceptance.prediction import Plan
from ltsim.acceptance.spec import Acceptance
from ltsim.acceptance.tests import envelope
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.files import read_calibration
from ltsim.errors import SetupError
from ltsim.model.construction import of_design
from ltsim.recording import read


def accept(acceptance: Acceptance, folder: Path) -> AcceptanceFile:
    """Predict or judge the tests of an acceptance file; other files are named from `folder`.

    Raises
    ------
    SetupError, RecordError, NetworkError
        One sentence: what was found, what would be right.
    """
    limits = acceptance.limits
    if acceptance.recording is not None:
        recording = read(folder / acceptance.recording)
        found = by_network(recording, limits)
        return judged(found, limits, title=acceptance.title, name="own network", recording=recording)
    name = acceptance.tests or acceptance.standard or ""
    tests = acceptance.plan_of(folder)
    stated = limits.instrument(acceptance.construction)
    built = of_design(acceptance.construction)
    if acceptance.measured is not None:
        plan = Plan(tests, built, limits, stated.noise)
        errors = read_measured(folder / acceptance.measured, tests, plan.limits)
        return judged(errors, limits, title=acceptance.title, name=name, left=len(tests) - len(errors))
    known = None if acceptance.calibration is None else _known(folder / acceptance.calibration)
    built = built if known is None else known.construction
    prior = np.array([p.sigma_from(stated.prior) for p in built.parameters])
    if known is None:
        mean, covariance = np.zeros(built.size), np.diag(prior**2)
        of = f"an instrument like the {limits.name or 'stated'}"
    else:
        mean, covariance = known.values[0], known.covariance
        of = "the instrument as it reads"
        if acceptance.corrected:
            mean, of = mean - known.applied[0], "the corrected instrument"
    plan = Plan(tests, built, limits, stated.noise)
    outcome = plan.predict(mean, covariance, trials=acceptance.trials, seed=acceptance.seed)
    worst = plan.worst_passing(prior, envelope())
    return predicted(plan, outcome, worst, prior, title=acceptance.title, name=name, of=of)


def _known(path: Path) -> Calibration:
    """What is known of the instrument; raises SetupError where it is of several."""
    known = read_calibration(path)
    if len(known.instruments) > 1:
        raise SetupError(f"{path}: is of {len(known.instruments)} instruments; the tests are of one")
    return known
