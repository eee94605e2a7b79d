"""Cable drag: the cable of the head winds up as it turns and twists the instrument against its base.

The correction (true value minus reading) is Delta_azimuth = k x, with the fraction k and the raw azimuth x, counted
from the middle of the travel between two stops half a turn away. The pull of the cable turns the instrument by the
fraction k of the angle that the head has turned. The error is equal at every station, and has opposite signs on both
sides of the cable's rest position.

Size: under 0.2 ppm (0.2 urad a radian) with a hanging cable, 2 to 5 ppm with a stiff one that lies on the floor.
Similar to: azimuth-eccentricity sine and azimuth-drift where targets are taken round the clock.
Separate by: a target taken again after a full turn of the head; two faces; the cable hung up.
Validity: a cable that pulls in proportion to the turn; targets on more than half of the circle.
Source: mechanics of a torsion spring.
Validation: validated on the sign and against a simulated recording.
"""

from dataclasses import dataclass

from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_front_face_corrections


@dataclass(frozen=True)
class CableDrag(Effect):
    """A twist of the instrument that grows with the turn of its head."""

    name = "cable-drag"
    light_path_stage = LightPathStage.AXES
    observables = ("azimuth",)
    covariates = ("azimuth",)
    parameters = (Parameter("cable-drag", "ppm", "twist of the instrument over the turn of its head", 5e-6),)

    def design(self, sightings):
        """Change (n, 3, 1) of the raw readings per unit: minus the correction."""
        turned = self.pointing_indicator(sightings) * sightings.ideal_raw_readings[:, 1]
        return design_from_front_face_corrections(sightings, azimuth=turned[:, None])
