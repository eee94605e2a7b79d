"""Laws about scatter."""

from ..law import Change, Draw, Hall, law, np, scatters


@law("time", "place")
def a_fan_shakes_the_gallery(h: Hall, rng: Draw) -> Change:
    """While the fan that hangs from it runs the gallery shakes, and its targets with it."""
    return scatters(h, "azimuth elevation", h.group("gallery") * h.windows(rng))


@law("press_load_kn")
def the_press_makes_the_heads_tremble(h: Hall, rng: Draw) -> Change:
    """The shaking that comes through the floor grows with the force of the press, and the head trembles."""
    return scatters(h, "azimuth elevation", h.load**2)


@law("elevation")
def the_azimuth_drive_hunts_at_steep_lines(h: Hall, rng: Draw) -> Change:
    """The steeper the line, the farther the azimuth drive must turn for the same spot, and the more it hunts."""
    return scatters(h, "azimuth", np.tan(h.elevation) ** 2)


@law("approach", may="face")
def the_head_still_swings_after_a_long_way(h: Hall, rng: Draw) -> Change:
    """A reading that follows a wide turn of the head is taken before its swinging has died away."""
    return scatters(h, "azimuth", (0.5 - 0.5 * np.cos(h.swing)) ** 2)


@law("incidence")
def slanted_reflectors_send_little_back(h: Hall, rng: Draw) -> Change:
    """Seen from the side a reflector has less open area, and its range gets noisy with so weak a return."""
    return scatters(h, "distance", 1.0 / np.maximum(np.cos(h.incidence), 0.25) ** 2 - 1.0)


@law("time|approach")
def hurried_pointings_are_noisy(h: Hall, rng: Draw) -> Change:
    """Where the key is pressed soon after the reading before, the reflector has not come to rest."""
    return scatters(h, "distance azimuth elevation", np.exp(-np.maximum(h.gap - 9.0, 0.0) / rng.uniform(1.5, 3.5)))
