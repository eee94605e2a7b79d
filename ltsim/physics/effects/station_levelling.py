from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICRORADIAN
from ltsim.physics.effects.effect import LightPathStage, Parameter
from ltsim.physics.effects.motions import StationMotionEffect
from ltsim.scene.sightings import Sightings


class StationLevelling(StationMotionEffect):
    """Levelling error: the level is wrong, so that the axis of a levelled station is inclined.

    The instrument is rotated by the vector w = R_i (b_x, b_y, 0) in the network frame, with the rotation R_i of station
    i. The parameters b_x and b_y are the rotations about the x and y axes of the instrument (no correction of a
    reading). The error acts at one station, or equally at all stations (a level fixed to the head).

    Size: 2 urad for a good level, 10 to 20 urad for a bad one.
    Similar to: no effect; if the tilts of the stations are estimated, they absorb it, and the residuals do not change.
    Separate by: an adjustment that estimates the tilts; plumb lines converge by 0.157 urad per metre.
    Validity: levelled stations only.
    Source: the user manual of SpatialAnalyzer (weights of levels); ISO 10360-10:2021 (inclinometers).
    Validation: first-order form validated against the exact motion.
    """

    name = "station-levelling"
    light_path_stage = LightPathStage.STATION
    observables = ("azimuth", "elevation")
    covariates = ("place",)
    scope = "station"
    parameters = (
        Parameter("lean-x", "urad", "rotation about the instrument's x axis", 20 * MICRORADIAN),
        Parameter("lean-y", "urad", "rotation about the instrument's y axis", 20 * MICRORADIAN),
    )

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Levelling errors that a diagnosis tries: one at each single station, and an equal one at all stations."""
        return [cls(), *(cls((name,)) for name in sightings.station_names)]

    def motion(self, sightings: Sightings) -> Floats:
        axes = (
            sightings.station_rotations[sightings.station][:, :, :2] * self.pointing_indicator(sightings)[:, None, None]
        )
        return np.concatenate([np.zeros_like(axes), axes], axis=1)
