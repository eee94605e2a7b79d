"""Fresh laws about gauges, nests and balls, to which everything is referred."""

from ..law import Change, Draw, Hall, law, level, moves, np, reads, scatters


@law("time")
def a_fan_pushes_the_frame_of_the_bars(h: Hall, rng: Draw) -> Change:
    """The frame that holds both bars is on rubber feet, which yield sideways while a fan blows at it."""
    return moves(h, np.isin(h.pointings.target, h.bars) * h.windows(rng), level(rng))


@law("incidence", "distance")
def the_rim_cuts_the_widened_beam(h: Hall, rng: Draw) -> Change:
    """The rim of an obliquely seen ball cuts off a part of the beam, more of it where the beam has widened."""
    return reads(h, "distance", np.maximum(h.incidence - rng.uniform(0.5, 0.8), 0.0) * h.distance)


@law("time|approach")
def two_balls_of_unlike_size_take_turns(h: Hall, rng: Draw) -> Change:
    """Two helpers serve the nests by turns, and the ball of one of them has a slightly larger radius."""
    return moves(h, np.cumsum(h.change(h.pointings.target) != 0) % 2, h.normal)


@law("incidence")
def oblique_balls_return_little_light(h: Hall, rng: Draw) -> Change:
    """A ball seen obliquely sends little light back to the tracking detector, and the angles scatter."""
    return scatters(h, "azimuth elevation", np.maximum(h.incidence - rng.uniform(0.4, 0.8), 0.0) ** 2)


@law("press_load_kn|time", may="place")
def glued_nests_ratchet_along_the_floor(h: Hall, rng: Draw) -> Change:
    """Each stroke of the press lets the nests slide a little downhill on their soft glue, never back."""
    strokes = np.cumsum(np.maximum(np.diff(h.load, prepend=h.load[0]), 0.0))
    return moves(h, h.group("floor") * strokes, level(rng))


@law("time", may="place")
def lamps_stretch_the_table(h: Hall, rng: Draw) -> Change:
    """Lamps above the aluminium table are on for a while in every cycle, and its nests spread as it warms up."""
    table = h.group("table")
    warm = h.lagging(h.windows(rng), rng.uniform(300.0, 900.0))
    return moves(h, table * warm, h.aim - h.aim[table > 0].mean(axis=0))
