from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MILLIMETRE
from ltsim.physics.effects.effect import LightPathStage, Parameter
from ltsim.physics.effects.motions import TargetDisplacementEffect
from ltsim.scene.sightings import Sightings


class SmrOffset(TargetDisplacementEffect):
    """Other reflector or adaptor: one station used an SMR of another radius with the previous constant.

    The displacement of the sphere's centre is D = (R_true - R_used) n along the nest's normal n, with the true and the
    used radius R. The parameter is this displacement, positive away from the nest (no correction of a reading).

    Size: 12.7 mm if a 1.5 in SMR is taken for 0.5 in, 7.94 mm if it is taken for 7/8 in: one of a few nominal
    differences.
    Similar to: nest-lift of many targets at once, a station-bump along a wall's normal.
    Separate by: no measurement is needed, because the size is one of the nominal differences.
    Validity: nests with a known normal. The same error at all stations displaces the targets, and only a reference
    length shows it.
    Source: nominal radii of reflectors: 1.5, 7/8 and 0.5 in across.
    Validation: first-order form validated against the exact motion.
    """

    name = "smr-offset"
    light_path_stage = LightPathStage.TARGET
    covariates = ("incidence", "place")
    scope = "station"
    parameters = (Parameter("radius-difference", "mm", "radius of the SMR minus the declared radius", 5 * MILLIMETRE),)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Effects that a diagnosis tries: one per station, or none if no normal of a nest is known."""
        has_normals = np.isfinite(sightings.nest_normals).all(axis=1).any()
        return [cls((name,)) for name in sightings.station_names] if has_normals else []

    def displacement(self, sightings: Sightings) -> Floats:
        normal = np.nan_to_num(sightings.nest_normals[sightings.target])
        return (normal * self.pointing_indicator(sightings)[:, None])[:, :, None]
