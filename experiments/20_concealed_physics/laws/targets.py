"""Used laws about targets, and what they are fixed to."""

from ..law import OUT, UP, Change, Draw, Hall, law, moves, np


@law("temperature|time", "height|place")
def wall_as_a_door(h: Hall, rng: Draw) -> Change:
    """A light wall leans about its foot as the hall gets warmer: its reflectors move by their height."""
    return moves(h, h.group("wall") * h.aim[:, 2] * h.warmth, OUT)


@law("time", may="place")
def visitors_on_the_gallery(h: Hall, rng: Draw) -> Change:
    """The gallery sags between its ends while a class of visitors stands on it."""
    return moves(h, -h.group("gallery") * np.sin(np.pi * h.aim[:, 0] / h.size.room[0]) * h.windows(rng), UP)


@law("time|approach", may="time approach")
def two_operators(h: Hall, rng: Draw) -> Change:
    """Two operators take turns, set-up by set-up; one presses the ball into its nest, the other lets it hang."""
    return moves(h, h.pointings.station % 2, h.normal)
