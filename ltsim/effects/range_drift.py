"""Drift of the range zero: the electronics and the head warm up.

Delta_d = r t (linear over the recording, or anew in every visit) or A exp(-t / tau) (warm-up).

Size: 1 to 2 um/h after the warm-up; tenths of a millimetre over two hours from cold.
Like: mesh-expansion (0.955), dead-path.
Separate by: a new homing in between; thermometers; a target measured every quarter of an hour.
Valid: the same law at every station, time constants of 10 min to 4 h.
Source: Pollack Periodica 15(3), 2020, on the warm-up of a Leica AT960 (size); the exponential is that of a body that
reaches its temperature.
Status: validated against the range zero at a given time.
"""

from dataclasses import dataclass
from typing import Self

from ltsim.effects.drift import Drift
from ltsim.effects.effect import Parameter, Stage
from ltsim.scene.sightings import Sightings
from ltsim.units import FACTOR, MICROMETRE


@dataclass(frozen=True)
class RangeDrift(Drift):
    """Range zero that follows the clock."""

    name = "range-drift"
    stage = Stage.RANGE
    observables = ("distance",)
    slot = "range"
    rate = Parameter("range-drift", "um/h", "growth of what is missing from every range", 15 * FACTOR["um/h"])
    amplitude = Parameter("range-drift-amplitude", "um", "missing at the start, dying away", 20 * MICROMETRE)
    parameters = (rate,)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Linear, anew in every visit, and warm-ups."""
        visits = [cls(law="visit")] if len(sightings.station_names) > 1 else []
        warm_ups = [cls(law="exponential", time_constant=t) for t in cls.shapes()]
        return [cls(law="linear"), *visits, *warm_ups]
