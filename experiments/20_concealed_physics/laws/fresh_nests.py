"""Fresh laws about balls and nests."""

from ..law import UP, Change, Draw, Hall, law, level, moves, np, reads


def one_target(h: Hall, rng: Draw) -> np.ndarray:
    """1 where a target that is drawn is measured."""
    return (h.pointings.target == rng.integers(len(h.targets))).astype(float)


@law("time", may="approach place")
def the_ball_sits_otherwise_in_one_nest_at_each_visit(h: Hall, rng: Draw) -> Change:
    """One nest has a burr, and each time that the ball is put there it rests at another height."""
    height = rng.standard_normal((len(h.stations), 3))[h.pointings.station, h.pointings.repeat]
    return moves(h, one_target(h, rng) * height, h.normal)


@law(may="place azimuth height")
def pin_nests_on_the_floor_are_pulled_towards_the_tracker(h: Hall, rng: Draw) -> Change:
    """The pins of the floor nests have play; the operator turns the ball to the tracker and draws the nest along."""
    way = (h.stand - h.aim) * [1.0, 1.0, 0.0]
    return moves(h, h.group("floor"), way / np.sqrt((way**2).sum(axis=1))[:, None])


@law("time")
def the_ball_warms_in_the_hand(h: Hall, rng: Draw) -> Change:
    """The ball is cold after a break and warms in the operator's hand, so that its mirrors move along the beam."""
    return reads(h, "distance", 1.0 - np.exp(-h.since_setup / rng.uniform(150.0, 600.0)))


@law("temperature", may="time place")
def one_nest_sits_on_a_long_plastic_bracket(h: Hall, rng: Draw) -> Change:
    """One nest is screwed to a long plastic bracket, which stretches with the temperature, a little late."""
    return moves(h, one_target(h, rng) * h.lagging(h.warmth, rng.uniform(200.0, 1200.0)), level(rng))


@law("incidence", may="place azimuth")
def the_ball_rolls_down_on_the_wall_as_it_is_turned(h: Hall, rng: Draw) -> Change:
    """The magnets of the wall nests are weak: a ball that is turned far aside has less hold and slips down."""
    return moves(h, h.group("wall") * np.sin(h.incidence) ** rng.uniform(2.0, 4.0), -UP)


@law("time", may="place")
def dust_gathers_in_the_nests_until_they_are_wiped(h: Hall, rng: Draw) -> Change:
    """Grinding dust gathers in the nests of one area and lifts the ball; from time to time somebody wipes them."""
    group, cycle = str(rng.choice(["floor", "table"])), rng.uniform(0.4, 0.8) * h.time[-1]
    return moves(h, h.group(group) * np.mod(h.time + rng.uniform(0.0, cycle), cycle) / cycle, h.normal)
