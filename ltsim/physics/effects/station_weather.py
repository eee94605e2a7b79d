from ltsim.core.arrays import Floats
from ltsim.core.units import PPM
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.scene.sightings import Sightings


class StationWeather(Effect):
    """Wrong weather values at one station: a thermometer in the sun, a pressure in another unit.

    Delta_d = d s_i at station i: 0.955 ppm a kelvin that the used temperature is too low, -0.268 ppm a hPa that the
    used pressure is too low. That station sees the whole mesh larger or smaller.

    Size: 1 K is 0.95 ppm, a slip of 10 hPa 2.7 ppm, mmHg for hPa (250 hPa) 67 ppm.
    Like: mesh-expansion between stations (exact), range-step at the station's start (0.965).
    Separate by: the weather values used at that station; the first station again at the end.
    Valid: one constant index a visit.
    Source: Ciddor 1996, Appl. Opt. 35, 1566, doi:10.1364/AO.35.001566 (sensitivities by `effects.ciddor`).
    Status: validated against the range scale on the station's rows.
    """

    name = "station-weather"
    stage = LightPathStage.AIR
    observables = ("distance",)
    covariates = ("distance",)
    scope = "station"
    parameters = (Parameter("station-weather", "ppm", "fraction missing from every range of the station", 5 * PPM),)

    def design(self, sightings: Sightings) -> Floats:
        return design_from_front_face_corrections(sightings, distance=self.row_weights(sightings) * sightings.range_)[
            :, :, None
        ]
