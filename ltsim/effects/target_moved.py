"""Moved target: a nest is knocked, or its support creeps.

step: P(t) = P + H(t - t_m) D. creep: P(t) = P + v (t - t_0), t_0 the first pointing. The parameters are the motion
of the target in the network frame (no correction of a reading), the same as seen from all stations.

Size: 10 to 100 um.
Like: nest-lift, where the target was seen from one station afterwards.
Separate by: the target measured first and last from each station.
Valid: one step a target, between two stations' visits.
Source: general knowledge of networks; Baarda 1968, A testing procedure for use in geodetic networks (its smallest
detectable size).
Status: first order validated against the exact motion.
"""

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from ltsim.arrays import Floats
from ltsim.effects.effect import Effect, Parameter, Stage, by_displacement
from ltsim.effects.motions import exact_target_change
from ltsim.effects.places import gaps_near, start_time, visit_change_times
from ltsim.scene.sightings import Sightings
from ltsim.units import FACTOR, MICROMETRE

MOST_STEPS = 8
STEP, RATE = 60 * MICROMETRE, 40 * FACTOR["um/h"]


@dataclass(frozen=True)
class TargetMoved(Effect):
    """A target that moves at `time` [s] (`step`) or all the time (`creep`)."""

    time: float = 0.0
    kind: Literal["step", "creep"] = "step"

    name = "target-moved"
    stage = Stage.TARGET
    covariates = ("time",)
    scope = "target"
    plural = True
    parameters = tuple(
        Parameter(f"moved-{axis}", "um", f"motion of the target along the network's {axis} axis", STEP)
        for axis in "xyz"
    )

    def __post_init__(self) -> None:
        if self.kind == "creep":
            rates = tuple(
                Parameter(f"creep-{axis}", "um/h", f"speed of the target along the network's {axis} axis", RATE)
                for axis in "xyz"
            )
            object.__setattr__(self, "parameters", rates)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Every target with a step between any two of its visits, and with a creep."""
        found = []
        for t, name in enumerate(sightings.target_names):
            steps = visit_change_times(sightings, t, most=MOST_STEPS)
            found += [cls((), (name,), time) for time in steps]
            found += [cls((), (name,), kind="creep")] if len(steps) > 1 else []
        return found

    def _progress(self, sightings: Sightings) -> Floats:
        """(n,): share of the motion made, or time since the start."""
        if self.kind == "creep":
            return self.mask(sightings) * (sightings.time - start_time(sightings))
        return self.mask(sightings) * (sightings.time >= self.time)

    def finer(self, sightings: Sightings) -> list[Self]:
        """For a step the gaps between pointings around this one, inside the stations' visits too."""
        times = sightings.time[self.mask(sightings) > 0]
        return [self.reshaped(time=t) for t in gaps_near(times, self.time)] if self.kind == "step" else []

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, 3) of the raw readings per unit of motion, first order."""
        return by_displacement(sightings, self._progress(sightings)[:, None, None] * np.eye(3))

    def shift(self, sightings: Sightings, values: Floats) -> Floats:
        """Change (n, 3) of the raw readings, exact."""
        return exact_target_change(sightings, self._progress(sightings)[:, None] * values)
