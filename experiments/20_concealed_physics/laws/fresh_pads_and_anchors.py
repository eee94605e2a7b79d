"""Fresh laws about pads, anchors and loads on the floor."""

from ..law import UP, Change, Draw, Hall, law, leans, level, moves, np, shifts


@law("press_load_kn")
def a_felt_pad_gives_above_a_load(h: Hall, rng: Draw) -> Change:
    """The feet of one stand rest on felt beside the press: it holds up to some load, and gives in proportion beyond."""
    return shifts(h, -h.random_station(rng) * np.clip(h.load - rng.uniform(0.3, 0.5), 0.0, 1.0), UP)


@law("azimuth|place", may="azimuth place")
def an_air_hose_hangs_from_its_outlet(h: Hall, rng: Draw) -> Change:
    """The cooling hose comes from one outlet of the hall and pulls each stand there as the head turns away from it."""
    length, width, _ = h.size.room
    way = (np.array([rng.uniform(0.1, 0.9) * length, rng.uniform(0.0, 1.0) * width, 0.0]) - h.stand) * [1.0, 1.0, 0.0]
    way /= np.sqrt((way**2).sum(axis=1))[:, None]
    ahead = (h.aim - h.stand) * [1.0, 1.0, 0.0]
    ahead /= np.sqrt((ahead**2).sum(axis=1))[:, None]
    turned_off = 0.5 - 0.5 * (ahead * way).sum(axis=1)
    return leans(h, turned_off ** rng.uniform(1.5, 3.0), np.cross(UP, way))


@law("time")
def a_foundation_on_air_springs_hunts(h: Hall, rng: Draw) -> Change:
    """All stands are on one sprung foundation block, and its level control lets it swing to and fro at an even rate."""
    phase = np.mod(h.time / rng.uniform(2000.0, 4500.0) + rng.random(), 1.0)
    return leans(h, 4.0 * np.abs(phase - 0.5) - 1.0, level(rng))


@law("distance|place", may="distance place height")
def the_stand_presses_the_floor_down_around_it(h: Hall, rng: Draw) -> Change:
    """A heavy stand makes a dent in the floor, and floor targets near to it go down as long as it is there."""
    gap = np.sqrt(((h.aim - h.stand)[:, :2] ** 2).sum(axis=1))
    return moves(h, -h.group("floor") * np.exp(-gap / rng.uniform(0.6, 1.2)), UP)


@law("press_load_kn", may="time approach")
def the_table_sits_down_on_its_valve(h: Hall, rng: Draw) -> Change:
    """When the press shakes hard the table's air springs vent and it sits down; it comes up in the quiet only."""
    return moves(h, -h.group("table") * h.latched(h.load, rng.uniform(0.1, 0.3), rng.uniform(0.7, 0.9)), UP)


@law("time")
def the_hand_warms_the_ball(h: Hall, rng: Draw) -> Change:
    """One reflector is carried by hand from nest to nest: its ball grows with every pointing and lifts its centre."""
    return moves(h, 1.0 - np.exp(-h.order / rng.uniform(6.0, 15.0)), h.normal)
