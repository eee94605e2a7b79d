"""Laws about readings that scatter more than they should, and about lengths that are not what their papers say."""

from ..law import Change, Draw, Hall, gauge, law, np, scatters


@law("press_load_kn", may="time")
def the_press_hammers_through_the_floor(h: Hall, rng: Draw) -> Change:
    """A press that is hard at work hammers, and everything that stands on the floor trembles."""
    return scatters(h, "azimuth elevation", np.maximum(h.load - rng.uniform(0.2, 0.5), 0.0) ** rng.uniform(0.7, 1.5))


@law("time", "distance")
def the_window_is_fogged_when_it_comes_from_the_yard(h: Hall, rng: Draw) -> Change:
    """The tracker comes in from the cold yard and its window fogs over; until it has cleared, far ranges are ragged."""
    clear = np.exp(-h.since_setup / (rng.uniform(0.15, 0.4) * h.since_setup.max()))
    return scatters(h, "distance", clear * (h.distance / h.distance.max()) ** 2)


@law("time", "place", may="azimuth distance")
def arcs_flash_in_the_welding_bay(h: Hall, rng: Draw) -> Change:
    """At one end of the hall there is welding from time to time; whatever is looked at there then jumps about."""
    border = rng.uniform(0.35, 0.65) * h.size.room[0]
    beyond = h.aim[:, 0] > border if rng.random() < 0.5 else h.aim[:, 0] < border
    return scatters(h, "distance azimuth elevation", h.windows(rng) * beyond)


@law("height", "distance", may="place elevation")
def a_ball_on_a_pole_trembles(h: Hall, rng: Draw) -> Change:
    """High targets are touched with a ball on a pole, which trembles aside by so much.

    From close by this is a wide angle.
    """
    high = np.maximum(h.aim[:, 2] - rng.uniform(0.3, 0.45) * h.size.room[2], 0.0)
    return scatters(h, "azimuth elevation", (high / h.distance) ** 2)


@law("elevation|height", may="height elevation")
def the_balanced_head_hunts(h: Hall, rng: Draw) -> Change:
    """Near one elevation the head is in balance and nothing loads the gears.

    There its drive hunts to and fro in the play.
    """
    middle, width = np.quantile(h.elevation, rng.uniform(0.3, 0.7)), rng.uniform(0.1, 0.25)
    return scatters(h, "elevation", np.exp(-0.5 * ((h.elevation - middle) / width) ** 2))


@law("time|approach", may="time approach")
def hasty_pointings_are_ragged(h: Hall, rng: Draw) -> Change:
    """Whoever presses the key soon after the pointing before gets few samples into the mean, and a ragged reading."""
    return scatters(h, "distance azimuth elevation", np.exp(-np.maximum(h.gap - 9.0, 0.0) / rng.uniform(1.5, 4.0)))


@law()
def the_upright_bar_was_certified_lying_down(h: Hall, rng: Draw) -> Change:
    """Both bars were measured lying on a bench.

    The one that stands is pressed together by its own weight and its foot.
    """
    return gauge(h, np.array([0.0, 1.0]))


@law()
def the_corrections_of_the_two_bars_are_swapped(h: Hall, rng: Draw) -> Change:
    """The certificate gives both bars as a nominal length with a correction.

    Somebody copied each correction to the other.
    """
    return gauge(h, np.array([1.0, -1.0]))
