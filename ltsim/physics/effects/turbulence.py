import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE
from ltsim.physics.effects.effect import LightPathStage, NoiseEffect, Parameter
from ltsim.scene.sightings import Sightings


class Turbulence(NoiseEffect):
    """Turbulence: the refractive index fluctuates, and the scatter of readings grows with the range.

    The variances of the lengths D_t and D_v across the beam, to the left and upward, increase by C d^3 at the range d.
    The variance of d increases by C_r d. C and C_r are the parameters. The noise changes, the mean reading does not.

    Size: C of 100 um^2/m^3 on a shop floor; there a shield around a path of 2.5 m reduced the lateral scatter from 40
    to 23 um.
    Similar to: noise-level, small drifts.
    Separate by: repeats over minutes; a shielded path.
    Validity: errors that are independent between pointings; averaging N values within a pointing reduces them less than
    1 / sqrt(N).
    Source: Chernov 1960, Wave Propagation in a Random Medium (a ray's displacement grows with d^3); Hughes et al. 2011,
    Meas. Sci. Technol. 22, 045103, doi:10.1088/0957-0233/22/4/045103 (sizes, second hand).
    Validation: form validated; sizes second hand.
    """

    name = "turbulence"
    light_path_stage = LightPathStage.AIR
    covariates = ("distance",)
    parameters = (
        Parameter(
            "turbulence-across", "um2/m3", "variance across the beam, divided by the cubed range", 9 * MICROMETRE**2
        ),
        Parameter("turbulence-along", "um2/m", "variance of the range, divided by the range", 9 * MICROMETRE**2),
    )

    def variance(self, sightings: Sightings, sigma: Floats, parameter_values: Floats) -> Floats:
        range_, acts = sightings.range_, self.pointing_indicator(sightings)
        across = parameter_values[0] * range_  # C d^3 over d^2: an angle
        added = np.stack([parameter_values[1] * range_, across / np.cos(sightings.elevation) ** 2, across], axis=1)
        return sigma**2 + acts[:, None] * added
