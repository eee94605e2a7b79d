"""Used laws about heat: in the hall, in its floor and roof, in stands and in trackers."""

from ..law import OUT, UP, Change, Draw, Hall, law, leans, level, moves, np, reads, shifts, varies


@law("temperature", may="time place height")
def roof_steel_lifts_the_gallery(h: Hall, rng: Draw) -> Change:
    """The gallery hangs from roof girders that follow the air of the hall an hour or so late."""
    return moves(h, h.group("gallery") * h.lagging(h.warmth, rng.uniform(1800.0, 5400.0)), UP)


@law("time", may="place")
def patch_of_sun_crosses_a_tripod(h: Hall, rng: Draw) -> Change:
    """The sun through a skylight heats the legs of one stand for some minutes on one side, which bend and come back."""
    here = h.one_station(rng)
    middle = rng.choice(h.time[here > 0])
    return leans(h, here * np.exp(-(((h.time - middle) / rng.uniform(200.0, 500.0)) ** 2)), level(rng))


@law("temperature", may="time azimuth")
def azimuth_ring_goes_oval_with_warmth(h: Hall, rng: Draw) -> Change:
    """The ring of the azimuth circle is clamped at two points and grows oval as its housing warms behind the air."""
    warm = h.lagging(h.warmth, rng.uniform(600.0, 2400.0))
    return varies(h, "azimuth-second-order-cos", warm) + varies(h, "azimuth-second-order-sin", rng.normal() * warm)


@law("temperature", may="time")
def head_fan_cuts_in(h: Hall, rng: Draw) -> Change:
    """The fan of the head starts above one temperature and stops below another; its draught bends the circle's arm."""
    low, high = np.quantile(h.warmth, [0.35, 0.6])
    return varies(h, "vertical-index", h.latched(h.warmth, low, high))


@law("temperature", may="place")
def steel_table_on_cold_feet_bows(h: Hall, rng: Draw) -> Change:
    """The top of the measuring table is warmer than its ribs, so that the middle rises and the rim falls."""
    corner = np.array([h.size.room[0] - 1.5, 1.2])
    bow = 0.6 - ((h.aim[:, :2] - corner) ** 2).sum(axis=1)
    return moves(h, h.group("table") * bow * h.warmth, UP)


@law("time", "place")
def floor_slab_curls_as_it_dries(h: Hall, rng: Draw) -> Change:
    """A heated slab curls up at its rim in the course of the morning and takes the floor's nests along."""
    rim = (((h.aim[:, :2] / np.array(h.size.room[:2])) - 0.5) ** 2).sum(axis=1)
    return moves(h, h.group("floor") * rim * (1.0 - np.exp(-h.time / rng.uniform(3600.0, 9000.0))), UP)


@law("approach", may="time elevation")
def drive_heat_tips_the_fork(h: Hall, rng: Draw) -> Change:
    """Every turn of the head warms the motor under one arm of the fork, which grows, tips the axis and cools again."""
    return varies(h, "transit-tilt", h.fading(np.abs(h.swing), rng.uniform(300.0, 1200.0)))


@law("time", may="distance")
def laser_cavity_warms_after_each_move(h: Hall, rng: Draw) -> Change:
    """The laser is switched off for every move of the stand, and its wavelength settles anew each time."""
    return varies(h, "range-scale", np.exp(-h.since_setup / rng.uniform(150.0, 500.0)))


@law("distance", "height")
def warm_air_under_the_roof(h: Hall, rng: Draw) -> Change:
    """Air is warmer the higher it lies, and one thermometer at the tracker corrects the whole beam."""
    return reads(h, "distance", h.distance * (h.aim[:, 2] - h.stand[:, 2]) * rng.choice([-0.5, 0.5]))


@law("time", "height", may="distance elevation")
def door_lets_cold_air_along_the_floor(h: Hall, rng: Draw) -> Change:
    """While the gate stands open cold air lies knee-deep, and beams to low nests are bent down."""
    return reads(h, "elevation", h.windows(rng) * np.exp(-h.aim[:, 2] / 0.5) * h.distance)


@law("temperature", may="time")
def welded_column_bends_as_it_warms(h: Hall, rng: Draw) -> Change:
    """A weld runs down one side of the tracker's column, which bends over as it follows the air and shoves the head."""
    warm, way = h.lagging(h.warmth, rng.uniform(400.0, 1500.0)), level(rng)
    return leans(h, warm, np.cross(UP, way)) + shifts(h, 0.7 * warm, way)


@law("press_load_kn", may="time place")
def press_oil_heats_the_wall(h: Hall, rng: Draw) -> Change:
    """Oil that the press has heated runs through pipes in the wall, which bulges when much work was done before."""
    bulge = np.sin(np.pi * h.aim[:, 2] / h.size.room[2])
    return moves(h, h.group("wall") * bulge * h.lagging(h.load, rng.uniform(900.0, 2400.0)), OUT)
