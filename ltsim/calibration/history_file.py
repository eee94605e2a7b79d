"""history.json: what a history says, as plain data."""

import numpy as np

from ltsim.calibration.events import events
from ltsim.calibration.history import History
from ltsim.calibration.history_schema import CalibrationOf, CourseEntry, HistoryFile
from ltsim.calibration.schema import Fit


def history_file(history: History) -> HistoryFile:
    """The content of `history.json`: parameters in the units a person reads, tests as chi-square."""
    factors = np.array([p.factor for p in history.construction.parameters])
    return HistoryFile(
        construction=history.construction.name,
        calibrations=tuple(
            CalibrationOf(label=label, fit=Fit(chi2=c.fit.chi2, dof=c.fit.dof, sigma0=c.fit.sigma0))
            for label, c in zip(history.labels, history.calibrations, strict=True)
        ),
        parameters=tuple(_course(history, k) for k in range(history.construction.size)),
        mean_covariance=(history.population.covariance / np.outer(factors, factors)).tolist(),
        constant=history.constancy(),
        changes=tuple(history.changes()),
        events=events(history),
        since_first=history.change(0, len(history) - 1),
    )


def _course(history: History, k: int) -> CourseEntry:
    parameter, known = history.construction.parameters[k], history.population
    return CourseEntry(
        name=parameter.name,
        unit=parameter.unit,
        values=(history.values[:, k] / parameter.factor).tolist(),
        sigmas=(history.sigma[:, k] / parameter.factor).tolist(),
        prior_sigma=history.prior_sigma[k] / parameter.factor,
        mean=known.mean[k] / parameter.factor,
        spread=known.spread[k] / parameter.factor,
        constant=history.constancy(k),
    )
