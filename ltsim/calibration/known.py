"""What earlier calibrations say of an instrument's parameters, as the prior of the next one."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ltsim.adjustment.prior import ParameterPrior, prior_sigmas
from ltsim.arrays import Floats
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.files import read_calibration
from ltsim.calibration.history import History, Population
from ltsim.calibration.history_schema import CourseEntry, HistoryFile
from ltsim.calibration.schema import CalibrationFile
from ltsim.errors import ModelError, RecordError, SetupError
from ltsim.model.construction import Construction, every_parameter_name
from ltsim.recording.recording import Recording
from ltsim.recording.result_file import read_result
from ltsim.units import FACTOR


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
        """What a calibration, a history, or the file of one says; raises RecordError."""
        if isinstance(source, Known):
            return source
        if isinstance(source, Calibration):
            return cls._of_calibration(source)
        if isinstance(source, History):
            return cls._of_history(source)
        return cls._read(Path(source))

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
    def _of_history(cls, history: History) -> Known:
        known, names = history.population, history.construction.names
        return cls._of_population(history.construction.name, names, known, len(history))

    @classmethod
    def _of_population(cls, construction: str, names: tuple[str, ...], known: Population, count: int) -> Known:
        covariance = np.diag(known.spread**2) + known.covariance
        return cls(construction, names, ("",), known.mean[None], covariance[None], known.spread, count)

    @classmethod
    def _read(cls, path: Path) -> Known:
        file = path
        if path.is_dir():
            held = [path / kind.FILE for kind in (CalibrationFile, HistoryFile) if (path / kind.FILE).is_file()]
            file = held[0] if held else path / CalibrationFile.FILE
        if not _is_history(file):
            return cls._of_calibration(read_calibration(file))
        content = read_result(file, HistoryFile)
        courses = content.parameters
        factor = np.array([_factor(course, file) for course in courses])
        names, size = tuple(course.name for course in courses), len(courses)
        if np.shape(content.mean_covariance) != (size, size):
            raise RecordError("found no covariance of the means; make it again by `ltsim history`", file=file)
        mean, spread = (np.array([getattr(course, what) for course in courses]) * factor for what in ("mean", "spread"))
        covariance = np.array(content.mean_covariance) * np.outer(factor, factor)
        return cls._of_population(
            content.construction, names, Population(mean, covariance, spread), len(content.calibrations)
        )

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
            k = 0 if len(self.instruments) == 1 else self._instrument(name)
            mean[i, here] = self.mean[k, there]
            covariance[i][np.ix_(here, here)] = self.covariance[k][np.ix_(there, there)]
        return ParameterPrior(mean, covariance, stated.held)

    def _instrument(self, name: str) -> int:
        if name not in self.instruments:
            raise RecordError(f"earlier calibrations know the instruments {', '.join(self.instruments)}, not '{name}'")
        return self.instruments.index(name)


def _is_history(file: Path) -> bool:
    """Whether a file says that it is a history; whatever else is wrong with it is for its reader to say."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, Mapping) and str(content.get("format", "")).startswith("ltsim-history/")


def _factor(course: CourseEntry, file: Path) -> float:
    if course.unit not in FACTOR:
        raise RecordError(f"parameters: unknown unit '{course.unit}' of {course.name}", file=file)
    return FACTOR[course.unit]


WIDE = 1000.0
"""Prior sigmas that stand for no prior: 10 to 20 mm and 15 mrad, within which the equations hold."""


@dataclass(frozen=True)
class Choice:
    """What is estimated, and from what prior; without arguments everything, from what the set-up states.

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
    """What earlier calibrations say, in place of the set-up's prior."""
    free: bool = False
    """Without a prior: parameters may be `WIDE` times as large as the set-up says, which no instrument's are."""

    def applied(self, recording: Recording, construction: Construction) -> ParameterPrior:
        """The prior of a recording's instruments that follows; raises ModelError, SetupError."""
        check_names(recording, construction)
        stated = ParameterPrior.independent(prior_sigmas(recording, construction) * (WIDE if self.free else 1.0))
        if self.prior is not None:
            stated = self.prior.over(stated, construction, recording.instruments)
        names = Names(construction.names, recording.instruments)
        held = np.zeros(stated.mean.shape, dtype=bool)
        values = np.zeros(stated.mean.shape)
        if self.parameters is not None:
            held[:] = True
            held.flat[names.places(self.parameters)] = False
        held.flat[names.places(self.without)] = True
        for name, value in self.hold.items():
            at = names.places([name])
            if len({k % construction.size for k in at}) > 1:
                raise ModelError(f"'{name}' stands for several parameters; a value belongs to one")
            held.flat[at] = True
            values.flat[at] = float(value) * construction.parameters[at[0] % construction.size].factor
        if held.all():
            raise ModelError("no parameter is left to estimate")
        return _holding(stated, held, values)


def _holding(prior: ParameterPrior, held: np.ndarray, values: Floats) -> ParameterPrior:
    """The prior with parameters held at values (I, p): they tell nothing about the others."""
    covariance = prior.covariance.copy()
    own = np.eye(held.shape[1], dtype=bool)
    covariance[(held[:, :, None] | held[:, None, :]) & ~own] = 0.0
    return ParameterPrior(np.where(held, values, prior.mean), covariance, held)


@dataclass(frozen=True)
class Names:
    """Names of the parameters of all instruments, as a person writes them."""

    parameters: tuple[str, ...]
    instruments: tuple[str, ...]

    def places(self, wanted: Iterable[str]) -> list[int]:
        """Places in the flat vector (I p) of names or beginnings of names; raises ModelError."""
        return [place for name in wanted for place in self._of(name.strip())]

    def _of(self, wanted: str) -> list[int]:
        name, at, instrument = wanted.partition("@")
        if at and instrument not in self.instruments:
            raise ModelError(f"'{wanted}': there is no instrument '{instrument}'; {_among(self.instruments)}")
        known = self.parameters
        own = [k for k, p in enumerate(known) if p == name]
        own = own or [k for k, p in enumerate(known) if p.startswith((name + "-", name + "_", name + "."))]
        if not own:
            close = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
            instead = f"did you mean {close[0]}?" if close else _among(known)
            raise ModelError(f"there is no parameter '{name}' in this construction; {instead}")
        chosen = [self.instruments.index(instrument)] if at else range(len(self.instruments))
        return [i * len(known) + k for i in chosen for k in own]


def _among(names: Sequence[str]) -> str:
    return f"those are {', '.join(name or 'unnamed' for name in names)}"


def check_names(recording: Recording, construction: Construction) -> None:
    """Raise SetupError where the set-up states a prior of a parameter that no construction has."""
    setup = recording.setup
    tables = {"instrument": setup.instrument, **{f"instruments.{k}": i for k, i in setup.instruments.items()}}
    known = {*construction.names, *every_parameter_name()}
    for table, instrument in tables.items():
        for name in instrument.prior.parameters:
            if name not in known:
                close = difflib.get_close_matches(name, construction.names, n=1, cutoff=0.4)
                instead = f"; did you mean {close[0]}?" if close else ""
                raise SetupError(f"[{table}.prior.parameters]: there is no parameter '{name}'{instead}")
