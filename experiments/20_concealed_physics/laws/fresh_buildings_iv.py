"""Fresh laws about floors, walls, galleries and cranes."""

from ..law import OUT, UP, Change, Draw, Hall, law, leans, level, moves, np, scatters, shifts


@law("temperature", "place", may="time height")
def thermostat_fires_the_wall_radiator(h: Hall, rng: Draw) -> Change:
    """A thermostat fires the radiator on the end wall while the hall is cool, and the panel there bulges with a lag."""
    fired = h.lagging(1.0 * (h.warmth < np.quantile(h.warmth, rng.uniform(0.3, 0.6))), rng.uniform(200.0, 900.0))
    beside = (h.aim[:, 1] - rng.uniform(0.2, 0.8) * h.size.room[1]) / rng.uniform(0.8, 1.8)
    return moves(h, h.group("wall") * fired * np.exp(-(beside**2)), OUT)


@law("press_load_kn", "place")
def slab_is_dished_around_the_press(h: Hall, rng: Draw) -> Change:
    """The press dishes the slab around its bed, and every stand leans towards the press, the nearer the more."""
    way = np.append(rng.uniform([0.0, 0.0], h.size.room[:2]), 0.0) - h.stand * [1.0, 1.0, 0.0]
    away = np.sqrt((way**2).sum(axis=1))
    return leans(h, h.load * np.exp(-away / rng.uniform(2.0, 4.0)), np.cross(UP, way / away[:, None]))


@law("time", "height", may="place")
def sunlit_edge_climbs_the_end_wall(h: Hall, rng: Draw) -> Change:
    """The next building's shadow sinks, and the end wall's cladding bulges out below the climbing edge of the sun."""
    begin, end = rng.uniform(0.0, 0.3) * h.time[-1], rng.uniform(0.7, 1.0) * h.time[-1]
    edge = h.size.room[2] * (h.time - begin) / (end - begin)
    return moves(h, h.group("wall") * 0.5 * (1.0 + np.tanh((edge - h.aim[:, 2]) / rng.uniform(0.3, 0.8))), OUT)


@law("time", "place")
def pallets_pile_up_in_one_bay(h: Hall, rng: Draw) -> Change:
    """Pallet after pallet is put down in one bay of the store, and floor nests and stands near it sink with each."""
    arrived = np.sort(rng.uniform(0.0, h.time[-1], rng.integers(4, 10)))
    pile, bay = np.searchsorted(arrived, h.time), rng.uniform([0.0, 0.0], h.size.room[:2])
    reach = rng.uniform(1.5, 3.0)
    nests, stands = (np.exp(-np.hypot(*(at[:, :2] - bay).T) / reach) for at in (h.aim, h.stand))
    return moves(h, pile * nests * h.group("floor"), -UP) + shifts(h, pile * stands, -UP)


@law("azimuth|place")
def hollow_floor_panel_under_the_operator(h: Hall, rng: Draw) -> Change:
    """The operator follows the beam around one station, and on one side steps on a hollow panel that tips it."""
    away = h.aim - h.stand
    side = np.cos(np.arctan2(away[:, 1], away[:, 0]) - rng.uniform(-np.pi, np.pi))
    return leans(h, h.random_station(rng) * (side > rng.uniform(0.1, 0.6)), level(rng))


@law("time", "place|height|elevation")
def gallery_rings_with_the_fan(h: Hall, rng: Draw) -> Change:
    """While the roof fan runs the gallery rings at a few hertz, and angles to its nests scatter."""
    return scatters(h, "azimuth elevation", h.group("gallery") * h.windows(rng))
