from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.scene.sightings import Sightings

AIR_TEMPERATURE_COLUMN = "air_temperature_c"
"""Name of the column of a recording with the air temperature [C] of each pointing."""
MIN_AIR_TEMPERATURE_RANGE = 0.05
"""Difference [K] between the highest and the lowest air temperature of a recording, up to which a diagnosis does not
try the effect because it cannot be estimated."""


class DeadPath(Effect):
    """Dead path: a part of the reference path inside the head warms up with the air, and ranges are not corrected.

    The correction (true value minus reading) of the range is Delta_d = k (T - T_0), with the recorded air temperature T
    and its value T_0 at the first pointing. For an interferometer k = -beta D_0, with the decrease beta = 0.955 ppm/K
    of the refractive index of air and the length D_0 of the path inside the head. For an absolute distance meter k is a
    property of its fibre.

    Size: 0.15 um/K for a path D_0 of 0.15 m, negligible; 1 to 5 um/K for the fibre of a bad absolute meter.
    Similar to: range-drift, if the temperature changes steadily with time.
    Separate by: a new homing of the interferometer; both distance modes along the same line.
    Validity: recordings with the column air_temperature_c, whose values must vary.
    Source: Bobroff 1993, Recent advances in displacement measuring interferometry, Meas. Sci. Technol. 4, 907-926.
    Validation: validated on a temperature column; the size is general knowledge.
    """

    name = "dead-path"
    base_rate = 0.5
    light_path_stage = LightPathStage.RANGE
    observables = ("distance",)
    covariates = ("temperature",)
    parameters = (
        Parameter("dead-path", "um/K", "length by which every range is too short, per kelvin", 3 * MICROMETRE),
    )

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Effects that a diagnosis tries: the dead path if the recorded air temperature varies, otherwise none."""
        temperature = sightings.covariates.get(AIR_TEMPERATURE_COLUMN)
        varies = (
            temperature is not None
            and np.isfinite(temperature).any()
            and np.nanmax(temperature) - np.nanmin(temperature) > MIN_AIR_TEMPERATURE_RANGE
        )
        return [cls()] if varies else []

    def design(self, sightings: Sightings) -> Floats:
        temperature = sightings.covariates.get(AIR_TEMPERATURE_COLUMN, np.full(len(sightings), np.nan))
        ordered = temperature[sightings.measurement_order]
        is_measured = ordered[np.isfinite(ordered)]
        temperature_change = np.nan_to_num(temperature - (is_measured[0] if len(is_measured) else 0.0))
        return design_from_front_face_corrections(
            sightings, distance=self.pointing_indicator(sightings) * temperature_change
        )[:, :, None]
