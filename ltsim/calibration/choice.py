"""What a person decides about the parameters of a calibration: which to estimate, which to hold, what was known."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ltsim.adjustment.prior import ParameterPrior, prior_sigmas
from ltsim.arrays import Floats
from ltsim.calibration.known import Known
from ltsim.errors import ModelError, SetupError
from ltsim.model.construction import Construction, every_parameter_name
from ltsim.recording.recording import Recording

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
