import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.units import PPM
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter
from ltsim.scene.sightings import Sightings


class GaugeScale(Effect):
    """Scale error of the gauge: its temperature or its expansion coefficient is wrong.

    True length = stated length (1 + s); a stated length changes by -s L. No reading changes.

    Size: a coefficient from a table is wrong by some percent, 8 ppm for aluminium over 7 K; a gauge one kelvin off 23
    ppm.
    Like: range-scale, one index of air for all, a uniform warming of the mesh: exactly.
    Separate by: a thermometer on the gauge; a bar of another material; a specification of the range scale.
    Valid: all known lengths share one gauge.
    Source: Sensors 2021, 21, 7479, doi:10.3390/s21227479, eq. 15, which lacks the length: L (1 + a dT) is meant.
    Status: validated on the known lengths.
    """

    name = "gauge-scale"
    stage = LightPathStage.TARGET
    observables = ()
    covariates = ("temperature",)
    parameters = (Parameter("gauge-scale", "ppm", "fraction missing from every known length", 20 * PPM),)

    def design(self, sightings: Sightings) -> Floats:
        return np.zeros((len(sightings), 3, 1))

    def gauge_design(self, first: Ints, second: Ints, points: Floats) -> Floats:
        lengths: Floats = np.linalg.norm(points[first] - points[second], axis=1)
        return -lengths[:, None]
