from ltsim.core.arrays import Floats
from ltsim.core.units import MICRORADIAN
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.scene.sightings import Sightings


class HeadSag(Effect):
    """Gravity sag of the head: the scope bends under its own weight.

    The correction (true value minus reading) is Delta_elevation = -g (e_up . vertical), with the sag g and the upward
    unit vector e_up across the beam. For an upright tracker it is -g cos(el) at the elevation el, the same in both
    faces.

    Size: under 0.5 urad in a good head, 5 urad in a bad one; normally included in the manufacturer's correction.
    Similar to: elevation-eccentricity cosine, exactly for upright trackers; vertical-index (correlation 0.96 in one
    face, 0 in two).
    Separate by: a tracker that lies on its side or hangs (correlation 0.84).
    Validity: any mounting; the vertical is the z axis of the network frame.
    Source: Wallace 2002, A rigorous algorithm for telescope pointing, Proc. SPIE 4848 (tube flexure follows the same
    law).
    Validation: validated against the cosine part of elevation-eccentricity for upright stations.
    """

    name = "head-sag"
    light_path_stage = LightPathStage.AXES
    observables = ("elevation",)
    covariates = ("elevation",)
    parameters = (Parameter("sag", "urad", "downward deflection of a horizontal beam", 5 * MICRORADIAN),)

    def design(self, sightings: Sightings) -> Floats:
        upright = sightings.beam_vectors[2][:, 2]
        return design_from_front_face_corrections(sightings, elevation=-self.pointing_indicator(sightings) * upright)[
            :, :, None
        ]
