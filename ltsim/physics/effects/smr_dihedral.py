import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICRORADIAN
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.scene.sightings import Sightings


class SmrDihedral(Effect):
    """Dihedral error of a reflector: two mirrors are not perpendicular, and the return spot splits.

    The six sub-beams part by up to 1.63 delta; their mean stays unless the spot is clipped or a coating is uneven. Then
    the tracker holds the spot's brighter part, off by a share of 1.63 delta d: a constant angle for that reflector and
    roll, Delta_azimuth = left / cos(el), Delta_elevation = up, the same on both faces. The range does not change.

    Size: delta is 10 urad in a good reflector, 50 urad in a bad one; the clipped share a few percent of that.
    Like: detector-offset at one target, turbulence (if the roll is free).
    Separate by: the reflector turned about the beam.
    Valid: the reflector keeps its mark up; the clipped share is empirical.
    Source: the knowledge base of FARO on dihedral errors of a reflector; 1.63 from a ray trace of three mirrors.
    Status: form validated by its parity; the size is empirical.
    """

    name = "smr-dihedral"
    base_rate = 0.5
    stage = LightPathStage.TARGET
    observables = ("azimuth", "elevation")
    covariates = ("distance", "place")
    scope = "target"
    may_recur = True
    parameters = (
        Parameter("spot-left", "urad", "correction of the direction to the left", 3 * MICRORADIAN),
        Parameter("spot-up", "urad", "correction of the direction upwards", 3 * MICRORADIAN),
    )

    def design(self, sightings: Sightings) -> Floats:
        acts = self.row_weights(sightings)
        lateral = design_from_front_face_corrections(sightings, azimuth=acts / np.cos(sightings.elevation))
        return np.stack([lateral, design_from_front_face_corrections(sightings, elevation=acts)], axis=2)
