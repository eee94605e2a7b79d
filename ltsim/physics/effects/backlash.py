import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICRORADIAN
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter
from ltsim.scene.sightings import Sightings


class Backlash(Effect):
    """Backlash: the reading of an axis depends on the direction of its last motion (hysteresis).

    The correction (true value minus reading) of a raw angle is -h/2 sgn(last motion of its axis), with the width h of
    the axis's dead zone. The last motion is the motion from the previous pointing of the station to the present one.
    The first pointing of a station has no correction.

    Size: 0.1 to 0.3 urad in a good drive, 2 to 5 urad in a bad one.
    Similar to: encoder harmonics, if the targets are always measured in the same order.
    Separate by: the same targets in the reverse order.
    Validity: constant width; rows in the order of measurement. Cable drag that decays during the motion is not
    included.
    Source: general knowledge of drives; the equation describes a mechanical play of constant width.
    Validation: validated by reversing the order of measurement, which changes the sign.
    """

    name = "backlash"
    base_rate = 0.5
    light_path_stage = LightPathStage.AXES
    observables = ("azimuth", "elevation")
    covariates = ("approach",)
    parameters = (
        Parameter("backlash-azimuth", "urad", "width of the dead zone of the standing axis", 6 * MICRORADIAN),
        Parameter("backlash-elevation", "urad", "width of the dead zone of the transit axis", 6 * MICRORADIAN),
    )

    def design(self, sightings: Sightings) -> Floats:
        half_slack = -0.5 * sightings.approach_signs * self.pointing_indicator(sightings)[:, None]
        columns = [
            sightings.reading_change_by_error_key[circle] * half_slack[:, [i]]
            for i, circle in enumerate(("azimuth", "elevation"))
        ]
        return np.stack(columns, axis=2)
