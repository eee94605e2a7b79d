"""Used laws about targets, and what they are fixed to."""

from ..law import OUT, UP, Change, Draw, Hall, law, moves, np


@law("temperature|time", "height|place")
def wall_as_a_door(h: Hall, rng: Draw) -> Change:
    """A light wall leans about its foot as the hall gets warmer: its reflectors move by their height."""
    return moves(h, h.group("wall") * h.aim[:, 2] * h.warmth, OUT)


@law("press_load_kn|time", "place")
def table_tips(h: Hall, rng: Draw) -> Change:
    """The table of a machine tips under its load: the reflectors on it sink by their distance from its edge."""
    across = h.aim[:, 0] - h.pointings.points[h.groups["table"], 0].min()
    return moves(h, -h.group("table") * across * h.load**2, UP)


@law("time", may="place")
def visitors_on_the_gallery(h: Hall, rng: Draw) -> Change:
    """The gallery sags between its ends while a class of visitors stands on it."""
    return moves(h, -h.group("gallery") * np.sin(np.pi * h.aim[:, 0] / h.size.room[0]) * h.windows(rng), UP)


@law("time", may="place")
def lorry(h: Hall, rng: Draw) -> Change:
    """A lorry stands in the hall for a while: the floor round it goes down in a bowl, and the reflectors with it."""
    start, stop = np.sort(rng.uniform(h.time[0], h.time[-1], 2))
    centre = h.pointings.points[rng.choice(h.groups["floor"])]
    gap = np.sqrt(((h.aim - centre)[:, :2] ** 2).sum(axis=1))
    stands = (h.time > start) & (h.time < stop)
    return moves(h, -h.group("floor") * stands / (1 + (gap / 2.0) ** 2) ** 1.5, UP)


@law("time|approach", may="time approach")
def two_operators(h: Hall, rng: Draw) -> Change:
    """Two operators take turns, set-up by set-up; one presses the ball into its nest, the other lets it hang."""
    return moves(h, h.pointings.station % 2, h.normal)


@law("time")
def second_shift_wipes_the_nests(h: Hall, rng: Draw) -> Change:
    """The second shift wipes the oil off each nest before it sets the ball, the first does not: balls sink by it."""
    return moves(h, -1.0 * (h.time > rng.uniform(0.3, 0.7) * h.time[-1]), h.normal)
