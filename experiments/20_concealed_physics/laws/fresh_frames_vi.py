"""Fresh laws about frames: slabs, galleries, walls and tables that carry stands and targets."""

from ..law import OUT, UP, Change, Draw, Hall, law, leans, level, moves, np, shifts


@law("time", may="place")
def the_crane_bends_the_slab(h: Hall, rng: Draw) -> Change:
    """A gantry crane goes up and down the hall, and a stand sinks with the slab as the crane comes past."""
    crane = h.size.room[0] * np.abs(2.0 * np.mod(h.time / rng.uniform(1200.0, 2400.0) + rng.random(), 1.0) - 1.0)
    return shifts(h, -1.0 / (1.0 + ((crane - h.stand[:, 0]) / 2.0) ** 2), UP)


@law("time", may="place height")
def fitters_stand_on_the_gallery(h: Hall, rng: Draw) -> Change:
    """The gallery sags with all of its targets while fitters work on it, and springs back when they leave."""
    return moves(h, -h.group("gallery") * h.windows(rng), UP)


@law("press_load_kn", "place")
def the_foot_of_the_press_dents_the_floor(h: Hall, rng: Draw) -> Change:
    """Under load the foot of the press dents the floor, and floor targets sink the more the nearer they are to it."""
    away = h.aim[:, :2] - rng.uniform([2.0, 1.5], [h.size.room[0] - 2.0, h.size.room[1] - 1.5])
    return moves(h, -h.group("floor") * h.load / (1.0 + (away**2).sum(axis=1) / 4.0), UP)


@law("time", "height", may="place")
def gusts_push_in_the_wall(h: Hall, rng: Draw) -> Change:
    """Gusts bow the wall inwards between foot and roof, by the square of a wind that comes and goes in minutes."""
    wind = h.fading(rng.standard_normal(h.n), rng.uniform(80.0, 240.0))
    bow = h.aim[:, 2] * (h.size.room[2] - h.aim[:, 2])
    return moves(h, h.group("wall") * bow * wind**2, OUT)


@law("time", may="place")
def an_air_spring_leaks_and_refills(h: Hall, rng: Draw) -> Change:
    """The table sinks slowly on its leaking air springs until a valve lifts it back at once, time and again."""
    return moves(h, -h.group("table") * np.mod(h.time / rng.uniform(700.0, 1500.0) + rng.random(), 1.0), UP)


@law("press_load_kn")
def a_rocking_slab_tips_one_stand(h: Hall, rng: Draw) -> Change:
    """One stand is on a loose slab that tips onto its other corner whenever the press pushes hard enough."""
    return leans(h, h.random_station(rng) * (h.load > rng.uniform(0.3, 0.7)), level(rng))
