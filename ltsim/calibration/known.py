"""Prior information of a calibration: a person's decisions about its parameters, results of earlier calibrations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ltsim.adjustment.prior import ParameterPrior, prior_sigmas
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.files import read_calibration
from ltsim.calibration.history import History
from ltsim.calibration.history_file import history_file
from ltsim.calibration.history_schema import HistoryFile
from ltsim.calibration.schema import CalibrationFile
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError, RecordError, SetupError, unknown_name
from ltsim.core.units import FACTOR
from ltsim.physics.model.construction import Construction, every_parameter_name
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import read_json, read_result

WIDE = 1000.0
"""Prior sigmas that stand for no prior: 10 to 20 mm and 15 mrad, within which the equations hold."""


@dataclass(frozen=True)
class Known:
    """Values with their covariance, by the names of instruments and parameters."""

    construction: str
    parameters: tuple[str, ...]
    instruments: tuple[str, ...]
    """One alone stands for whatever instrument a recording names."""
    mean: Floats
    """(I, p) [SI]."""
    covariance: Floats
    """(I, p, p) [SI]."""
    spread: Floats
    """(p,) [SI]: of the parameters from one calibration to the next; 0 where one alone says nothing of it."""
    count: int = 1
    """Calibrations behind it."""

    @classmethod
    def of(cls, source: Calibration | History | Known | str | Path) -> Known:
        """Prior information from a calibration, a history, or the file of one; raises RecordError."""
        if isinstance(source, Known):
            return source
        if isinstance(source, Calibration):
            return cls._of_calibration(source)
        if isinstance(source, History):
            return cls._of_history(history_file(source))
        path = Path(source)
        names = (CalibrationFile.FILE, HistoryFile.FILE)
        held = [path / name for name in names if (path / name).is_file()] or [path / names[0]]
        file = held[0] if path.is_dir() else path
        if str(read_json(file, CalibrationFile.FILE).get("format", "")).startswith("ltsim-history/"):
            return cls._of_history(read_result(file, HistoryFile), file)
        return cls._of_calibration(read_calibration(file))

    @classmethod
    def _of_calibration(cls, found: Calibration) -> Known:
        """Parameters that were held there are left out: their values were not found."""
        free = np.flatnonzero(~found.held.any(axis=0) & (found.sigma > 0).all(axis=0))
        count, size = found.values.shape
        blocks = found.covariance.reshape(count, size, count, size)
        own = np.stack([blocks[i, :, i][np.ix_(free, free)] for i in range(count)])
        names = tuple(found.construction.names[k] for k in free)
        return cls(found.construction.name, names, found.instruments, found.values[:, free], own, np.zeros(len(free)))

    @classmethod
    def _of_history(cls, content: HistoryFile, file: Path | None = None) -> Known:
        courses = content.parameters
        strange = next((course for course in courses if course.unit not in FACTOR), None)
        if strange is not None:
            raise RecordError(f"parameters: unknown unit '{strange.unit}' of {strange.name}", file=file)
        if np.shape(content.mean_covariance) != (len(courses), len(courses)):
            raise RecordError("found no covariance of the means; make it again by `ltsim history`", file=file)
        factor = np.array([FACTOR[course.unit] for course in courses])
        mean, spread = (np.array([getattr(course, what) for course in courses]) * factor for what in ("mean", "spread"))
        covariance = np.diag(spread**2) + np.array(content.mean_covariance) * np.outer(factor, factor)
        names = tuple(course.name for course in courses)
        return cls(content.construction, names, ("",), mean[None], covariance[None], spread, len(content.calibrations))

    def over(self, stated: ParameterPrior, construction: Construction, instruments: tuple[str, ...]) -> ParameterPrior:
        """The `stated` prior of a recording's instruments with what is known in the place of it.

        Raises
        ------
        RecordError
            When it belongs to another construction or to other instruments.
        """
        common = [name for name in construction.names if name in self.parameters]
        if not common:
            raise RecordError(
                f"earlier calibrations are of construction {self.construction}, no parameter of {construction.name}"
            )
        here = [construction.names.index(name) for name in common]
        there = [self.parameters.index(name) for name in common]
        mean, covariance = stated.mean.copy(), stated.covariance.copy()
        for i, name in enumerate(instruments):
            if len(self.instruments) > 1 and name not in self.instruments:
                known = ", ".join(self.instruments)
                raise RecordError(f"earlier calibrations know the instruments {known}, not '{name}'")
            k = 0 if len(self.instruments) == 1 else self.instruments.index(name)
            mean[i, here] = self.mean[k, there]
            covariance[i][np.ix_(here, here)] = self.covariance[k][np.ix_(there, there)]
        return ParameterPrior(mean, covariance, stated.held)


@dataclass(frozen=True)
class Choice:
    """Choice of the parameters to estimate and of their prior; by default all of them, with the prior of the set-up.

    A name is that of a parameter (`beam-tilt`), of several by their common beginning (`azimuth-eccentricity`, `J1.eX`),
    or of one instrument's alone (`beam-tilt@TRACKER`).
    """

    parameters: Sequence[str] | None = None
    """The only parameters to estimate; the others are held at zero."""
    without: Sequence[str] = ()
    """Parameters to hold at zero."""
    hold: Mapping[str, float] = field(default_factory=dict)
    """Parameters to hold at a value, in the parameter's unit."""
    prior: Known | None = None
    """Result of earlier calibrations, in place of the set-up's prior."""
    free: bool = False
    """Without a prior: parameters may be `WIDE` times as large as the set-up says, which no instrument's are."""

    def applied(self, recording: Recording, construction: Construction) -> ParameterPrior:
        """The prior of a recording's instruments that follows; raises ModelError, SetupError."""
        return self.over(prior_sigmas(recording, construction), recording, construction)

    def over(self, sigma: Floats, recording: Recording, construction: Construction) -> ParameterPrior:
        """The same where standard deviations (I, p) [SI] are expected."""
        check_names(recording, construction)
        stated = ParameterPrior.independent(sigma * (WIDE if self.free else 1.0))
        if self.prior is not None:
            stated = self.prior.over(stated, construction, recording.instruments)

        def places(*wanted: str) -> list[int]:
            return [k for name in wanted for k in places_of(name, construction.names, recording.instruments)]

        held = np.zeros(stated.mean.shape, dtype=bool)
        values = np.zeros(stated.mean.shape)
        if self.parameters is not None:
            held[:] = True
            held.flat[places(*self.parameters)] = False
        held.flat[places(*self.without)] = True
        for name, value in self.hold.items():
            at = places(name)
            if len({k % construction.size for k in at}) > 1:
                raise ModelError(f"'{name}' stands for several parameters; a value belongs to one")
            held.flat[at] = True
            values.flat[at] = float(value) * construction.parameters[at[0] % construction.size].factor
        if held.all():
            raise ModelError("no parameter is left to estimate")
        # Parameters that are held tell nothing about the others.
        covariance, own = stated.covariance.copy(), np.eye(construction.size, dtype=bool)
        covariance[(held[:, :, None] | held[:, None, :]) & ~own] = 0.0
        return ParameterPrior(np.where(held, values, stated.mean), covariance, held)


def places_of(wanted: str, parameters: Sequence[str], instruments: Sequence[str]) -> list[int]:
    """Places in the flat vector (I p) of a parameter, or of several by their beginning; raises ModelError."""
    name, at, instrument = wanted.strip().partition("@")
    if at and instrument not in instruments:
        raise unknown_name("instrument", instrument, [known or "unnamed" for known in instruments])
    own = [k for k, p in enumerate(parameters) if p == name]
    own = own or [k for k, p in enumerate(parameters) if p.startswith((name + "-", name + "_", name + "."))]
    if not own:
        raise unknown_name("parameter", name, parameters)
    chosen = [instruments.index(instrument)] if at else range(len(instruments))
    return [i * len(parameters) + k for i in chosen for k in own]


def check_names(recording: Recording, construction: Construction) -> None:
    """Raise SetupError where the set-up states a prior of a parameter that no construction has."""
    setup = recording.setup
    tables = {"instrument": setup.instrument, **{f"instruments.{k}": i for k, i in setup.instruments.items()}}
    known = {*construction.names, *every_parameter_name()}
    for table, instrument in tables.items():
        for name in instrument.prior.parameters:
            if name not in known:
                raise SetupError(f"[{table}.prior.parameters]: {unknown_name('parameter', name, construction.names)}")
