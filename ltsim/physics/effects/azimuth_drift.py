from ltsim.core.units import MICRORADIAN, SI_PER_UNIT
from ltsim.physics.effects.effect import LightPathStage, Parameter
from ltsim.physics.effects.places import MotionDrift


class AzimuthDrift(MotionDrift):
    """Drift of the azimuth zero: the base or the tripod head rotates, or the circle warms up.

    The correction (true value minus reading) of the azimuth is r t, at every station or at one station, or A exp(-t /
    tau). Here t is the time, r the rate, A the amplitude and tau the time constant. The estimated yaw of a station
    absorbs the mean of the correction. Residuals therefore show only the change while a station is measured, and a
    linear drift over the recording equals a drift that restarts at every station.

    Size: under 2 urad/h after the warm-up; tens of urad over two hours from cold, or on an unsteady stand.
    Similar to: transit-tilt (correlation 0.67 in one face, 0 in two) if targets are measured in the order of their
    heights.
    Separate by: a random order of the targets; a repeat of the first three targets at the end of each station.
    Validity: the same drift at every station, or a drift at one station; time constants of 10 min to 4 h.
    Source: Pollack Periodica 15(3), 2020, on the warm-up of a Leica AT960 (size); Dvořáček 2016, Acta Polytechnica 56,
    88-98 (tests of a Leica AT401).
    Validation: validated against a constant azimuth correction at a given time, and the equality of both linear laws up
    to yaw.
    """

    name = "azimuth-drift"
    light_path_stage = LightPathStage.ENCODERS
    observables = ("azimuth",)
    chain_error_key = "azimuth"
    rate_parameter = Parameter(
        "azimuth-drift", "urad/h", "growth rate of the azimuth correction", 20 * SI_PER_UNIT["urad/h"]
    )
    decay_amplitude_parameter = Parameter(
        "azimuth-drift-amplitude", "urad", "azimuth correction at the start, which then decays", 20 * MICRORADIAN
    )
    parameters = (rate_parameter,)

    candidate_linear_time_laws = ("visit",)
    tries_single_stations = True
