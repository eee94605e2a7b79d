"""Effects of the catalogue, and laws, that a person asks for, estimated beside the calibration.

Of what is not stated, place and constants, those are taken that explain most of the residuals; the chance of as large
a fall of chi-square counts all that were tried.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy import optimize, special

from ltsim.adjust import Adjustment
from ltsim.adjust.reliability import surprise
from ltsim.adjust.residual_space import ResidualSpace, orthonormal
from ltsim.chances import p_is
from ltsim.effects.effect import Effect, Mistake, NoiseEffect
from ltsim.effects.signature import Signature, Tunable
from ltsim.errors import ModelError
from ltsim.laws.law import Law
from ltsim.laws.sizes import sizes_of
from ltsim.laws.words import describe
from ltsim.model.construction import Construction
from ltsim.recording.recording import Recording
from ltsim.units import FACTOR

PLACES = ("stations", "targets")
STEP = 0.02
"""Change of a constant, relative to it, from which the curvature of its fit is taken."""


@dataclass(frozen=True)
class Wanted:
    """An effect to estimate, or a law; fields of an effect that are not `stated` are chosen by the readings."""

    effect: Tunable
    stated: frozenset[str] = frozenset()

    def check(self, recording: Recording, construction: Construction) -> None:
        """Raise ModelError where it cannot be estimated beside the calibration of a recording."""
        effect, name = self.effect, self.effect.name
        if isinstance(effect, NoiseEffect):
            raise ModelError(f"{name} is a law of the scatter: the noise is estimated with noise_from_data")
        if isinstance(effect, Mistake):
            raise ModelError(f"{name} is a slip of the work, no law of the readings: ltsim diagnose mends it")
        own = {p.name for p in effect.parameters}
        if not effect.place and own <= set(construction.names):
            raise ModelError(f"{name} is estimated anyway; it can be confined to a station, as in {name}:NAME")
        for kind, known in zip(PLACES, (recording.stations, recording.targets), strict=True):
            lost = sorted(set(getattr(effect, kind)) - set(known))
            if lost:
                raise ModelError(f"{name}: the recording has no {kind[:-1]} '{lost[0]}'")

    def tries(self, adjustment: Adjustment) -> Sequence[Tunable]:
        """Every instance with what is stated."""
        if not isinstance(self.effect, Effect):
            return [self.effect]
        same = [
            c
            for c in self.effect.candidates(adjustment.sightings)
            if all(getattr(c, key) == getattr(self.effect, key) for key in self.stated)
        ]
        if same:
            return same
        free = [s for s in self.effect.shape if s.name not in self.stated]
        grids = product(*([(s.name, float(v)) for v in s.grid()] for s in free))
        return [self.effect.reshaped(**dict(shape)) for shape in grids]


@dataclass(frozen=True)
class FittedParameter:
    """A parameter, or a constant that the readings chose, in the unit a person reads; no sigma for what was stated."""

    name: str
    value: float | str
    sigma: float | None
    unit: str


@dataclass(frozen=True)
class FittedEffect:
    """An effect that was estimated."""

    effect: str
    where: str
    """Its name, and the places to which it is confined."""
    parameters: tuple[FittedParameter, ...]
    """With its constants behind."""
    chi2_drop: float
    """By how much chi-square falls; `freedom` is the number of parameters that the recording can tell from the rest."""
    freedom: int
    tried: int
    """Instances of which this one fits best."""

    @property
    def p_value(self) -> float:
        """Chance of such a fall without the effect, over all that were tried."""
        return min(1.0, self.tried * float(special.chdtrc(self.freedom, self.chi2_drop))) if self.freedom else 1.0

    @property
    def sentence(self) -> str:
        """All of it for a person."""
        name = f"{self.effect} at {self.where}" if self.where else self.effect
        if not self.freedom:
            return f"{name}: this recording cannot tell it from poses, targets and parameters; it was left out"
        shown = ", ".join(
            f"{p.name} {p.value}" if isinstance(p.value, str) else f"{p.name} {p.value:.4g}{_more(p)}"
            for p in self.parameters
        )
        tried = f", the best of {self.tried}" if self.tried > 1 else ""
        return f"{name}: {shown}; chi-square falls by {self.chi2_drop:.1f} ({p_is(self.p_value)}{tried})"


def _more(parameter: FittedParameter) -> str:
    """Uncertainty and unit."""
    return ("" if parameter.sigma is None else f" +- {parameter.sigma:.2g}") + f" {parameter.unit}".rstrip()


def choose(adjustment: Adjustment, wanted: Wanted) -> tuple[Tunable, int, Mapping[str, float | None]]:
    """The instance that fits best, how many were tried, and the constants that it feels, with the sigma [SI] found."""
    space, tries = ResidualSpace.of(adjustment), wanted.tries(adjustment)

    best = max(tries, key=lambda effect: float(surprise(*_drop(space, effect))))
    sigmas: dict[str, float | None] = {}
    for shape in best.shape:
        now = getattr(best, shape.name)
        if not _felt(space, best, shape.name):
            continue
        sigmas[shape.name] = None
        if shape.name in wanted.stated or shape.steps < 2 or not isinstance(now, float):
            continue

        def worse(value: float, key: str = shape.name, effect: Tunable = best) -> float:
            return -_drop(space, effect.reshaped(**{key: value}))[0]

        found = float(optimize.minimize_scalar(worse, bounds=shape.bracket(now), method="bounded").x)
        best = best.reshaped(**{shape.name: found if worse(found) < worse(now) else now})
        at, step = getattr(best, shape.name), STEP * abs(getattr(best, shape.name))
        curvature = (worse(at + step) - 2 * worse(at) + worse(at - step)) / step**2
        if curvature > 0:
            sigmas[shape.name] = float(np.sqrt(2 / curvature))
    return best, len(tries), sigmas


def _felt(space: ResidualSpace, effect: Tunable, key: str) -> bool:
    """Whether a constant, not zero, changes the effect's readings."""
    now = getattr(effect, key)
    if now == 0.0:
        return False
    other = effect.reshaped(**{key: now * (1 + STEP) if isinstance(now, float) else now + 1})
    return not np.array_equal(space.signature(effect), space.signature(other))


def _drop(space: ResidualSpace, effect: Tunable) -> tuple[float, int]:
    """By how much chi-square falls to first order, and the number of parameters that leave something."""
    rows = space.signature(effect)
    basis = orthonormal(space.project(rows), np.linalg.norm(rows, axis=0))
    told = basis.T @ space.residual
    return float(told @ told), basis.shape[1]


def freedom_of(adjustment: Adjustment, effect: Tunable) -> int:
    """Number of an effect's parameters that a recording can tell from all that is adjusted."""
    return _drop(ResidualSpace.of(adjustment), effect)[1]


def fitted(
    before: Adjustment, after: Adjustment, effect: Tunable, tried: int, sigmas: Mapping[str, float | None]
) -> FittedEffect:
    """What is told of the last of an adjustment's effects."""
    drop, freedom = max(before.chi2 - after.chi2, 0.0), freedom_of(before, effect)
    if isinstance(effect, Law):
        return FittedEffect(name_of(effect, after), effect.place, _sizes(effect, after), drop, freedom, tried)
    count = len(effect.parameters)
    values = after.state.extra[-count:]
    spread = np.sqrt(np.maximum(np.diag(after.extra_covariance)[-count:], 0.0))
    rows = [
        FittedParameter(p.name, float(v / p.factor), float(s / p.factor), p.unit)
        for p, v, s in zip(effect.parameters, values, spread, strict=True)
    ]
    for key, value in vars(effect).items():
        if isinstance(value, str):
            rows.append(FittedParameter(key, value, None, ""))
        elif type(value) is int:  # the order of a harmonic
            rows.append(FittedParameter(key, float(value), None, ""))
    for shape in effect.shape:
        if shape.name in sigmas:
            spread_of, unit = sigmas[shape.name], FACTOR[shape.unit]
            sigma = None if spread_of is None else spread_of / unit
            rows.append(FittedParameter(shape.name, getattr(effect, shape.name) / unit, sigma, shape.unit))
    return FittedEffect(effect.name, effect.place, tuple(rows), drop, freedom, tried)


def name_of(effect: Signature, adjustment: Adjustment) -> str:
    """The name of an effect; that of a law are its words."""
    if not isinstance(effect, Law):
        return effect.name
    return f"{effect.carrier.name} ~ {describe(effect.driver, clock=adjustment.recording.has_clock)}"


def _sizes(law: Law, adjustment: Adjustment) -> tuple[FittedParameter, ...]:
    """What is told of a law among an adjustment's effects."""
    before = adjustment.effects[: adjustment.effects.index(law)]
    first = sum(len(effect.parameters) for effect in before)
    own = slice(first, first + len(law.parameters))
    sizes = sizes_of(law, adjustment.sightings, adjustment.state.extra[own], adjustment.extra_covariance[own, own])
    return tuple(FittedParameter(*size) for size in sizes)
