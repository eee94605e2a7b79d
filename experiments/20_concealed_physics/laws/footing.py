"""Laws about what trackers stand on."""

from ..law import UP, Change, Draw, Hall, law, leans, level, np, shifts

ACROSS = np.array([0.0, 1.0, 0.0])


@law("time", may="place")
def a_work_lamp_warms_one_leg(h: Hall, rng: Draw) -> Change:
    """A lamp beside one stand goes on and off; the leg that it shines on lengthens with a lag, and the stand leans."""
    return leans(h, h.one_station(rng) * h.lagging(h.windows(rng), rng.uniform(200.0, 600.0)), level(rng))


@law("time", "place")
def a_gantry_presses_the_slab_down(h: Hall, rng: Draw) -> Change:
    """While the gantry works its rail along one long wall bends the slab: stands lean towards it, near ones most."""
    far = h.stand[:, 1] if rng.random() < 0.5 else h.size.room[1] - h.stand[:, 1]
    return leans(h, h.windows(rng) * np.exp(-far / rng.uniform(1.2, 2.5)), np.array([1.0, 0.0, 0.0]))


@law("time|press_load_kn")
def blows_of_the_press_walk_the_stand(h: Hall, rng: Draw) -> Change:
    """Smooth feet creep a little with every blow, so the stand goes the way that the work of the press adds up to."""
    work = np.cumsum(h.load * h.gap)
    return shifts(h, 1e-3 * (work - work[h.starts]), level(rng))


@law("distance", may="place")
def boards_yield_where_the_operator_kneels(h: Hall, rng: Draw) -> Change:
    """On a boarded floor the operator's weight tips the stand towards the target that he serves, if it is near."""
    way = h.aim - h.stand
    way[:, 2] = 0.0
    way /= np.sqrt((way**2).sum(axis=1))[:, None]
    return leans(h, np.exp(-((h.distance / rng.uniform(2.0, 3.5)) ** 2)), np.cross(UP, way))


@law("approach", may="time azimuth")
def a_column_stays_twisted_by_the_drive(h: Hall, rng: Draw) -> Change:
    """The drive's torque twists the clamped column at every turn of the head, and the twist goes back slowly."""
    return leans(h, h.fading(np.sin(h.swing), rng.uniform(30.0, 120.0)), UP)


@law("azimuth", may="approach face place")
def a_foot_rocks_with_the_head(h: Hall, rng: Draw) -> Change:
    """One stand has a foot that does not touch; the heavy side of the head tips it over, and back only well beyond."""
    side = np.cos(h.circle - rng.uniform(-np.pi, np.pi))
    return leans(h, h.one_station(rng) * h.latched(side, -0.35, 0.35), level(rng))


@law("time")
def a_levelling_valve_feeds_the_air_springs(h: Hall, rng: Draw) -> Change:
    """A stand on air springs sinks as they leak, until the valve opens and lifts it again: a sawtooth."""
    cycle = rng.uniform(350.0, 1100.0)
    return shifts(h, -np.mod(h.time / cycle + rng.random(), 1.0), UP)


@law("temperature", "place")
def a_slab_beyond_a_joint_tips_with_the_warmth(h: Hall, rng: Draw) -> Change:
    """The slab on one side of an expansion joint is held at its far edge and tips with its stands as it warms."""
    joint = np.median(np.unique(h.stand[:, 0]))
    return leans(h, h.warmth * (h.stand[:, 0] > joint), ACROSS * rng.choice([-1.0, 1.0]))
