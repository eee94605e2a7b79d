"""Fresh laws about what the tracker stands on."""

from ..law import UP, Change, Draw, Hall, law, leans, level, np, shifts


@law("time", may="place")
def the_crane_parks_beside_one_stand(h: Hall, rng: Draw) -> Change:
    """Whenever the crane's load hangs beside one stand the floor gives, and the stand leans until it is gone."""
    return leans(h, h.random_station(rng) * h.windows(rng), level(rng))


@law("press_load_kn", may="place time")
def the_press_bends_the_floor_under_the_stands(h: Hall, rng: Draw) -> Change:
    """The press pulls at its foundation, and the stands lean towards it, those near to it more."""
    press = np.array([rng.uniform(0.0, h.size.room[0]), rng.choice([0.0, h.size.room[1]]), 0.0])
    way = (press - h.stand) * [1.0, 1.0, 0.0]
    gap = np.sqrt((way**2).sum(axis=1))
    return leans(h, h.load * np.exp(-gap / rng.uniform(3.0, 6.0)), np.cross(UP, way / gap[:, None]))


@law("azimuth", may="place")
def one_leg_of_the_tripod_is_soft(h: Hall, rng: Draw) -> Change:
    """At one station a leg stands on a rubber mat; the heavy side of the head turns over it and the stand leans."""
    return leans(h, h.random_station(rng) * np.cos(h.circle - rng.uniform(-np.pi, np.pi)), level(rng))


@law("time", may="place")
def a_lifting_column_sinks_and_is_pumped_up(h: Hall, rng: Draw) -> Change:
    """The lifting column of one station leaks; it sinks until its control notices and pumps it up again."""
    cycle = rng.uniform(150.0, 500.0)
    return shifts(h, -h.random_station(rng) * np.mod(h.since_setup + rng.uniform(0.0, cycle), cycle) / cycle, UP)


@law("time", may="place")
def passing_forklifts_walk_one_stand_away(h: Hall, rng: Draw) -> Change:
    """Every forklift that passes shakes the stand of one station a little further on its smooth feet, or back."""
    return shifts(h, h.random_station(rng) * h.walk(rng), level(rng))


@law("distance", may="azimuth")
def the_false_floor_tips_under_the_operator(h: Hall, rng: Draw) -> Change:
    """The stands are on a false floor; it tips towards the operator when he places the ball near to the tracker."""
    way = (h.aim - h.stand) * [1.0, 1.0, 0.0]
    gap = np.sqrt((way**2).sum(axis=1))
    return leans(h, np.exp(-gap / rng.uniform(1.0, 2.5)), np.cross(UP, way / gap[:, None]))
