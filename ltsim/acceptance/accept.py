"""From an acceptance file to its answer."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ltsim.acceptance.files import AcceptanceFile, judged, predicted
from ltsim.acceptance.judged import by_network, read_measured
from ltsim.acceptance.prediction import Plan
from ltsim.acceptance.spec import Acceptance
from ltsim.acceptance.tests import envelope
from ltsim.arrays import Floats
from ltsim.calibrate.files import read_calibration
from ltsim.errors import SetupError
from ltsim.model.construction import Construction, misalignment, steering_mirror
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
    built: Construction = steering_mirror() if acceptance.construction == "steering-mirror" else misalignment()
    if acceptance.measured is not None:
        plan = Plan(tests, built, limits, stated.noise)
        errors = read_measured(folder / acceptance.measured, tests, plan.limits)
        return judged(errors, limits, title=acceptance.title, name=name, left=len(tests) - len(errors))
    prior = np.array([p.sigma_from(stated.prior) for p in built.parameters])
    mean, covariance, of = np.zeros(built.size), np.diag(prior**2), f"an instrument like the {limits.name or 'stated'}"
    if acceptance.calibration is not None:
        built, mean, covariance = _calibrated(folder / acceptance.calibration, corrected=acceptance.corrected)
        prior = np.array([p.sigma_from(stated.prior) for p in built.parameters])
        of = "the corrected instrument" if acceptance.corrected else "the instrument as it reads"
    plan = Plan(tests, built, limits, stated.noise)
    outcome = plan.predict(mean, covariance, trials=acceptance.trials, seed=acceptance.seed)
    worst = plan.worst_passing(prior, envelope())
    return predicted(plan, outcome, worst, prior, title=acceptance.title, name=name, of=of)


def _calibrated(path: Path, *, corrected: bool) -> tuple[Construction, Floats, Floats]:
    """The constants of a calibrated instrument, as it reads or after the correction: their mean and covariance."""
    known = read_calibration(path)
    if len(known.instruments) > 1:
        raise SetupError(f"{path}: is of {len(known.instruments)} instruments; the tests are of one")
    mean: Floats = known.values[0] - (known.applied[0] if corrected else 0.0)
    return known.construction, mean, known.covariance
