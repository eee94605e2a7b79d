from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE
from ltsim.physics.effects.effect import LightPathStage, Parameter, axis_parameters
from ltsim.physics.effects.motions import TargetDisplacementEffect
from ltsim.physics.effects.places import station_target_pairs
from ltsim.scene.sightings import Sightings

PLAUSIBLE_REFLECTOR_LIFT = 50 * MICROMETRE
"""Plausible lift [m] of a badly seated reflector from its nest."""
MAX_STATION_TARGET_PAIRS_WITH_CANDIDATE_LIFTS = 600
"""Number of pairs of station and target above which a diagnosis tries no lifts, because the w-test of an adjustment
then detects them."""


@dataclass(frozen=True)
class NestLift(TargetDisplacementEffect):
    """Badly seated reflector: dirt or a burr lifts it in its nest while one station measures it.

    The displacement is D = h n with the lift h along the nest's normal n (kind `normal`). For a nest with a cone or
    three balls D has any direction (kind `free`). The parameters are the motion of the reflector (no correction of a
    reading). The lift is the same in all pointings of the station to the target.

    Size: 4 um in a clean nest, 5 to 50 um with dirt.
    Similar to: outlier in one reading (correlation 0.85).
    Separate by: a repeat after reseating; a lift changes all three readings, in a fixed direction in space.
    Validity: 5 to 200 um; one seating per station and target, so that both faces and all repeats have the same lift.
    Source: Hughes et al. 2011, Meas. Sci. Technol. 22, 045103, doi:10.1088/0957-0233/22/4/045103 (repeatability of
    nests, second hand); Baarda 1968, A testing procedure for use in geodetic networks (its smallest detectable size).
    Validation: first-order form validated against the exact motion.
    """

    kind: Literal["normal", "free"] = "normal"
    """Direction of the lift: `normal` (along the normal of the nest) or `free` (any direction)."""

    name = "nest-lift"
    base_rate = 2.0
    light_path_stage = LightPathStage.TARGET
    covariates = ("place",)
    scope = "pointing"
    may_recur = True
    parameters = (Parameter("lift", "um", "lift of the reflector along the nest's normal", PLAUSIBLE_REFLECTOR_LIFT),)

    def __post_init__(self) -> None:
        if self.kind == "free":
            moved = axis_parameters("lift", "um", "motion of the reflector along", PLAUSIBLE_REFLECTOR_LIFT)
            object.__setattr__(self, "parameters", moved)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Lifts that a diagnosis tries per pair of station and target: in any direction, and along a known normal."""
        sight_pairs = station_target_pairs(sightings)
        if len(sight_pairs) > MAX_STATION_TARGET_PAIRS_WITH_CANDIDATE_LIFTS:
            return []
        oriented_indices = np.flatnonzero(np.isfinite(sightings.nest_normals).all(axis=1))
        nests = {sightings.target_names[t] for t in oriented_indices}
        normal_lifts = [cls((s,), (t,), "normal") for s, t in sight_pairs if t in nests]
        return [*normal_lifts, *(cls((s,), (t,), "free") for s, t in sight_pairs)]

    def displacement(self, sightings: Sightings) -> Floats:
        acts = self.pointing_indicator(sightings)[:, None, None]
        if self.kind == "free":
            return acts * np.eye(3)
        normal: Floats = np.nan_to_num(sightings.nest_normals[sightings.target])[:, :, None]
        return acts * normal
