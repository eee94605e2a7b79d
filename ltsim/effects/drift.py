"""Laws of the clock that drifts share: linear in a visit, linear over the campaign, or dying away as a warm-up."""

from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import Effect, Parameter, ShapeParameter
from ltsim.effects.places import start_time
from ltsim.scene.sightings import Sightings

Law = Literal["visit", "linear", "exponential"]

WARM_UP = ShapeParameter(
    "time_constant", "min", "time constant of the warm-up", 600.0, 14_400.0, logarithmic=True, steps=6
)


@dataclass(frozen=True)
class Drift(Effect):
    """A correction of one slot that follows the clock."""

    law: Law = "linear"
    """``visit``: rate times the time since the station's first pointing; ``linear``: rate times the time since the
    recording's first pointing; ``exponential``: amplitude times exp(-t / time_constant) of the same time.
    """
    time_constant: float = 3600.0
    """[s], of the exponential law."""

    covariates = ("time",)
    shape = (WARM_UP,)
    slot: ClassVar[str]
    rate: ClassVar[Parameter]
    amplitude: ClassVar[Parameter]
    laws: ClassVar[tuple[Law, ...]]
    """Linear laws that are tried at all stations together: the first, and the others where there are several."""
    alone: ClassVar[bool] = False
    """The law of a visit is tried at single stations too."""

    def __post_init__(self) -> None:
        chosen = self.amplitude if self.law == "exponential" else self.rate
        object.__setattr__(self, "parameters", (chosen,))

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Linear at all stations, at one alone, and warm-ups."""
        names = sightings.station_names if len(sightings.station_names) > 1 else ()
        linear = [cls(law=law) for law in (cls.laws if names else cls.laws[:1])]
        alone = [cls((name,), law="visit") for name in names if cls.alone]
        return [*linear, *alone, *(cls(law="exponential", time_constant=float(t)) for t in WARM_UP.grid())]

    def progress(self, sightings: Sightings) -> Floats:
        """(n,): the law at each pointing, [s] or dimensionless."""
        if self.law == "visit":
            return sightings.station_time
        since = sightings.time - start_time(sightings)
        return since if self.law == "linear" else np.asarray(np.exp(-since / self.time_constant))

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 1) of the raw readings per unit of the rate or amplitude."""
        amount = self.mask(sightings) * self.progress(sightings)
        column: Floats = sightings.slot_responses[self.slot] * amount[:, None]
        return column[:, :, None]
