"""Laws about walls, floors and galleries, and about the bars in the hall."""

from ..law import OUT, UP, Change, Draw, Hall, gauge, law, moves, np, shifts


@law("time", "place")
def a_forklift_parks_in_the_hall(h: Hall, rng: Draw) -> Change:
    """While a loaded forklift stands in the hall the slab sinks round it, with nests and stands on it."""
    start, end = np.quantile(h.time, [rng.uniform(0.2, 0.45), rng.uniform(0.55, 0.8)])
    parked, spot = (h.time > start) & (h.time < end), rng.uniform(0.25, 0.75, 2) * h.size.room[:2]
    wide = rng.uniform(1.5, 3.0) ** 2
    nest, stand = (np.exp(-((p[:, :2] - spot) ** 2).sum(axis=1) / wide) for p in (h.aim, h.stand))
    return moves(h, h.group("floor") * parked * nest, -UP) + shifts(h, parked * stand, -UP)


@law("temperature", may="time")
def the_gallery_hangs_on_steel_rods(h: Hall, rng: Draw) -> Change:
    """The gallery hangs from the roof on long steel rods, which let it down slowly after the hall has warmed up."""
    return moves(h, h.group("gallery") * h.lagging(h.warmth, rng.uniform(600.0, 3600.0)), -UP)


@law("time", "place")
def the_crane_bends_its_runway_as_it_travels(h: Hall, rng: Draw) -> Change:
    """The crane goes to and fro, and the gallery, which carries its rail, sags where the crane is."""
    run = np.mod(h.time / rng.uniform(1200.0, 3600.0) + rng.random(), 1.0)
    crane = (0.1 + 0.8 * np.abs(2.0 * run - 1.0)) * h.size.room[0]
    return moves(h, h.group("gallery") * np.exp(-(((h.aim[:, 0] - crane) / rng.uniform(1.5, 3.0)) ** 2)), -UP)


@law("press_load_kn", may="time")
def one_nest_sits_on_the_press_frame(h: Hall, rng: Draw) -> Change:
    """One nest was put on the frame of the press, which stretches under its load."""
    way = rng.standard_normal(3) + 2.0 * UP
    return moves(h, h.load * (h.pointings.target == rng.integers(len(h.targets))), way / np.sqrt((way**2).sum()))


@law("time", "height", may="place")
def wind_rocks_the_wall(h: Hall, rng: Draw) -> Change:
    """The wind pushes the light wall in and lets it out again, its top most."""
    return moves(h, h.group("wall") * h.aim[:, 2] / h.size.room[2] * h.walk(rng), OUT)


@law("temperature", "place", may="time")
def an_expansion_joint_works_with_the_warmth(h: Hall, rng: Draw) -> Change:
    """The slab is cut by a joint; what stands beyond it goes along the hall when the slab expands."""
    joint, ground = rng.uniform(0.35, 0.6) * h.size.room[0], 1.0 - h.group("wall") - h.group("gallery")
    warm = h.lagging(h.warmth, rng.uniform(300.0, 1800.0))
    return moves(h, ground * warm * (h.aim[:, 0] > joint), OUT) + shifts(h, warm * (h.stand[:, 0] > joint), OUT)


@law()
def the_joint_of_the_standing_bar_settled(h: Hall, rng: Draw) -> Change:
    """The upright bar is screwed together from two halves, and its weight closed the joint after its calibration."""
    return gauge(h, [0.0, rng.uniform(0.5, 1.0)])


@law()
def the_lying_bar_has_a_new_end_piece(h: Hall, rng: Draw) -> Change:
    """The lying bar got a new end piece after its calibration, and nobody wrote a new certificate."""
    return gauge(h, [rng.choice([-1.0, 1.0]), 0.0])
