from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.notation import names_text
from ltsim.core.units import MICROMETRE, SI_PER_UNIT
from ltsim.physics.effects.effect import LightPathStage, axis_parameters
from ltsim.physics.effects.motions import TargetDisplacementEffect
from ltsim.physics.effects.places import (
    candidate_times_between_occupations,
    neighbouring_gap_times,
    recording_start_time,
)
from ltsim.scene.sightings import Sightings

MAX_CANDIDATE_STEP_TIMES_PER_TARGET = 8
"""Largest number of times per target at which a diagnosis tries a sudden displacement."""
PLAUSIBLE_TARGET_STEP = 60 * MICROMETRE
"""Plausible sudden displacement [m] of a target along each axis."""
PLAUSIBLE_TARGET_CREEP_RATE = 40 * SI_PER_UNIT["um/h"]
"""Plausible rate [m/s] at which a target creeps along each axis."""


def moved_coordinates_sentence(target_names: Sequence[str]) -> str:
    """Sentence on the time to which the coordinates of targets with a `TargetMoved` in the model refer."""
    return f"The coordinates of {names_text(target_names)} refer to the time before the motion."


def moved_target_names(effects: Iterable[object]) -> tuple[str, ...]:
    """Names of the targets with a `TargetMoved` among the effects of a model."""
    return tuple(name for effect in effects if isinstance(effect, TargetMoved) for name in effect.targets)


@dataclass(frozen=True)
class TargetMoved(TargetDisplacementEffect):
    """Moved target: a nest was displaced suddenly, or its support creeps.

    For a step, the target's coordinates are P(t) = P + H(t - t_m) D at the time t, with the unit step function H, the
    time t_m of the step and the displacement D. For creep they are P(t) = P + v (t - t_0), with the velocity v and the
    time t_0 of the first pointing. The parameters are the motion of the target in the network frame (no correction of a
    reading), the same as seen from all stations.

    Size: 10 to 100 um.
    Similar to: nest-lift, if only one station measured the target after the motion.
    Separate by: the target measured first and last from each station.
    Validity: one step per target, between the pointings of two stations.
    Source: general knowledge of networks; Baarda 1968, A testing procedure for use in geodetic networks (its smallest
    detectable size).
    Validation: first-order form validated against the exact motion.
    """

    time: float = 0.0
    """Time [s] of the sudden displacement, or of the start of the creep."""
    kind: Literal["step", "creep"] = "step"
    """Kind of motion: `step` (sudden) or `creep` (gradual)."""

    name = "target-moved"
    base_rate = 4.0
    light_path_stage = LightPathStage.TARGET
    covariates = ("time",)
    scope = "target"
    may_recur = True
    parameters = axis_parameters("moved", "um", "motion of the target along", PLAUSIBLE_TARGET_STEP)

    def __post_init__(self) -> None:
        if self.kind == "creep":
            rates = axis_parameters("creep", "um/h", "speed of the target along", PLAUSIBLE_TARGET_CREEP_RATE)
            object.__setattr__(self, "parameters", rates)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Motions that a diagnosis tries per target: a step between any two stations that measured it, and creep."""
        candidates = []
        for t, name in enumerate(sightings.target_names):
            steps = candidate_times_between_occupations(sightings, t, max_n_times=MAX_CANDIDATE_STEP_TIMES_PER_TARGET)
            candidates += [cls((), (name,), time) for time in steps]
            candidates += [cls((), (name,), kind="creep")] if len(steps) > 1 else []
        return candidates

    def neighbours(self, sightings: Sightings) -> list[Self]:
        """Copies of this step in neighbouring gaps between pointings, which a local search tries; none for creep."""
        times = neighbouring_gap_times(self, sightings, self.time) if self.kind == "step" else []
        return [self.with_shape_parameters(time=t) for t in times]

    def displacement(self, sightings: Sightings) -> Floats:
        fraction = (
            sightings.time >= self.time if self.kind == "step" else sightings.time - recording_start_time(sightings)
        )
        return (self.pointing_indicator(sightings) * fraction)[:, None, None] * np.eye(3)
