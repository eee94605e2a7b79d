"""Fresh laws about building, tables and fixtures that carry the targets."""

from ..law import OUT, UP, Change, Draw, Hall, law, moves, np


@law("press_load_kn", "place", may="time")
def the_floor_dips_near_the_press(h: Hall, rng: Draw) -> Change:
    """Under load the floor around the press dips, and the floor targets near to it go down with it."""
    press = rng.uniform([0.0, 0.0], h.size.room[:2])
    gap = np.sqrt(((h.aim[:, :2] - press) ** 2).sum(axis=1))
    return moves(h, h.group("floor") * h.load * np.exp(-gap / rng.uniform(1.5, 3.5)), -UP)


@law("time", "place")
def the_table_tips_under_a_heavy_part(h: Hall, rng: Draw) -> Change:
    """Somebody puts a heavy part on an edge of the table, and from then on its top is tipped to this side."""
    table, angle = h.group("table"), rng.uniform(-np.pi, np.pi)
    lever = (h.aim - h.aim[table > 0].mean(axis=0))[:, :2] @ [np.cos(angle), np.sin(angle)]
    return moves(h, table * (h.time > rng.uniform(0.25, 0.75) * h.time[-1]) * lever, -UP)


@law("time", "place")
def the_gallery_sags_under_people(h: Hall, rng: Draw) -> Change:
    """Now and then visitors stand on the gallery; it sags, most in the middle of its span."""
    return moves(h, h.group("gallery") * h.windows(rng) * np.sin(np.pi * h.aim[:, 0] / h.size.room[0]), -UP)


@law("time", "height|place")
def the_ventilation_sucks_at_the_wall(h: Hall, rng: Draw) -> Change:
    """While the ventilation runs there is suction in the hall, and the thin wall bows in between floor and roof."""
    return moves(h, h.group("wall") * h.windows(rng) * np.sin(np.pi * h.aim[:, 2] / h.size.room[2]), OUT)


@law("place", may="time")
def a_lorry_stands_on_one_slab_during_one_set_up(h: Hall, rng: Draw) -> Change:
    """During one set-up a lorry stands on the slab beyond a joint, and the floor targets there lie lower."""
    slab = h.aim[:, 0] > rng.uniform(0.4, 0.6) * h.size.room[0]
    return moves(h, h.random_station(rng) * h.group("floor") * slab, -UP)


@law("time", may="place")
def a_lamp_warms_one_of_the_known_lengths(h: Hall, rng: Draw) -> Change:
    """A work lamp beside one of the known lengths is switched on and off; the bar follows slowly and grows."""
    ends = h.bars[rng.integers(len(h.bars))]
    far = h.pointings.target == ends[1]
    way = h.pointings.points[ends[1]] - h.pointings.points[ends[0]]
    grown = h.lagging(h.windows(rng), rng.uniform(300.0, 1200.0))
    return moves(h, far * grown, way / np.sqrt((way**2).sum()))
