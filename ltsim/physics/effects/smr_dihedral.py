import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICRORADIAN
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.scene.sightings import Sightings


class SmrDihedral(Effect):
    """Dihedral error of a reflector: two mirrors are not perpendicular, and the return spot splits.

    With the dihedral error delta, the beam returns as six partial beams, whose directions differ by up to 1.63 delta.
    The mean direction does not change unless an aperture clips the spot or the coating is uneven. Then the tracker aims
    at the brighter part of the spot. The correction (true value minus reading) is a constant angle, a fraction of 1.63
    delta, that depends on the reflector and its rotation about the beam: Delta_azimuth = left / cos(el),
    Delta_elevation = up, the same on both faces. The range does not change.

    Size: delta is 10 urad in a good reflector, 50 urad in a bad one; the angle is a few percent of that.
    Similar to: detector-offset at one target, turbulence (if the reflector rotates freely about the beam).
    Separate by: the reflector turned about the beam.
    Validity: the marker on the reflector is always up; the fraction of delta is empirical.
    Source: the knowledge base of FARO on dihedral errors of a reflector; 1.63 from a ray trace of three mirrors.
    Validation: form validated by its parity; the size is empirical.
    """

    name = "smr-dihedral"
    base_rate = 0.5
    light_path_stage = LightPathStage.TARGET
    observables = ("azimuth", "elevation")
    covariates = ("distance", "place")
    scope = "target"
    may_recur = True
    parameters = (
        Parameter("spot-left", "urad", "correction of the direction to the left", 3 * MICRORADIAN),
        Parameter("spot-up", "urad", "correction of the direction upwards", 3 * MICRORADIAN),
    )

    def design(self, sightings: Sightings) -> Floats:
        acts = self.pointing_indicator(sightings)
        lateral = design_from_front_face_corrections(sightings, azimuth=acts / np.cos(sightings.elevation))
        return np.stack([lateral, design_from_front_face_corrections(sightings, elevation=acts)], axis=2)
