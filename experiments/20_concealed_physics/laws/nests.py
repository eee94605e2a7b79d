"""Fresh laws about balls, nests, adapters and what carries them."""

from ..law import OUT, UP, Change, Draw, Hall, law, moves, np, reads, scatters


def _placed(h: Hall) -> np.ndarray:
    """Row at which the ball was put into the nest that each pointing looks at."""
    new = (np.diff(h.pointings.target, prepend=-1) != 0) | (h.order == 0)
    return np.maximum.accumulate(np.where(new, np.arange(h.n), 0))


@law("time")
def glue_creeps_on_the_wall(h: Hall, rng: Draw) -> Change:
    """The nests on the wall were glued this morning and slide down ever more slowly."""
    return moves(h, h.group("wall") * np.log1p(h.time / rng.uniform(300.0, 1500.0)), -UP)


@law("time", "place")
def the_gallery_bows_through_the_day(h: Hall, rng: Draw) -> Change:
    """Lamps warm the lower flange of the gallery's beam, whose middle sinks through the day."""
    middle = np.sin(np.pi * h.aim[:, 0] / h.size.room[0])
    return moves(h, h.group("gallery") * middle * h.time / 3600.0, -UP)


@law("incidence")
def a_window_covers_the_reflector(h: Hall, rng: Draw) -> Change:
    """The reflectors have a glass window that looks out of the nest, and slanting light has a longer way in it."""
    sine, cosine = np.sin(h.incidence), np.cos(h.incidence)
    return reads(h, "distance", np.sqrt(2.25 - sine**2) - cosine)


@law("time")
def nests_wear_with_every_visit(h: Hall, rng: Draw) -> Change:
    """Each time the ball is put in it scrapes its nest a little deeper, soft nests more than hard ones."""
    hardness = rng.uniform(0.0, 2.0, len(h.targets))[h.pointings.target]
    return moves(h, -hardness * h.pointings.station, h.normal)


@law("time")
def grease_is_squeezed_out_of_new_nests(h: Hall, rng: Draw) -> Change:
    """The nests on the table were greased, and the ball floats higher at the first visits than at later ones."""
    return moves(h, h.group("table") * np.exp(-h.pointings.station / rng.uniform(0.7, 1.5)), h.normal)


@law("approach", may="place time")
def the_ball_is_pushed_the_way_one_walks(h: Hall, rng: Draw) -> Change:
    """The operator presses the ball against the side of the nest that he walks towards from the nest before."""
    put = _placed(h)
    way = h.aim[put] - h.aim[np.maximum(put - 1, 0)]
    return moves(h, np.ones(h.n), way / np.maximum(np.sqrt((way**2).sum(axis=1)), 0.1)[:, None])


@law("approach|time", may="face")
def the_ball_is_warm_from_the_hand(h: Hall, rng: Draw) -> Change:
    """The ball comes warm from the hand and its mirrors move back while it cools in the nest."""
    return reads(h, "distance", np.exp(-(h.time - h.time[_placed(h)]) / rng.uniform(8.0, 25.0)))


@law("press_load_kn", may="time")
def the_table_sinks_with_the_press(h: Hall, rng: Draw) -> Change:
    """The table stands on the foundation of the press and sinks with its load."""
    return moves(h, h.group("table") * h.load, -UP)


@law("temperature", may="time")
def the_table_slides_in_jerks(h: Hall, rng: Draw) -> Change:
    """The table grows with the temperature against dry friction and slides along in jerks."""
    step = np.ptp(h.warmth) / rng.uniform(2.5, 4.5)
    return moves(h, h.group("table") * np.floor(h.warmth / step + rng.random()), OUT)


@law("distance")
def the_mirrors_meet_beside_the_centre(h: Hall, rng: Draw) -> Change:
    """The mirrors of the ball do not meet in its centre, and as it is put in any way round near angles scatter most."""
    return scatters(h, "azimuth elevation", 1.0 / h.distance**2)


@law("time")
def a_chip_sticks_to_the_ball(h: Hall, rng: Draw) -> Change:
    """A chip sticks to the ball for a while and lifts it out of every nest until somebody wipes it off."""
    first = rng.uniform(0.15, 0.6)
    some = (h.time > first * h.time[-1]) & (h.time < (first + rng.uniform(0.15, 0.3)) * h.time[-1])
    return moves(h, np.where(some, 1.0, 0.01), h.normal)


@law("place|height")
def another_ball_lives_on_the_gallery(h: Hall, rng: Draw) -> Change:
    """To spare the climb a second ball is left on the gallery, and its mirrors lie deeper."""
    return reads(h, "distance", h.group("gallery"))


@law("time")
def dust_gathers_until_the_ball_is_wiped(h: Hall, rng: Draw) -> Change:
    """Dust on the mirrors lengthens the distance until the operator wipes the ball after some number of pointings."""
    wiped = rng.integers(12, 40)
    return reads(h, "distance", np.mod(h.order, wiped) / wiped)


@law("time", "place")
def a_fork_lift_dents_its_lane(h: Hall, rng: Draw) -> Change:
    """A fork lift drives along one lane, and floor nests beside it are pressed down a little more at each pass."""
    lane = np.exp(-np.abs(h.aim[:, 1] - rng.uniform(0.2, 0.8) * h.size.room[1]) / 1.2)
    return moves(h, h.group("floor") * lane * np.floor(h.time / rng.uniform(1200.0, 2400.0)), -UP)


@law("time", may="height")
def a_draught_swings_the_hanging_wall(h: Hall, rng: Draw) -> Change:
    """The wall is a hung panel, and while the ventilation blows it is pushed out, at the foot most."""
    free = 1.0 - h.aim[:, 2] / h.size.room[2]
    return moves(h, h.group("wall") * free * h.windows(rng), OUT)
