"""Fresh laws about reflectors, nests and what they are fixed to."""

from ..law import UP, Change, Draw, Hall, law, level, moves, np


@law("time", "place|height")
def coolant_film_builds_up_in_floor_nests(h: Hall, rng: Draw) -> Change:
    """Every round drags coolant into the floor nests, whose film lifts the ball more each time until it is full."""
    rounds = np.unique(2 * h.pointings.station + h.pointings.repeat, return_inverse=True)[1]
    return moves(h, h.group("floor") * (1.0 - np.exp(-rounds / rng.uniform(1.0, 4.0))), h.normal)


@law("approach", may="place distance")
def ball_is_warmed_by_the_hand_on_the_way(h: Hall, rng: Draw) -> Change:
    """The hand that carries the ball warms it, and it stands out the more the longer the way to the nest was."""
    way = np.sqrt((np.diff(h.aim, axis=0, prepend=h.aim[:1]) ** 2).sum(axis=1)) * (h.order > 0)
    return moves(h, 1.0 - np.exp(-way / rng.uniform(2.0, 6.0)), h.normal)


@law("time", "place", may="height")
def hot_glue_of_the_wall_nests_creeps(h: Hall, rng: Draw) -> Change:
    """The hot glue of the wall nests creeps under their weight, fast at first and by the logarithm of time later."""
    return moves(h, h.group("wall") * np.log1p(h.time / rng.uniform(200.0, 1500.0)), -UP)


@law("approach|time|face")
def grease_is_squeezed_out_under_the_ball(h: Hall, rng: Draw) -> Change:
    """A ball put on greased seats sinks while the grease is squeezed out; the first pointing sees it highest."""
    fresh = (np.diff(h.pointings.target, prepend=-1) != 0) | (h.order == 0)
    since = h.time - h.time[np.maximum.accumulate(np.where(fresh, np.arange(h.n), 0))]
    return moves(h, np.exp(-since / rng.uniform(8.0, 30.0)), h.normal)


@law("press_load_kn", "place", may="height")
def table_rocks_on_its_feet(h: Hall, rng: Draw) -> Change:
    """The table has a soft foot, and as the press loads the floor the table rocks, one side up and one side down."""
    on = h.group("table")
    arm = (h.aim - h.aim[on > 0].mean(axis=0)) @ level(rng)
    return moves(h, on * h.load * arm, UP)


@law("incidence")
def cracked_corners_of_some_balls(h: Hall, rng: Draw) -> Change:
    """Some balls have a crack along a mirror edge, and the askew beam that crosses it goes a longer way."""
    some = np.isin(h.pointings.target, rng.choice(len(h.targets), rng.integers(3, 7), replace=False))
    return moves(h, some * h.incidence**2, (h.aim - h.stand) / h.distance[:, None])
