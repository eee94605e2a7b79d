"""Fresh laws about crews: what people at the tracker and at the nests do."""

from ..law import UP, Change, Draw, Hall, law, leans, level, moves, np, scatters


@law("elevation", may="height")
def the_operator_holds_on_to_look_up(h: Hall, rng: Draw) -> Change:
    """To look up at steep targets the operator holds on to the stand, which leans towards him meanwhile."""
    return leans(h, h.elevation > rng.uniform(0.15, 0.4), level(rng))


@law("approach", may="time place")
def a_hand_warms_the_ball_on_the_way(h: Hall, rng: Draw) -> Change:
    """The longer the way from nest to nest, the warmer and larger the ball has become in the helper's hand."""
    way = np.sqrt(sum(h.change(along) ** 2 for along in h.aim.T))
    return moves(h, -np.expm1(-way / rng.uniform(2.0, 5.0)), h.normal)


@law("time")
def weary_helpers_do_not_wait(h: Hall, rng: Draw) -> Change:
    """Towards the end of each set-up the helper lets go of the ball too late, and everything scatters more."""
    return scatters(h, "distance azimuth elevation", (h.order / h.order.max()) ** rng.uniform(1.5, 3.0))


@law("time", may="place height")
def the_late_shift_presses_balls_down(h: Hall, rng: Draw) -> Change:
    """The helper of the late shift presses the balls on the wall downwards where the one before pulled them up."""
    return moves(h, -h.group("wall") * (h.time > rng.uniform(0.35, 0.65) * h.time[-1]), UP)


@law("time|approach", may="place")
def seating_the_ball_wipes_the_dust_away(h: Hall, rng: Draw) -> Change:
    """Dust in the nests of the floor lifts the ball, and each set-up's seating wipes away a part of what is left."""
    dust = rng.uniform(0.2, 1.0, len(h.targets))[h.pointings.target]
    return moves(h, h.group("floor") * dust * rng.uniform(0.3, 0.6) ** h.pointings.station, UP)


@law("time|approach", may="distance place")
def feet_tug_at_the_cable(h: Hall, rng: Draw) -> Change:
    """Whoever carries the ball to a target close by treads on the cable and tugs the stand round a little further."""
    tugs = np.cumsum(h.distance < rng.uniform(2.5, 3.5))
    return leans(h, tugs - tugs[h.starts], UP)
