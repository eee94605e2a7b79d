from ltsim.core.arrays import Floats
from ltsim.core.units import SI_PER_UNIT
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.physics.effects.places import recording_start_time
from ltsim.scene.sightings import Sightings


class RefractivityDrift(Effect):
    """Drift of the refractive index: the hall warms up, but the weather values are not updated.

    The correction (true value minus reading) is Delta_d = d s t at the range d, with the time t since the first
    pointing and the growth rate s of the scale error; 1 K changes the refractive index by 0.955 ppm. Later stations
    measure shorter ranges.

    Size: 0.5 to 2 K in a morning, 0.1 to 1 ppm/h.
    Similar to: mesh-expansion, uniform mode (correlation 0.996, exactly if it grows only between stations);
    station-weather at single stations.
    Separate by: a thermometer on the structure; a repeat of the first station at the end.
    Validity: linear over the recording.
    Source: Ciddor 1996, Appl. Opt. 35, 1566, doi:10.1364/AO.35.001566 (sensitivities by `effects.ciddor`).
    Validation: validated against the range scale at one hour.
    """

    name = "refractivity-drift"
    base_rate = 2.0
    light_path_stage = LightPathStage.AIR
    observables = ("distance",)
    covariates = ("time", "distance")
    parameters = (
        Parameter(
            "refractivity-drift",
            "ppm/h",
            "growth of the fraction by which ranges are too short",
            3 * SI_PER_UNIT["ppm/h"],
        ),
    )

    def design(self, sightings: Sightings) -> Floats:
        time_since_start = sightings.time - recording_start_time(sightings)
        return design_from_front_face_corrections(
            sightings, distance=self.pointing_indicator(sightings) * sightings.range_ * time_since_start
        )[:, :, None]
