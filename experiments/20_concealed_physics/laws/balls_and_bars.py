"""Laws about reflectors, their nests, and the bars whose length is known."""

from ..law import UP, Change, Draw, Hall, gauge, law, moves, np, reads, varies


@law("time", may="approach")
def hand_warms_the_tall_adaptor_of_the_ball(h: Hall, rng: Draw) -> Change:
    """The plastic adaptor that is carried along grows in the hand from nest to nest, and cools down in the breaks."""
    carried = np.diff(h.pointings.target, prepend=-1) != 0
    return moves(h, h.fading(carried, rng.uniform(200.0, 600.0)), h.normal)


@law("press_load_kn", may="place")
def balls_on_upright_nests_droop_as_the_press_hammers(h: Hall, rng: Draw) -> Change:
    """Balls in nests that look sideways are held by magnets alone, and droop while the press shakes the building."""
    return moves(h, (np.abs(h.normal[:, 2]) < 0.5) * h.load**2, -UP)


@law("time", "incidence")
def open_cube_is_replaced_by_a_glass_one(h: Hall, rng: Draw) -> Change:
    """In the course of the day the open reflector is replaced by a solid one, whose path grows with the incidence."""
    later = h.time > rng.uniform(0.3, 0.7) * h.time[-1]
    return reads(h, "distance", later * (1.0 - np.cos(h.incidence)) ** 2)


@law("approach", may="height time")
def ball_fogs_when_it_is_carried_up(h: Hall, rng: Draw) -> Change:
    """A ball that comes up from the cold floor fogs in the warm air above, and dries within minutes."""
    return reads(h, "distance", h.fading(np.maximum(0.0, h.change(h.aim[:, 2])), rng.uniform(40.0, 120.0)))


@law("incidence")
def rim_of_the_ball_cuts_the_beam(h: Hall, rng: Draw) -> Change:
    """Beyond a certain incidence the rim of the ball cuts one side of the beam, and the spot is held off the vertex."""
    cut = np.maximum(0.0, h.incidence - np.quantile(h.incidence, rng.uniform(0.4, 0.7)))
    return varies(h, "beam-offset-lateral", cut)


@law()
def level_bar_rests_on_its_ends(h: Hall, rng: Draw) -> Change:
    """The level bar was certified on its quarter points and rests on its ends: it sags, and its nests tip together."""
    return gauge(h, np.array([1.0, 0.0]))


@law()
def bars_carry_the_correction_of_each_other(h: Hall, rng: Draw) -> Change:
    """The thermal corrections of a steel and of a carbon bar were exchanged: one is stated too long, one too short."""
    return gauge(h, np.array([1.0, -1.0]) * h.lengths)


@law("time", may="temperature")
def bar_comes_cold_from_the_store(h: Hall, rng: Draw) -> Change:
    """One bar comes cold from the store: its far end is drawn in, and moves out as it takes the hall's warmth."""
    near, far = h.bars[rng.integers(len(h.bars))]
    way = h.pointings.points[far] - h.pointings.points[near]
    end = h.pointings.target == far
    return moves(h, -1.0 * end * np.exp(-h.time / rng.uniform(1500.0, 4000.0)), way / np.sqrt((way**2).sum()))
