import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.units import PPM
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter
from ltsim.scene.sightings import Sightings


class GaugeScale(Effect):
    """Scale error of the gauge: its temperature or its expansion coefficient is wrong.

    True length = declared length (1 + s), with the scale error s. A gauge is a set of reflectors at known distances. A
    declared length L changes by -s L. No reading changes.

    Size: 8 ppm if the tabulated coefficient of aluminium is wrong by 5 % and the temperature differs by 7 K from the
    reference; 23 ppm for an error of 1 K of the temperature of an aluminium gauge.
    Similar to: range-scale, a wrong refractive index at all stations, and a uniform warming of all targets, exactly.
    Separate by: a thermometer on the gauge; a bar of another material; a specification of the range scale.
    Validity: all known lengths share one gauge.
    Source: Sensors 2021, 21, 7479, doi:10.3390/s21227479, eq. 15, which lacks the length: L (1 + a dT) is meant.
    Validation: validated on the known lengths.
    """

    name = "gauge-scale"
    light_path_stage = LightPathStage.TARGET
    observables = ()
    covariates = ("temperature",)
    parameters = (Parameter("gauge-scale", "ppm", "fraction by which every known length is too short", 20 * PPM),)

    def design(self, sightings: Sightings) -> Floats:
        return np.zeros((len(sightings), 3, 1))

    def gauge_design(self, first_targets: Ints, second_targets: Ints, points: Floats) -> Floats:
        lengths: Floats = np.linalg.norm(points[first_targets] - points[second_targets], axis=1)
        return -lengths[:, None]
