"""Effects of the catalogue, and laws, that a person asks for, estimated beside the calibration.

Of what is not stated, place and constants, those are taken that explain most of the residuals, and the constants are
adjusted with everything else; the chance of as large a fall of chi-square counts all that were tried.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from ltsim.adjustment import Adjustment
from ltsim.adjustment.refit import Estimated, Refit, refit
from ltsim.adjustment.reliability import surprise
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.schema import FittedEffectEntry, FittedParameterEntry
from ltsim.core.errors import ModelError
from ltsim.core.units import FACTOR
from ltsim.physics.effects.effect import Effect, Mistake, NoiseEffect
from ltsim.physics.effects.signature import Parameter, ShapeParameter, Signature, Tunable
from ltsim.physics.laws.law import Law
from ltsim.physics.laws.sizes import sizes_of
from ltsim.physics.laws.words import AT_EACH_SET_UP, describe
from ltsim.physics.model.construction import Construction
from ltsim.recordings.recording import Recording

PLACES = ("stations", "targets")
PASSES = 3
"""Readings in use and noise are found anew with the constants that were found so many times."""


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


def estimated_beside(
    adjusted: Callable[[Sequence[Tunable]], Adjustment], always: Sequence[Tunable], extra_effects: Sequence[Wanted]
) -> tuple[Adjustment, tuple[FittedEffectEntry, ...]]:
    """The adjustment with effects, one after another chosen beside those before; what is told of each.

    Effects `always` estimated come first, and nothing is told of them.
    """
    found, fits = adjusted(always), list[FittedEffectEntry]()
    fit, stated = Refit(found, tuple(always), ()), [frozenset[str]()] * len(always)
    for wanted in extra_effects:
        tries, space = wanted.tries(found), ResidualSpace.of(found)
        best = max(tries, key=lambda effect: float(surprise(*space.explained(space.signature(effect)))))
        freedom, before = space.explained(space.signature(best))[1], found.chi2
        if freedom:
            stated.append(wanted.stated)
            found, fit = _settled(adjusted, [*fit.effects, best], stated)
        told = best if freedom else wanted.effect
        place = "" if isinstance(told, Law) and told.each else told.place
        drop = max(before - found.chi2, 0.0)
        name, tried = name_of(best, found), len(tries)
        fits.append(FittedEffectEntry(effect=name, where=place, chi2_drop=drop, freedom=freedom, tried=tried))
    first = len(always)
    rows = (
        _sizes(effect, found) if isinstance(effect, Law) else _rows(effect, told, given)
        for effect, told, given in zip(fit.effects[first:], fit.told[first:], stated[first:], strict=True)
    )
    return found, tuple(one.model_copy(update={"parameters": next(rows)}) if one.freedom else one for one in fits)


def _settled(
    adjusted: Callable[[Sequence[Tunable]], Adjustment], effects: Sequence[Tunable], stated: Sequence[frozenset[str]]
) -> tuple[Adjustment, Refit]:
    """The adjustment with effects at their best constants, and the refit beside its readings and weights."""
    for _ in range(PASSES):
        found = adjusted(effects)
        near = found.with_effects
        fit = refit(near, effects, start=found.state, fixed=stated)
        if fit.effects == tuple(effects):
            break
        effects = fit.effects
    return found, fit


def name_of(effect: Signature, adjustment: Adjustment) -> str:
    """The name of an effect; that of a law are its words."""
    if not isinstance(effect, Law):
        return effect.name
    own = AT_EACH_SET_UP if effect.each else ""
    return f"{effect.carrier.name} ~ {describe(effect.driver, clock=adjustment.recording.has_clock)}{own}"


def _sizes(law: Law, adjustment: Adjustment) -> tuple[FittedParameterEntry, ...]:
    """Estimated sizes of a law among an adjustment's effects, one entry each."""
    before = adjustment.effects[: adjustment.effects.index(law)]
    first = sum(len(effect.parameters) for effect in before)
    own = slice(first, first + len(law.parameters))
    sizes = sizes_of(law, adjustment.sightings, adjustment.state.extra[own], adjustment.extra_covariance[own, own])
    return tuple(FittedParameterEntry(**size._asdict()) for size in sizes)


def _rows(effect: Tunable, told: Sequence[Estimated], stated: frozenset[str]) -> tuple[FittedParameterEntry, ...]:
    """Entries of an effect: its parameters, its kind, the declared constants, and the estimated ones."""
    numbers = [_row(*one) for one in told]
    words = [
        FittedParameterEntry(name=key, value=value if isinstance(value, str) else float(value), unit="")
        for key, value in vars(effect).items()
        if isinstance(value, str) or type(value) is int  # the order of a harmonic
    ]
    given = [_row(s, getattr(effect, s.name), np.inf) for s in effect.shape if s.name in stated]
    count = len(effect.parameters)
    return (*numbers[:count], *words, *given, *numbers[count:])


def _row(parameter: Parameter | ShapeParameter, value: float, sigma: float) -> FittedParameterEntry:
    """A number in its unit."""
    unit = FACTOR[parameter.unit]
    spread = float(sigma / unit) if np.isfinite(sigma) else None
    return FittedParameterEntry(name=parameter.name, value=float(value / unit), sigma=spread, unit=parameter.unit)
