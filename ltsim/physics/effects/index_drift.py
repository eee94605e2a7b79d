from ltsim.core.units import MICRORADIAN, SI_PER_UNIT
from ltsim.physics.effects.effect import LightPathStage, Parameter
from ltsim.physics.effects.places import MotionDrift


class IndexDrift(MotionDrift):
    """Drift of the vertical index: the head warms up and the zero of the elevation circle changes.

    The correction (true value minus reading) of the raw elevation is r t (with t from the start of the recording or of
    each station) or A exp(-t / tau). Here t is the time, r the rate, A the amplitude and tau the time constant. Reduced
    to face 1, the correction changes its sign with the face, as the vertical index does.

    Size: under 2 urad/h after the warm-up; tens of urad over two hours from cold.
    Similar to: vertical-index (correlation 0.63 in one face, 0.86 in two) and elevation-second-order cosine (0.84) if
    targets are measured in the order of their heights; station-settling.
    Separate by: a random order of the targets; a repeat of the first three targets at the end of each station; two
    faces.
    Validity: the same drift at every station, or a drift at one station; time constants of 10 min to 4 h.
    Source: Pollack Periodica 15(3), 2020, on the warm-up of a Leica AT960 (size); patents GB 2497910 B and US 8511891
    (the two-face error followed over time measures stability).
    Validation: validated against the vertical index at a given time, face parity and sign.
    """

    name = "index-drift"
    base_rate = 2.0
    light_path_stage = LightPathStage.ENCODERS
    observables = ("elevation",)
    chain_error_key = "elevation"
    rate_parameter = Parameter("index-drift", "urad/h", "growth rate of the index error", 20 * SI_PER_UNIT["urad/h"])
    decay_amplitude_parameter = Parameter(
        "index-drift-amplitude", "urad", "index error at the start, which then decays", 20 * MICRORADIAN
    )
    parameters = (rate_parameter,)

    candidate_linear_time_laws = ("linear", "visit")
    tries_single_stations = True
