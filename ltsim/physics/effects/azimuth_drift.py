from ltsim.core.units import MICRORADIAN, SI_PER_UNIT
from ltsim.physics.effects.effect import LightPathStage, Parameter
from ltsim.physics.effects.places import Drift


class AzimuthDrift(Drift):
    """Drift of the azimuth zero: the base or the tripod head rotates, or the circle warms up.

    Correction of the azimuth = r t (in every visit, or in one) or A exp(-t / tau). The station's yaw takes the mean, so
    only the change within a visit is seen: a linear drift over the recording and one in every visit are the same.

    Size: under 2 urad/h after the warm-up; tens of urad over two hours from cold, or on an unsteady stand.
    Like: transit-tilt (0.67 / 0) where points are taken level by level.
    Separate by: a random order of the targets, the first three again before leaving.
    Valid: the same law at every station, or one station's own; time constants of 10 min to 4 h.
    Source: Pollack Periodica 15(3), 2020, on the warm-up of a Leica AT960 (size); Dvořáček 2016, Acta Polytechnica 56,
    88-98 (tests of a Leica AT401).
    Status: validated against the azimuth slot at a given time, and the equality of both linear laws up to yaw.
    """

    name = "azimuth-drift"
    stage = LightPathStage.ENCODERS
    observables = ("azimuth",)
    slot = "azimuth"
    rate_parameter = Parameter("azimuth-drift", "urad/h", "growth of the correction", 20 * SI_PER_UNIT["urad/h"])
    amplitude_parameter = Parameter(
        "azimuth-drift-amplitude", "urad", "correction at the start, decaying", 20 * MICRORADIAN
    )
    parameters = (rate_parameter,)

    linear_laws = ("visit",)
    tries_single_stations = True
