"""Fresh laws about the habits of those who measure."""

from ..law import UP, Change, Draw, Hall, law, leans, level, moves, np, scatters, shifts, varies


@law("time", "height", may="place")
def arms_tire_above_the_head(h: Hall, rng: Draw) -> Change:
    """Arms tire in the course of a set-up, and balls above the head are pressed into their nests less and less."""
    return moves(h, np.clip(h.aim[:, 2] - rng.uniform(1.2, 1.9), 0.0, None) * h.since_setup / 600.0, h.normal)


@law("time", "place|height")
def a_colleague_seats_the_second_round(h: Hall, rng: Draw) -> Change:
    """A colleague seats every second round and pushes the table's balls against the other side of their nests."""
    if h.pointings.repeat.max() < 2:
        raise LookupError("one round only")
    return moves(h, h.group("table") * (h.pointings.repeat == 2), level(rng))


@law("elevation|height", may="place distance")
def kneeling_on_the_foot_of_the_stand(h: Hall, rng: Draw) -> Change:
    """Somebody kneels on one stand's foot to follow the beam down; it tips and sinks the lower the beam goes."""
    down = h.random_station(rng) * np.clip(-h.elevation - rng.uniform(0.0, 0.15), 0.0, None)
    return leans(h, down, level(rng)) + shifts(h, rng.uniform(0.2, 0.6) * down, -UP)


@law("time")
def restless_start_of_each_set_up(h: Hall, rng: Draw) -> Change:
    """Helpers walk around the stand as each set-up begins, and the angles scatter until they have gone."""
    return scatters(h, "azimuth elevation", np.exp(-h.order / rng.uniform(4.0, 15.0)))


@law("place|azimuth")
def table_nests_swivel_about_a_wrong_pivot(h: Hall, rng: Draw) -> Change:
    """The table's nests are swivelled by hand to look at the tracker, about a pivot that misses the ball."""
    away, turn = (h.stand - h.aim)[:, :2], rng.uniform(0.6, 2.5) * rng.choice([-1.0, 1.0])
    bearing = np.arctan2(away[:, 1], away[:, 0]) + turn
    return moves(h, h.group("table"), np.column_stack([np.cos(bearing), np.sin(bearing), np.zeros(h.n)]))


@law()
def carried_by_the_yoke_to_one_station(h: Hall, rng: Draw) -> Change:
    """Carried by its yoke to one station, the tracker keeps a bent transit axis until the next way eases it."""
    return varies(h, "transit-tilt", h.random_station(rng))
