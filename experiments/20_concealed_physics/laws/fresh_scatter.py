"""Fresh laws about noise."""

from ..law import Change, Draw, Hall, law, np, scatters


@law("incidence")
def a_ball_turned_aside_returns_little_light(h: Hall, rng: Draw) -> Change:
    """Where the ball is turned far from the beam its aperture is small, and the distance meter scatters more."""
    return scatters(h, "distance", np.clip(h.incidence - rng.uniform(0.4, 0.8), 0.0, None) ** 2)


@law("time")
def a_compressor_shakes_the_hall(h: Hall, rng: Draw) -> Change:
    """While a compressor runs everything trembles, and the angles scatter more."""
    return scatters(h, "azimuth elevation", h.windows(rng))


@law("approach", may="azimuth")
def the_head_still_swings_after_a_long_turn(h: Hall, rng: Draw) -> Change:
    """After a long turn the head has not come to rest when it is read, and its azimuth scatters the more."""
    return scatters(h, "azimuth", (np.abs(h.swing) / np.pi) ** rng.uniform(1.0, 2.0))


@law(may="place height")
def the_gallery_trembles(h: Hall, rng: Draw) -> Change:
    """The gallery carries a fan, and what is measured on it scatters in all directions."""
    return scatters(h, "distance azimuth elevation", h.group("gallery"))


@law("distance")
def the_ball_is_put_down_no_better_than_some_micrometres(h: Hall, rng: Draw) -> Change:
    """A hasty hand puts the ball into its nest with some micrometres of play, which near targets show as angles."""
    return scatters(h, "azimuth elevation", (2.0 / h.distance) ** 2)


@law("time")
def fingerprints_gather_on_the_mirrors(h: Hall, rng: Draw) -> Change:
    """Nobody cleans the ball all day; its mirrors grow dull, and the distances scatter ever more."""
    return scatters(h, "distance", (h.time / h.time[-1]) ** rng.uniform(1.0, 2.5))
