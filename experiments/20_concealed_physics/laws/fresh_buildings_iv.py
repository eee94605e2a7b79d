"""Fresh laws about floors, walls, galleries and cranes."""

from ..law import OUT, UP, Change, Draw, Hall, law, leans, level, moves, np, scatters, shifts


@law("time", "place", may="height")
def bridge_crane_wheels_press_the_gallery(h: Hall, rng: Draw) -> Change:
    """The bridge crane goes to and fro along the hall, and the nests of the gallery sink where its wheels stand just then."""
    wheels = h.size.room[0] * (0.5 + 0.45 * np.sin(2 * np.pi * h.time / rng.uniform(1500.0, 4000.0) + rng.uniform(0.0, 2 * np.pi)))
    return moves(h, h.group("gallery") * np.exp(-(((h.aim[:, 0] - wheels) / rng.uniform(1.2, 2.5)) ** 2)), -UP)


@law("press_load_kn", "place")
def slab_is_dished_around_the_press(h: Hall, rng: Draw) -> Change:
    """The force of the press dishes the slab around its bed, and every stand leans towards the press, the nearer the more."""
    way = np.append(rng.uniform([0.0, 0.0], h.size.room[:2]), 0.0) - h.stand * [1.0, 1.0, 0.0]
    away = np.sqrt((way**2).sum(axis=1))
    return leans(h, h.load * np.exp(-away / rng.uniform(2.0, 4.0)), np.cross(UP, way / away[:, None]))


@law("time", "height", may="place")
def sunlit_edge_climbs_the_end_wall(h: Hall, rng: Draw) -> Change:
    """The shadow of the next building sinks and the sun's edge climbs the end wall, whose cladding bulges out below that edge."""
    begin, end = rng.uniform(0.0, 0.3) * h.time[-1], rng.uniform(0.7, 1.0) * h.time[-1]
    edge = h.size.room[2] * (h.time - begin) / (end - begin)
    return moves(h, h.group("wall") * 0.5 * (1.0 + np.tanh((edge - h.aim[:, 2]) / rng.uniform(0.3, 0.8))), OUT)


@law("temperature", "place")
def slab_joint_sticks_and_jumps(h: Hall, rng: Draw) -> Change:
    """Beyond an expansion joint the slab, with floor nests and stands, sticks and jumps over when the hall is warm, back when it is cool."""
    joint, way = rng.uniform(0.35, 0.65) * h.size.room[0], level(rng)
    jumped = h.latched(h.warmth, -0.15, 0.15)
    return moves(h, jumped * h.group("floor") * (h.aim[:, 0] > joint), way) + shifts(h, jumped * (h.stand[:, 0] > joint), way)


@law("azimuth|place")
def hollow_floor_panel_under_the_operator(h: Hall, rng: Draw) -> Change:
    """At one station the operator follows the beam around the stand, and on one side steps on a hollow panel that tips the stand."""
    away = h.aim - h.stand
    side = np.cos(np.arctan2(away[:, 1], away[:, 0]) - rng.uniform(-np.pi, np.pi))
    return leans(h, h.one_station(rng) * (side > rng.uniform(0.1, 0.6)), level(rng))


@law("time", "place|height|elevation")
def gallery_rings_with_the_fan(h: Hall, rng: Draw) -> Change:
    """While the roof fan runs the gallery rings at a few hertz, and angles to its nests scatter."""
    return scatters(h, "azimuth elevation", h.group("gallery") * h.windows(rng))
