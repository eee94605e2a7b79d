from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE, MICRORADIAN
from ltsim.physics.effects.effect import LightPathStage, Parameter, ShapeParameter
from ltsim.physics.effects.motions import StationMotionEffect
from ltsim.scene.sightings import Sightings

SETTLING_MOTION_INDICES = [3, 4, 2]
"""Indices, among the six components of a station's motion, of the components that settle: rotation about x, rotation
about y, and translation along z."""


@dataclass(frozen=True)
class StationSettling(StationMotionEffect):
    """Settling of a station: tripod, stand or floor yield after the set-up, or the stand warms up.

    At the time t the pose of the station is pose(t) = pose + (1 - exp(-t_i / tau)) (tilts, height), with the time t_i
    since the station's first pointing and the time constant tau. The parameters are the final motion of the station
    itself in the network frame (no correction of a reading): rotations about x and y through its origin, and a rise.
    The settling starts again at the next station and is the same in both faces.

    Size: under 1 urad on a good stand, 5 to 20 urad over 10 to 20 min on a bad one; a steel stand of 1.2 m grows 14
    um/K.
    Similar to: index-drift (one face), air-layer.
    Separate by: two faces; a repeat of the first targets at the end of the station; a level on the head.
    Validity: time constants of 2 to 40 min.
    Source: the user manual of SpatialAnalyzer (drift check); the exponential is a choice.
    Validation: first-order form validated against the exact motion.
    """

    time_constant: float = 600.0
    """Time constant tau [s] with which the station settles."""

    name = "station-settling"
    base_rate = 2.0
    light_path_stage = LightPathStage.STATION
    covariates = ("time",)
    scope = "station"
    parameters = (
        Parameter("tilt-x", "urad", "final rotation of the station about the network's x axis", 15 * MICRORADIAN),
        Parameter("tilt-y", "urad", "final rotation of the station about the network's y axis", 15 * MICRORADIAN),
        Parameter("rise", "um", "final rise of the station", 20 * MICROMETRE),
    )
    shape_parameters = (
        ShapeParameter(
            "time_constant",
            "min",
            "time constant after the set-up",
            120.0,
            2400.0,
            has_logarithmic_grid=True,
            n_grid_values=5,
        ),
    )

    def motion(self, sightings: Sightings) -> Floats:
        settled = self.pointing_indicator(sightings) * (
            1.0 - np.exp(-sightings.time_since_station_start / self.time_constant)
        )
        return settled[:, None, None] * np.eye(6)[:, SETTLING_MOTION_INDICES]
