"""Laws about what the tracker stands on."""

from ..law import UP, Change, Draw, Hall, law, leans, level, np, shifts


@law("time")
def forklift_waits_beside_one_stand(h: Hall, rng: Draw) -> Change:
    """A loaded forklift that waits beside one stand dents the floor: the stand leans, and comes back when it leaves."""
    return leans(h, h.one_station(rng) * h.windows(rng), level(rng))


@law("time")
def patch_of_sun_crosses_a_tripod_leg(h: Hall, rng: Draw) -> Change:
    """A patch of sun wanders over one leg of one tripod, which grows while it is lit and shrinks again with a lag."""
    own = h.one_station(rng)
    there = h.time[own > 0]
    lit = np.exp(-0.5 * ((h.time - rng.uniform(there[0], there[-1])) / rng.uniform(150.0, 400.0)) ** 2)
    return leans(h, own * h.lagging(lit, rng.uniform(100.0, 300.0)), level(rng))


@law("approach")
def mast_rocks_over_in_its_loose_lock(h: Hall, rng: Draw) -> Change:
    """The mast has play in its lock: a quick turn of the head tips it over, a quick turn the other way tips it back."""
    return leans(h, h.latched(h.swing, -rng.uniform(0.6, 1.2), rng.uniform(0.6, 1.2)), level(rng))


@law("press_load_kn", "place", may="distance")
def floor_slab_dips_round_the_press(h: Hall, rng: Draw) -> Change:
    """The slab dips under the loaded press, and stands sink with it the more the nearer they are."""
    away = h.stand[:, :2] - rng.uniform([0.2, 0.2], [0.8, 0.8]) * np.asarray(h.size.room)[:2]
    return shifts(h, h.load * np.exp(-(away**2).sum(axis=1) / (0.25 * h.size.room[0]) ** 2), -UP)


@law("approach", may="azimuth time")
def rubber_pads_keep_a_twist(h: Hall, rng: Draw) -> Change:
    """Every turn of the head twists the rubber pads below the stand the other way, and they creep back in minutes."""
    return leans(h, -h.fading(h.swing, rng.uniform(60.0, 200.0)), UP)


@law("azimuth", may="face place")
def one_foot_is_softer_than_the_others(h: Hall, rng: Draw) -> Change:
    """One foot of one stand is soft, and gives way whenever the head hangs out over it."""
    over = np.maximum(0.0, np.cos(h.circle - rng.uniform(-np.pi, np.pi)))
    return leans(h, h.one_station(rng) * over, level(rng))


@law("distance", may="elevation height place")
def operator_stands_on_the_same_floor_panel(h: Hall, rng: Draw) -> Change:
    """Who holds the reflector near the tracker stands on its floor panel, and the stand leans towards the target."""
    way = (h.aim - h.stand) * np.array([1.0, 1.0, 0.0])
    away = np.sqrt((way**2).sum(axis=1))
    return leans(h, np.exp(-((away / rng.uniform(1.5, 2.5)) ** 2)), np.cross(UP, way / away[:, None]))
