"""Laws about cranes, robots, presses, people and wind, and the floors and walls that give way."""

from ..law import OUT, UP, Change, Draw, Hall, law, leans, moves, np, shifts


@law("time", "place", may="height")
def the_crane_parks_on_the_far_slab(h: Hall, rng: Draw) -> Change:
    """The floor is cast in two slabs; while the crane works over one of them, the stands on that slab are let down."""
    along = np.unique(h.stand[:, 0])
    cut = int(rng.integers(1, len(along)))
    far = h.stand[:, 0] > (along[cut - 1] + along[cut]) / 2
    return shifts(h, -h.windows(rng) * far, UP)


@law("time", may="place")
def a_robot_swings_on_the_base_plate_of_the_table(h: Hall, rng: Draw) -> Change:
    """A robot is bolted to the plate that carries the table.

    It goes from side to side, dwells there, and tips the plate.
    """
    phase = 2 * np.pi * (h.time / rng.uniform(1100.0, 2600.0) + rng.random())
    pose = np.clip(1.6 * np.sin(phase), -1.0, 1.0)
    table = h.group("table")
    middle = (table[:, None] * h.aim).sum(axis=0) / table.sum()
    way = rng.uniform(-np.pi, np.pi)
    lever = (h.aim - middle) @ np.array([np.cos(way), np.sin(way), 0.0]) + rng.uniform(0.6, 1.2)
    return moves(h, table * lever * pose, UP)


@law("time", "place", may="azimuth")
def a_trolley_rolls_along_the_gallery(h: Hall, rng: Draw) -> Change:
    """A trolley goes to and fro on the gallery, which sags wherever the trolley is."""
    run = h.time / rng.uniform(2000.0, 5000.0) + rng.random()
    at = h.size.room[0] * np.abs(2.0 * (run - np.floor(run)) - 1.0)
    near = np.exp(-0.5 * ((h.aim[:, 0] - at) / rng.uniform(1.2, 2.5)) ** 2)
    return moves(h, h.group("gallery") * near, -UP)


@law("press_load_kn", may="time place")
def stands_tip_towards_the_loaded_press(h: Hall, rng: Draw) -> Change:
    """Above a certain load the press lifts off its pads and digs a hollow into the floor.

    Stands close by tip into it.
    """
    press = np.array([rng.uniform(0.2, 0.8), rng.uniform(0.2, 0.8), 0.0]) * h.size.room
    way = (press - h.stand) * [1.0, 1.0, 0.0]
    gap = np.sqrt((way**2).sum(axis=1)) + 0.3
    beyond = np.maximum(h.load - rng.uniform(0.3, 0.6), 0.0)
    return leans(h, beyond * (2.0 / (1.0 + gap)) ** 2, np.cross(UP, way / gap[:, None]))


@law("distance", may="place azimuth height elevation")
def the_floor_bends_under_whoever_holds_the_ball(h: Hall, rng: Draw) -> Change:
    """A raised floor bends round the man at the target; a tracker close to him leans his way, one far off does not."""
    way = (h.aim - h.stand) * [1.0, 1.0, 0.0]
    gap = np.sqrt((way**2).sum(axis=1))
    return leans(h, np.exp(-gap / rng.uniform(0.8, 1.8)), np.cross(UP, way / gap[:, None]))


@law("time", may="place height")
def gusts_push_the_sheet_metal_wall(h: Hall, rng: Draw) -> Change:
    """The wall is sheet metal on posts; gusts that last some minutes push its middle inwards, and never outwards."""
    blow = h.fading(rng.standard_normal(h.n) * np.sqrt(np.minimum(h.gap, 600.0) + 1.0), rng.uniform(150.0, 400.0))
    gust = np.maximum(blow / blow.std() - rng.uniform(-0.3, 0.3), 0.0)
    span = np.sin(np.pi * h.aim[:, 2] / h.size.room[2]) * np.sin(np.pi * h.aim[:, 1] / h.size.room[1])
    return moves(h, h.group("wall") * gust * span, OUT)
