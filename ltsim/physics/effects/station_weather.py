from ltsim.core.arrays import Floats
from ltsim.core.units import PPM
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.scene.sightings import Sightings


class StationWeather(Effect):
    """Wrong weather values at one station: a thermometer in the sun, a pressure in another unit.

    The correction (true value minus reading) of the range d at station i is Delta_d = d s_i. The scale error s_i is
    0.955 ppm for each kelvin by which the used temperature is too low, and -0.268 ppm for each hPa by which the used
    pressure is too low. All ranges of that station have this scale error.

    Size: 0.95 ppm for an error of 1 K, 2.7 ppm for 10 hPa, 67 ppm for mmHg in place of hPa (250 hPa).
    Similar to: mesh-expansion between stations (exactly), range-step at the station's start (correlation 0.965).
    Separate by: the weather values used at that station; a repeat of the first station at the end.
    Validity: a refractive index that is constant at each station.
    Source: Ciddor 1996, Appl. Opt. 35, 1566, doi:10.1364/AO.35.001566 (sensitivities by `effects.ciddor`).
    Validation: validated against the range scale on the station's pointings.
    """

    name = "station-weather"
    base_rate = 2.0
    light_path_stage = LightPathStage.AIR
    observables = ("distance",)
    covariates = ("distance",)
    scope = "station"
    parameters = (
        Parameter("station-weather", "ppm", "fraction by which every range of the station is read too short", 5 * PPM),
    )

    def design(self, sightings: Sightings) -> Floats:
        return design_from_front_face_corrections(
            sightings, distance=self.pointing_indicator(sightings) * sightings.range_
        )[:, :, None]
