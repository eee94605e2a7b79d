"""Fresh laws about the laser, the receiver and the electronics of a tracker."""

from ..law import Change, Draw, Hall, law, np, scatters, varies


@law("time")
def an_oven_of_the_reference_hunts(h: Hall, rng: Draw) -> Change:
    """The thermostat of one tracker's frequency reference lets it cool slowly and heats it at once, over and over."""
    period = rng.uniform(1500.0, 3600.0)
    saw = np.mod(h.time / period + rng.random(), 1.0) - 0.5
    return varies(h, "range-scale", h.random_tracker(rng) * saw)


@law("distance", "incidence")
def the_delay_of_the_diode_depends_on_light(h: Hall, rng: Draw) -> Change:
    """The receiver's delay goes with the logarithm of the returned light, less at long range and oblique incidence."""
    fall = rng.uniform(2.0, 4.0)
    light = -2.0 * np.log(h.distance) + fall * np.log(np.clip(np.cos(h.incidence), 0.1, 1.0))
    return varies(h, "range-offset", light)


@law("approach", may="distance")
def the_receiver_remembers_a_bright_return(h: Hall, rng: Draw) -> Change:
    """After a near, bright reflector the receiver's amplifier is still saturated and delays the next range."""
    bright = h.distance ** -rng.uniform(1.5, 2.0)
    before = np.where(h.order > 0, bright - h.change(bright), 0.0)
    return varies(h, "range-offset", 10.0 * before)


@law("distance", may="approach")
def the_focusing_carriage_jumps_its_notch(h: Hall, rng: Draw) -> Change:
    """The lens carriage goes to its far notch beyond one distance, back below a smaller one; they are not in line."""
    low = rng.uniform(0.7, 0.9) * np.median(h.distance)
    return varies(h, "beam-tilt", h.latched(h.distance, low, low + rng.uniform(0.5, 1.2)))


@law("time")
def a_furnace_next_door_pulls_the_supply_down(h: Hall, rng: Draw) -> Change:
    """While an induction furnace runs the supply sags: the range electronics and the elevation read head both shift."""
    on = h.windows(rng)
    return varies(h, "range-offset", rng.uniform(2.0, 5.0) * on) + varies(h, "vertical-index", on)


@law("azimuth", may="face")
def a_fingerprint_on_the_azimuth_circle(h: Hall, rng: Draw) -> Change:
    """Over a fingerprint on one tracker's azimuth circle its read head gets little light and reads noisily."""
    own = (h.pointings.tracker == 0).astype(np.float64)
    away = np.abs(np.angle(np.exp(1j * (h.circle - rng.uniform(-np.pi, np.pi)))))
    return scatters(h, "azimuth", own / (1.0 + (away / rng.uniform(0.35, 0.7)) ** 6))
