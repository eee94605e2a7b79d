from dataclasses import dataclass

from ltsim.core.arrays import Floats
from ltsim.core.units import MILLIMETRE
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class ReflectorConstant(Effect):
    """Wrong reflector constant: one station used another reflector, or the constant of another reflector was entered.

    The correction (true value minus reading) is Delta_d = c, the error of the constant, for every range of one station.
    The position of the sphere's centre does not change.

    Size: 17.5 or 34.4 mm for another prism, 0.02 to 0.5 mm for the constant of another SMR.
    Similar to: range-step at the station's start (exactly), station-weather (correlation 0.965).
    Separate by: the reflector and the constant that were used there; near and far targets at that station.
    Validity: one reflector per station. The same error at all stations equals the range zero of the instrument.
    Source: general knowledge: constants of reflectors are entered by hand.
    Validation: validated against the range offset on the station's pointings.
    """

    name = "reflector-constant"
    base_rate = 2.0
    light_path_stage = LightPathStage.RANGE
    observables = ("distance",)
    scope = "station"
    parameters = (
        Parameter(
            "reflector-constant", "um", "length by which every range at the station is too short", 5 * MILLIMETRE
        ),
    )

    def design(self, sightings: Sightings) -> Floats:
        return design_from_front_face_corrections(sightings, distance=self.pointing_indicator(sightings))[:, :, None]
