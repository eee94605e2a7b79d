"""Laws about balls, nests, collars, poles and clamps."""

from ..law import Change, Draw, Hall, law, moves, np, varies


def _visits(h: Hall) -> np.ndarray:
    """(n,) How often the ball was put into this nest before, both faces being one time."""
    p, count, before, found = h.pointings, {}, {}, np.zeros(h.n)
    for row in range(h.n):
        target, this = int(p.target[row]), (int(p.station[row]), int(p.repeat[row]))
        if before.get(target) != this:
            count[target], before[target] = count.get(target, -1) + 1, this
        found[row] = count[target]
    return found


@law("incidence", may="place height distance elevation azimuth")
def the_collar_of_the_ball_touches_the_nest(h: Hall, rng: Draw) -> Change:
    """The ball is turned to face the tracker.

    Where the tracker stands far aside its collar meets the nest and prises it up.
    """
    free = np.quantile(h.incidence, rng.uniform(0.35, 0.65))
    return moves(h, np.maximum(h.incidence - free, 0.0), h.normal)


@law("time", may="place approach")
def soft_nests_wear_in_with_every_visit(h: Hall, rng: Draw) -> Change:
    """The nests on floor and table are soft.

    Every time the ball snaps in it beds deeper, at first much, later little.
    """
    soft = h.group("floor") + h.group("table")
    return moves(h, -soft * (1.0 - np.exp(-_visits(h) / rng.uniform(1.0, 3.0))), h.normal)


@law("time")
def the_ball_comes_from_a_warm_pocket(h: Hall, rng: Draw) -> Change:
    """While the tracker is carried on, the ball is kept in a pocket.

    It is larger then, and shrinks in the first minutes.
    """
    return moves(h, np.exp(-h.since_setup / rng.uniform(120.0, 360.0)), h.normal)


@law("time|approach", may="time approach")
def two_balls_take_turns(h: Hall, rng: Draw) -> Change:
    """Two helpers go round with a ball each and serve the targets in turn.

    The depth of the two corners is not the same.
    """
    other = np.diff(h.pointings.target, prepend=-1) != 0
    turn = np.mod(np.cumsum(other) + int(rng.integers(2)), 2)
    return varies(h, "range-offset", turn.astype(np.float64))


@law("press_load_kn|time", may="press_load_kn time place")
def a_clamp_slips_at_every_stroke_of_the_press(h: Hall, rng: Draw) -> Change:
    """The table is clamped to the frame of the press.

    Every full stroke lets it slip on a little, and it never comes back.
    """
    full = h.load > rng.uniform(0.6, 0.9)
    strokes = np.cumsum(np.diff(full.astype(np.float64), prepend=0.0) > 0)
    if strokes[-1] < 2:
        raise LookupError("two strokes")
    angle = rng.uniform(-np.pi, np.pi)
    return moves(h, h.group("table") * strokes, np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.4, 0.0)]))


@law("height", may="place elevation")
def high_targets_are_served_with_a_pole(h: Hall, rng: Draw) -> Change:
    """What nobody can reach is served with a bendy pole.

    The ball hangs away from the tracker more the higher it goes.
    """
    reach = rng.uniform(0.35, 0.5) * h.size.room[2]
    way = (h.aim - h.stand) * [1.0, 1.0, 0.0]
    return moves(h, np.maximum(h.aim[:, 2] - reach, 0.0), way / np.sqrt((way**2).sum(axis=1))[:, None])
