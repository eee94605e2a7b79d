"""Fresh laws about receivers, clocks, motors and sensors."""

from ..law import Change, Draw, Hall, law, leans, np, reads, scatters, varies


@law("distance")
def near_returns_overload_the_receiver(h: Hall, rng: Draw) -> Change:
    """The receiver of the distance meter is overloaded by the light of near reflectors, and its phase is late."""
    return reads(h, "distance", 1.0 / (1.0 + (h.distance / rng.uniform(1.2, 3.0)) ** rng.uniform(2.0, 4.0)))


@law("approach", may="elevation time face")
def the_tipping_motor_warms_its_end_of_the_transit_axis(h: Hall, rng: Draw) -> Change:
    """The motor sits at one end of the transit axis; its heat from tipping the head lifts that end until it cools."""
    tip = np.where(h.back > 0, np.pi - h.elevation, h.elevation)
    heat = h.fading(np.abs(h.change(tip)), rng.uniform(200.0, 900.0))
    return varies(h, "transit-tilt", rng.choice([-1.0, 1.0]) * heat)


@law("time")
def the_oven_of_the_clock_switches_on_and_off(h: Hall, rng: Draw) -> Change:
    """The oven of the crystal is switched by a thermostat; its frequency, hence the scale, climbs and falls with it."""
    cycle, heating = rng.uniform(700.0, 2000.0), rng.uniform(0.2, 0.5)
    phase = np.mod(h.time / cycle + rng.random(), 1.0)
    warmth = np.where(phase < heating, phase / heating, (1.0 - phase) / (1.0 - heating))
    return varies(h, "range-scale", warmth)


@law("azimuth", may="face")
def one_of_two_read_heads_is_blind_over_an_arc(h: Hall, rng: Draw) -> Change:
    """Where the circle is smeared one of two opposite heads drops out, and the other alone reads its eccentricity."""
    middle, half, centre = rng.uniform(-np.pi, np.pi), rng.uniform(0.4, 1.0), rng.uniform(-np.pi, np.pi)
    blind = np.cos(h.circle - middle) > np.cos(half)
    return reads(h, "azimuth", blind * np.cos(h.circle - centre))


@law("press_load_kn")
def the_press_drags_down_the_mains_of_the_distance_meter(h: Hall, rng: Draw) -> Change:
    """Above a certain load of the press the mains sink below what the supply of the distance meter can smooth."""
    return scatters(h, "distance", np.maximum(h.load - rng.uniform(0.3, 0.7), 0.0))


@law("approach", may="azimuth time face")
def the_liquid_of_the_level_sloshes_after_a_turn(h: Hall, rng: Draw) -> Change:
    """The liquid of the level in the head is left behind by a turn, and the readings are levelled with it."""
    ahead = h.circle + h.yaw[h.pointings.station]
    axis = np.column_stack([np.cos(ahead), np.sin(ahead), np.zeros(h.n)])
    return leans(h, h.fading(h.swing, rng.uniform(8.0, 40.0)), rng.choice([-1.0, 1.0]) * axis)
