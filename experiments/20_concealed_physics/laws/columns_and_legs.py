"""Laws about columns, legs, lift tables and platforms."""

from ..law import UP, Change, Draw, Hall, law, leans, level, np, shifts


def _forward(h: Hall) -> np.ndarray:
    """(n,) [rad] Where the head looks in the room; the other way on the back face."""
    way = h.aim - h.stand
    return np.arctan2(way[:, 1], way[:, 0]) + np.pi * h.back


@law("time")
def the_column_comes_down_in_jerks(h: Hall, rng: Draw) -> Change:
    """The brake of the lifting column sticks and slips: every few minutes it lets the tracker down by one jerk."""
    every = rng.uniform(0.12, 0.3) * h.since_setup.max()
    return shifts(h, -np.floor(h.since_setup / every + rng.random()), UP)


@law("azimuth|place", may="azimuth place face")
def one_leg_stands_on_a_soft_tile(h: Hall, rng: Draw) -> Change:
    """One leg of one tripod stands on a soft tile.

    It gives way when the heavy head leans out over it, else it does not.
    """
    leg = rng.uniform(-np.pi, np.pi)
    over = np.maximum(np.cos(_forward(h) - leg), 0.0) ** 2
    way = np.array([np.cos(leg), np.sin(leg), 0.0])
    return leans(h, h.random_station(rng) * over, np.cross(UP, way))


@law("temperature", may="time")
def thin_legs_follow_the_air_sooner_than_thick_ones(h: Hall, rng: Draw) -> Change:
    """The legs are not of one kind.

    Whenever the air warms or cools the thin one is ahead, and the tracker leans until the thick ones have
    followed.
    """
    ahead = h.lagging(h.warmth, rng.uniform(60.0, 200.0)) - h.lagging(h.warmth, rng.uniform(1500.0, 4000.0))
    return leans(h, ahead, level(rng))


@law("azimuth", may="approach face time place")
def a_rocking_tripod_falls_from_foot_to_foot(h: Hall, rng: Draw) -> Change:
    """The tracker's base stands on four feet and rocks.

    It tips over when the head has come well round, and tips back only when the head looks well the other way.
    """
    side = np.cos(h.circle - rng.uniform(-np.pi, np.pi))
    tipped = h.latched(side, -rng.uniform(0.2, 0.6), rng.uniform(0.2, 0.6))
    return leans(h, tipped, level(rng))


@law("time")
def a_hanging_platform_sways_after_the_climb(h: Hall, rng: Draw) -> Change:
    """One stand is a platform on long rods.

    Whoever has climbed down leaves it swaying slowly, and it calms down in minutes.
    """
    phase = 2 * np.pi * (h.since_setup / rng.uniform(90.0, 240.0) + rng.random())
    sway = np.cos(phase) * np.exp(-h.since_setup / rng.uniform(250.0, 700.0))
    return leans(h, h.random_station(rng) * sway, level(rng))


@law("time")
def a_lift_table_leaks_and_is_pumped_up_again(h: Hall, rng: Draw) -> Change:
    """One of two trackers stands on a lift table that leaks.

    When it has sunk far enough a pump brings it up at once.
    """
    every = rng.uniform(300.0, 900.0)
    sunk = np.mod(h.time + rng.uniform(0.0, every), every) / every
    return shifts(h, -h.random_tracker(rng) * sunk, UP)
