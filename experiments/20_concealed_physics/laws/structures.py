"""Laws about walls, floors, galleries and tables that move with their targets."""

from ..law import OUT, UP, Change, Draw, Hall, law, moves, np


@law("time", "place")
def people_on_the_gallery_bend_it(h: Hall, rng: Draw) -> Change:
    """While a shift works up there the gallery sags between its two supports, most in the middle."""
    bend = np.sin(np.pi * np.clip(h.aim[:, 0] / h.size.room[0], 0.0, 1.0))
    return moves(h, -10.0 * h.group("gallery") * h.windows(rng) * bend, UP)


@law("temperature", "height", may="time place")
def a_free_wall_bends_as_one_side_warms(h: Hall, rng: Draw) -> Change:
    """The inner face of a wall that stands free follows the hall's warmth late; it bends as height squared."""
    rise = (h.aim[:, 2] / h.size.room[2]) ** 2
    return moves(h, -20.0 * h.group("wall") * rise * h.lagging(h.warmth, rng.uniform(900.0, 2700.0)), OUT)


@law("press_load_kn", "place")
def the_floor_dips_around_the_press(h: Hall, rng: Draw) -> Change:
    """The force of the press goes into the floor and bends it down, with the targets on it, around the pit."""
    length, width, _ = h.size.room
    pit = rng.uniform([0.25 * length, 0.2 * width], [0.75 * length, 0.8 * width])
    far = ((h.aim[:, :2] - pit) ** 2).sum(axis=1)
    dip = np.exp(-0.5 * far / rng.uniform(1.5, 2.5) ** 2)
    return moves(h, -15.0 * h.load * h.group("floor") * dip, UP)


@law("time", may="place")
def a_casting_is_set_on_the_table(h: Hall, rng: Draw) -> Change:
    """Half way through the work something heavy is put on the table, whose pads give way over a quarter of an hour."""
    start = rng.uniform(0.3, 0.6) * h.time[-1]
    since = np.maximum(h.time - start, 0.0)
    return moves(h, -20.0 * h.group("table") * (1.0 - np.exp(-since / rng.uniform(500.0, 1500.0))), UP)


@law("temperature", "place", may="time")
def the_gallery_slides_on_its_far_bearing(h: Hall, rng: Draw) -> Change:
    """The girder that bears the gallery is held at one end; it lengthens with the warmth, but half an hour late."""
    held = rng.choice([0.0, h.size.room[0]])
    warm = h.lagging(h.warmth, rng.uniform(1000.0, 3000.0))
    return moves(h, 10.0 * h.group("gallery") * (h.aim[:, 0] - held) * warm, OUT)


@law("time", "place")
def a_patch_of_sun_wanders_over_the_floor(h: Hall, rng: Draw) -> Change:
    """The sun through a skylight warms a strip of the floor, which bulges; the strip goes across with the hours."""
    width = h.size.room[1]
    middle = width * (h.time / h.time[-1] if rng.random() < 0.5 else 1.0 - h.time / h.time[-1])
    bulge = np.exp(-(((h.aim[:, 1] - middle) / rng.uniform(1.2, 2.0)) ** 2))
    return moves(h, 15.0 * h.group("floor") * bulge, UP)
