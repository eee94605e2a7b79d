from ltsim.core.arrays import Floats
from ltsim.core.units import SI_PER_UNIT
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.physics.effects.places import first_pointing_time
from ltsim.scene.sightings import Sightings


class RefractivityDrift(Effect):
    """Drift of the refractive index: the hall warms up, but the weather values are not updated.

    Delta_d = d s t, t since the first pointing; a kelvin is 0.955 ppm. Later stations see the mesh smaller.

    Size: 0.5 to 2 K a morning, 0.1 to 1 ppm/h.
    Like: mesh-expansion, the uniform mode (0.996, exact where it grows between visits), station-weather in single
    stations.
    Separate by: a thermometer on the structure; the first station again at the end.
    Valid: linear over the recording.
    Source: Ciddor 1996, Appl. Opt. 35, 1566, doi:10.1364/AO.35.001566 (sensitivities by `effects.ciddor`).
    Status: validated against the range scale at one hour.
    """

    name = "refractivity-drift"
    stage = LightPathStage.AIR
    observables = ("distance",)
    covariates = ("time", "distance")
    parameters = (
        Parameter(
            "refractivity-drift", "ppm/h", "growth of the fraction missing from ranges", 3 * SI_PER_UNIT["ppm/h"]
        ),
    )

    def design(self, sightings: Sightings) -> Floats:
        since = sightings.time - first_pointing_time(sightings)
        return design_from_front_face_corrections(
            sightings, distance=self.row_weights(sightings) * sightings.range_ * since
        )[:, :, None]
