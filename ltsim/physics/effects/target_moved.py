from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import FACTOR, MICROMETRE
from ltsim.physics.effects.effect import Stage, along_axes
from ltsim.physics.effects.motions import TargetMotion
from ltsim.physics.effects.places import gaps_near, start_time, visit_change_times
from ltsim.scene.sightings import Sightings

MAX_STEPS = 8
STEP, RATE = 60 * MICROMETRE, 40 * FACTOR["um/h"]


@dataclass(frozen=True)
class TargetMoved(TargetMotion):
    """Moved target: a nest was displaced suddenly, or its support creeps.

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

    time: float = 0.0
    kind: Literal["step", "creep"] = "step"

    name = "target-moved"
    stage = Stage.TARGET
    covariates = ("time",)
    scope = "target"
    plural = True
    parameters = along_axes("moved", "um", "motion of the target along", STEP)

    def __post_init__(self) -> None:
        if self.kind == "creep":
            rates = along_axes("creep", "um/h", "speed of the target along", RATE)
            object.__setattr__(self, "parameters", rates)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Candidates for every target: a step between any two visits, and creep."""
        candidates = []
        for t, name in enumerate(sightings.target_names):
            steps = visit_change_times(sightings, t, most=MAX_STEPS)
            candidates += [cls((), (name,), time) for time in steps]
            candidates += [cls((), (name,), kind="creep")] if len(steps) > 1 else []
        return candidates

    def finer(self, sightings: Sightings) -> list[Self]:
        """Steps in neighbouring gaps between pointings, including gaps within the visits of a station."""
        times = sightings.time[self.mask(sightings) > 0]
        return [self.reshaped(time=t) for t in gaps_near(times, self.time)] if self.kind == "step" else []

    def displacement(self, sightings: Sightings) -> Floats:
        made = sightings.time >= self.time if self.kind == "step" else sightings.time - start_time(sightings)
        return (self.mask(sightings) * made)[:, None, None] * np.eye(3)
