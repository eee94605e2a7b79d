"""The public function of acceptance tests."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.acceptance.files import AcceptanceFile
from ltsim.acceptance.judged import by_network, judged, read_measured
from ltsim.acceptance.prediction import AcceptancePlan, predicted
from ltsim.acceptance.spec import Acceptance, acceptance_from, load_acceptance
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.files import read_calibration
from ltsim.core.errors import SetupError
from ltsim.physics.model.construction import of_design
from ltsim.recordings import read


def accept(acceptance: str | Path | Mapping[str, Any] | Acceptance, folder: str | Path = ".") -> AcceptanceFile:
    """Predict acceptance tests of a tracker, or judge errors that were found, against its maker's limits.

    Parameters
    ----------
    acceptance : str, Path, mapping or Acceptance
        An acceptance file, or its tables; `format` may be left out of tables.
    folder : str or Path
        From where tables name other files.

    Raises
    ------
    SetupError, RecordError, NetworkError
        When a file is missing or does not fit the plan of tests.

    Examples
    --------
    >>> import ltsim as lt
    >>> found = lt.accept({"standard": "asme-b89.4.19-2006", "instrument": "leica-at500"})
    >>> found.kind, len(found.tests)
    ('predicted', 74)
    """
    place = Path(folder)
    if isinstance(acceptance, Mapping):
        acceptance = acceptance_from({"format": "ltsim-acceptance/1", **acceptance}, "acceptance")
    elif not isinstance(acceptance, Acceptance):
        place, acceptance = Path(acceptance).parent, load_acceptance(Path(acceptance))
    return _answer(acceptance, place)


def _answer(acceptance: Acceptance, folder: Path) -> AcceptanceFile:
    limits = acceptance.limits
    if acceptance.recording is not None:
        recording = read(folder / acceptance.recording)
        result = by_network(recording, limits)
        return judged(result, acceptance, recording=recording)
    tests = acceptance.plan_of(folder)
    nominal = limits.instrument(acceptance.construction)
    built = of_design(acceptance.construction)
    if acceptance.measured is not None:
        plan = AcceptancePlan(tests, built, limits, nominal.noise)
        errors = read_measured(folder / acceptance.measured, tests, plan.limits)
        return judged(errors, acceptance, remaining=len(tests) - len(errors))
    calibration = None if acceptance.calibration is None else _usable_calibration(folder / acceptance.calibration)
    built = built if calibration is None else calibration.construction
    prior = np.array([p.sigma_from(nominal.prior) for p in built.parameters])
    if calibration is None:
        mean, covariance = np.zeros(built.size), np.diag(prior**2)
        of = f"an instrument like the {limits.name or 'nominal'}"
    else:
        mean, covariance = calibration.values[0], calibration.covariance
        of = "the instrument as it reads"
        if acceptance.corrected:
            mean, of = mean - calibration.applied[0], "the corrected instrument"
    plan = AcceptancePlan(tests, built, limits, nominal.noise)
    outcome = plan.predict(mean, covariance, trials=acceptance.trials, seed=acceptance.seed)
    return predicted(plan, outcome, prior, acceptance, of=of)


def _usable_calibration(path: Path) -> Calibration:
    """Calibration of the instrument; raises SetupError where the file is of several instruments."""
    calibration = read_calibration(path)
    if len(calibration.instruments) > 1:
        raise SetupError(f"{path}: is of {len(calibration.instruments)} instruments; the tests are of one")
    return calibration
