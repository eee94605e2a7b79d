from ltsim.core.units import MICROMETRE, SI_PER_UNIT
from ltsim.physics.effects.effect import LightPathStage, Parameter
from ltsim.physics.effects.places import MotionDrift


class RangeDrift(MotionDrift):
    """Drift of the range zero: electronics and head warm up.

    The correction (true value minus reading) of the range is Delta_d = r t (with t from the start of the recording or
    of each station) or A exp(-t / tau) (warm-up). Here t is the time, r the rate, A the amplitude and tau the time
    constant.

    Size: 1 to 2 um/h after the warm-up; tenths of a millimetre over two hours from cold.
    Similar to: mesh-expansion (correlation 0.955), dead-path.
    Separate by: a new homing during the measurement; thermometers; one target measured every quarter of an hour.
    Validity: the same drift at every station; time constants of 10 min to 4 h.
    Source: Pollack Periodica 15(3), 2020, on the warm-up of a Leica AT960 (size); the exponential describes a body that
    approaches its final temperature.
    Validation: validated against the range zero at a given time.
    """

    name = "range-drift"
    light_path_stage = LightPathStage.RANGE
    observables = ("distance",)
    chain_error_key = "range"
    rate_parameter = Parameter(
        "range-drift", "um/h", "growth rate of the length by which every range is too short", 15 * SI_PER_UNIT["um/h"]
    )
    decay_amplitude_parameter = Parameter(
        "range-drift-amplitude",
        "um",
        "length by which ranges are too short at the start, which then decays",
        20 * MICROMETRE,
    )
    parameters = (rate_parameter,)

    candidate_linear_time_laws = ("linear", "visit")
