"""Laws about what makes readings scatter."""

from ..law import Change, Draw, Hall, law, np, scatters


@law("time")
def lathe_shakes_the_floor_while_it_cuts(h: Hall, rng: Draw) -> Change:
    """While a lathe next door cuts the floor shakes, and the angles scatter; hardly so while it idles."""
    return scatters(h, "azimuth elevation", 0.03 + h.windows(rng))


@law("approach", may="time")
def head_still_rings_after_a_long_turn(h: Hall, rng: Draw) -> Change:
    """The reading is triggered too soon: after a long turn the head still rings, less the longer it had to come."""
    return scatters(h, "azimuth", h.swing**2 * np.exp(-h.gap / rng.uniform(5.0, 15.0)))


@law("incidence")
def oblique_balls_send_back_too_little_light(h: Hall, rng: Draw) -> Change:
    """A ball that is seen obliquely shows less of its opening, and with less light the range scatters."""
    return scatters(h, "distance", np.minimum(1.0 / np.maximum(np.cos(h.incidence), 0.1) ** 2 - 1.0, 20.0))


@law("time", may="height place")
def people_walk_on_the_gallery_in_their_shift(h: Hall, rng: Draw) -> Change:
    """During a shift people walk on the gallery, and its targets shake in all directions."""
    return scatters(h, "distance azimuth elevation", h.group("gallery") * h.windows(rng))


@law("temperature")
def fan_of_the_head_speeds_up_when_it_is_warm(h: Hall, rng: Draw) -> Change:
    """About a certain temperature the fan of the head speeds up, and its air trembles before the scope."""
    warm = h.warmth - np.quantile(h.warmth, rng.uniform(0.4, 0.7))
    return scatters(h, "elevation distance", 1.0 / (1.0 + np.exp(-warm / 0.1)))
