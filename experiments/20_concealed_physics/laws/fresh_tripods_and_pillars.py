"""Fresh laws about tripods, pillars and what holds a tracker up."""

from ..law import UP, Change, Draw, Hall, law, leans, level, np


@law("approach", may="time azimuth")
def the_column_untwists_after_a_slew(h: Hall, rng: Draw) -> Change:
    """A slew twists the column of a stand by its reaction, and it untwists slowly, over several pointings."""
    return leans(h, -h.fading(h.swing, rng.uniform(25.0, 80.0)), UP)


@law("azimuth", may="place")
def legs_carry_the_head_in_three_directions(h: Hall, rng: Draw) -> Change:
    """The head's weight lies forward: it nods less over one of the three legs than between two of them."""
    ahead = h.aim - h.stand
    bearing = np.arctan2(ahead[:, 1], ahead[:, 0])
    aside = np.column_stack([-np.sin(bearing), np.cos(bearing), np.zeros(h.n)])
    return leans(h, np.cos(3.0 * h.azimuth + rng.uniform(-np.pi, np.pi)), aside)


@law("distance|place", may="distance place height")
def a_floor_panel_tips_under_the_operator(h: Hall, rng: Draw) -> Change:
    """One stand is on a raised floor; when the operator holds near reflectors he steps on its panel and tips it."""
    near = h.distance < rng.uniform(2.6, 4.0)
    return leans(h, h.random_station(rng) * near, level(rng))


@law("time")
def the_level_is_refreshed_now_and_then(h: Hall, rng: Draw) -> Change:
    """Stands lean on steadily, and the firmware takes the level afresh after a fixed number of pointings only."""
    every = int(rng.integers(9, 20))
    return leans(h, np.mod(h.order, every) / every, level(rng))


@law("approach", may="time")
def a_clamp_stores_strain_and_lets_go(h: Hall, rng: Draw) -> Change:
    """Tipping the head strains the clamp of the mount bit by bit, until it lets go with a click and begins again."""
    travel = np.cumsum(np.abs(h.change(h.elevation)))
    travel -= travel[h.starts]
    hold = rng.uniform(2.0, 5.0)
    return leans(h, np.mod(travel / hold, 1.0), level(rng))


@law("press_load_kn", may="place")
def stands_lean_towards_the_pit_of_the_press(h: Hall, rng: Draw) -> Change:
    """The press pulls the floor down around its pit, so stands lean towards it with the load, the nearer the more."""
    length, width, _ = h.size.room
    pit = np.array([rng.uniform(0.2, 0.8) * length, rng.uniform(0.2, 0.8) * width, 0.0])
    way = (pit - h.stand) * [1.0, 1.0, 0.0]
    gap = np.sqrt((way**2).sum(axis=1))
    return leans(h, h.load * 3.0 / (gap + 1.0), np.cross(UP, way / gap[:, None]))
