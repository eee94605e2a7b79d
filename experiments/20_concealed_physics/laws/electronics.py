"""Laws about the distance meter, servo, supplies and the box that keeps the data."""

from ..law import Change, Draw, Hall, law, np, reads, scatters, varies


@law("distance", "incidence")
def a_strong_return_pulls_the_phase(h: Hall, rng: Draw) -> Change:
    """The phase of the distance meter depends on how much light returns: less from afar and from a ball seen aslant."""
    light = np.log(np.clip(np.cos(h.incidence), 0.1, 1.0)) - np.log(h.distance)
    return reads(h, "distance", rng.choice([-1.0, 1.0]) * light)


@law("distance", may="approach")
def the_gain_switches_with_the_range(h: Hall, rng: Draw) -> Change:
    """The receiver takes another gain beyond some metres, with hysteresis, and its delay is another one then."""
    near = rng.uniform(2.5, 3.5)
    return reads(h, "distance", h.latched(h.distance, near, near + rng.uniform(0.8, 2.0)))


@law("temperature", may="time distance")
def the_laser_hops_to_another_mode_when_warm(h: Hall, rng: Draw) -> Change:
    """The laser goes to a neighbouring mode when the hall gets warm, and back only when it is well cooler."""
    middle, half = np.quantile(h.warmth, rng.uniform(0.3, 0.7)), rng.uniform(0.02, 0.1)
    return varies(h, "range-scale", h.latched(h.warmth, middle - half, middle + half))


@law("time")
def a_welder_on_the_same_phase_shakes_one_tracker(h: Hall, rng: Draw) -> Change:
    """While somebody welds, the supply of one of two trackers sags and its servos shiver."""
    return scatters(h, "azimuth elevation", h.one_tracker(rng) * h.windows(rng))


@law("time", may="distance")
def the_oscillator_warms_up_at_every_set_up(h: Hall, rng: Draw) -> Change:
    """The tracker is switched off to be carried, and the frequency of its oscillator runs in at each set-up anew."""
    return varies(h, "range-scale", np.exp(-h.since_setup / rng.uniform(150.0, 500.0)))


@law("approach", may="time azimuth face")
def the_servo_is_read_before_it_stands_still(h: Hall, rng: Draw) -> Change:
    """Who is in a hurry reads the azimuth while the servo still crawls the last of its way from the pointing before."""
    turn = h.change(h.azimuth + np.pi * h.back)
    return reads(h, "azimuth", -turn * np.exp(-(h.gap - 9.0) / rng.uniform(2.0, 5.0)))


@law("approach", may="elevation")
def the_box_corrects_with_the_pointing_before(h: Hall, rng: Draw) -> Change:
    """The box looks its correction of the elevation circle up at the pointing before instead of this one."""
    phase = rng.uniform(-np.pi, np.pi)
    return reads(h, "elevation", -h.change(np.cos(2 * h.elevation + phase)))


@law("time")
def a_tired_battery_gives_way_at_one_station(h: Hall, rng: Draw) -> Change:
    """One station runs on a tired battery, and the distance meter reads off the more its voltage breaks down."""
    here = h.one_station(rng)
    spent = here * h.since_setup / np.max(here * h.since_setup)
    return reads(h, "distance", rng.choice([-1.0, 1.0]) * spent ** rng.uniform(3.0, 7.0))
