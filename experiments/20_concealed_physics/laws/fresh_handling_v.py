"""Fresh laws about people, what they carry and what they touch."""

from ..law import UP, Change, Draw, Hall, law, leans, moves, np, scatters, varies


def placed(h: Hall) -> np.ndarray:
    """(n,) 1 where the reflector was carried to another nest before the pointing, 0 where it stayed."""
    return np.diff(h.pointings.target, prepend=-1) != 0


@law("distance", may="place azimuth")
def the_boards_bend_towards_the_operator_beside_the_stand(h: Hall, rng: Draw) -> Change:
    """The stand is on a floor of boards; who places a reflector near by bends them, and the stand leans towards him."""
    near = np.exp(-h.distance / rng.uniform(0.8, 2.0))
    return leans(h, near, np.cross(UP, (h.aim - h.stand) / h.distance[:, None]))


@law("approach", may="time")
def the_reflector_is_still_warm_from_the_hand(h: Hall, rng: Draw) -> Change:
    """The longer the reflector was carried the warmer its mirrors are, and they cool while it rests in the nest."""
    carried = placed(h) * np.minimum(h.gap, rng.uniform(40.0, 120.0))
    return varies(h, "range-offset", h.fading(carried, rng.uniform(10.0, 60.0)) / 15.0)


@law("time", "height")
def the_second_shift_reaches_up_and_bends_down(h: Hall, rng: Draw) -> Change:
    """A shorter man takes over; he pushes reflectors up into nests above his shoulder, and down into those below."""
    later = h.time > h.time[-1] * rng.uniform(0.3, 0.7)
    push = np.tanh((h.aim[:, 2] - rng.uniform(1.2, 1.6)) / rng.uniform(0.3, 0.8))
    return moves(h, later * push * (h.group("wall") + h.group("gallery")), UP)


@law("approach|time", may="place")
def the_gallery_sags_the_longer_somebody_stands_on_it(h: Hall, rng: Draw) -> Change:
    """The boards of the gallery creep under whoever works his way along it, and recover when he has gone."""
    here = h.group("gallery")
    stayed = h.fading(here * np.minimum(h.gap, 20.0), rng.uniform(90.0, 500.0)) / 60.0
    return moves(h, here * stayed * np.sin(np.pi * h.aim[:, 0] / h.size.room[0]), -UP)


@law("time|approach")
def fingerprints_gather_until_the_mirrors_are_wiped(h: Hall, rng: Draw) -> Change:
    """Each handling leaves grease on the mirrors, and readings grow unsteady until the reflector is wiped again."""
    every = int(rng.integers(16, 50))
    handled = np.cumsum(placed(h)) + rng.integers(every)
    return scatters(h, "distance azimuth elevation", np.mod(handled, every) / every)


@law("approach|time", may="azimuth")
def an_unlocked_column_ratchets_round(h: Hall, rng: Draw) -> Change:
    """The column of one stand was not locked; wide turns of the head one way drag it round, those back slip."""
    wide, way = rng.uniform(0.3, 1.2), rng.choice([-1.0, 1.0])
    here = h.random_station(rng)
    return leans(h, here * np.cumsum(here * np.maximum(way * h.swing - wide, 0.0)), way * UP)
