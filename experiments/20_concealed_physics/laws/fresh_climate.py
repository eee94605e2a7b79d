"""Fresh laws about air and heat along the beam."""

from ..law import Change, Draw, Hall, law, np, reads, varies


def along(h: Hall) -> np.ndarray:
    """(n, 20, 3) Points along each beam."""
    share = (np.arange(20) + 0.5) / 20
    return h.stand[:, None, :] + share[None, :, None] * (h.aim - h.stand)[:, None, :]


@law("time", may="distance")
def the_air_conditioning_cycles(h: Hall, rng: Draw) -> Change:
    """The thermostat lets the air swing up and down within minutes, and the weather is entered once a set-up."""
    return varies(h, "range-scale", np.sin(2 * np.pi * (h.time / rng.uniform(500.0, 1800.0) + rng.random())))


@law("temperature", may="time distance")
def the_thermometer_in_its_housing_is_slow(h: Hall, rng: Draw) -> Change:
    """The thermometer of the weather station sits in a massive housing, so the range is corrected by an old value."""
    return varies(h, "range-scale", h.warmth - h.lagging(h.warmth, rng.uniform(900.0, 3600.0)))


@law("place", may="distance azimuth")
def one_end_of_the_hall_is_not_heated(h: Hall, rng: Draw) -> Change:
    """One end of the hall is colder than where the thermometer hangs, and ranges are wrong by the path in there."""
    border = rng.uniform(0.4, 0.6) * h.size.room[0]
    cold = 0.5 + 0.5 * np.tanh(rng.choice([-1.0, 1.0]) * (along(h)[:, :, 0] - border) / 0.7)
    return reads(h, "distance", h.distance * cold.mean(axis=1))


@law("time", "azimuth|place", may="distance")
def the_sun_on_the_wall_bends_beams_sideways(h: Hall, rng: Draw) -> Change:
    """For an hour or so the sun heats the end wall; the air is warmer towards it and bends beams that pass along it."""
    sun = np.exp(-(((h.time / h.time[-1] - rng.uniform(0.2, 0.8)) / rng.uniform(0.12, 0.25)) ** 2))
    return reads(h, "azimuth", sun * (h.aim - h.stand)[:, 1] / 6.0)


@law("time", "height|elevation|place", may="distance")
def cold_air_creeps_in_under_the_open_gate(h: Hall, rng: Draw) -> Change:
    """While the gate is open cold air lies on the floor, and ranges are wrong by the piece of path in it."""
    share = (along(h)[:, :, 2] < rng.uniform(0.6, 1.1)).mean(axis=1)
    return reads(h, "distance", h.windows(rng) * h.distance * share)


@law("time", "distance", may="elevation")
def warm_air_settles_in_layers_while_the_fans_rest(h: Hall, rng: Draw) -> Change:
    """While the ceiling fans rest the air sorts itself by warmth and bends beams; when they run it is mixed again."""
    still = h.lagging(h.windows(rng), rng.uniform(200.0, 700.0))
    return reads(h, "elevation", still * h.distance * np.cos(h.elevation) / 6.0)
