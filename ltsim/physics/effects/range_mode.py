from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.recordings.recording import DISTANCE_METER_COLUMN
from ltsim.scene.sightings import Sightings


class RangeMode(Effect):
    """Range zero by mode: the interferometer has another zero than the absolute distance meter.

    The correction (true value minus reading) is Delta_d = rho for the ranges of the interferometer, in a recording with
    both modes (column `distance_mode`). The parameter rho is the difference of the two zeros. The zero error that both
    distance meters have in common is range-offset.

    Size: 5 um in a good tracker, 20 to 50 um in a bad one.
    Similar to: range-step, if the mode changes once at a station; range-offset, if all ranges have the same mode.
    Separate by: the same targets in both modes.
    Validity: one zero per mode for the whole recording. A new homing gives an interferometer another zero (range-step).
    Source: the manual of a Brunson laser-tracker kit (both zeros are checked separately).
    Validation: validated on the pointings of either mode, and by a recording with both.
    """

    name = "range-mode"
    light_path_stage = LightPathStage.RANGE
    observables = ("distance",)
    covariates = (DISTANCE_METER_COLUMN,)
    parameters = (
        Parameter("interferometer-zero", "um", "length by which interferometer ranges are too short", 30 * MICROMETRE),
    )

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Effects that a diagnosis tries: this effect if both distance meters were used, otherwise none."""
        return [cls()] if DISTANCE_METER_COLUMN in sightings.covariates else []

    def design(self, sightings: Sightings) -> Floats:
        interferometer = sightings.covariates.get(DISTANCE_METER_COLUMN, np.zeros(len(sightings)))
        return design_from_front_face_corrections(
            sightings, distance=self.pointing_indicator(sightings) * interferometer
        )[:, :, None]
