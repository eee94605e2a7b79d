"""Laws about walls, galleries, tables and what is fixed to them."""

from ..law import OUT, UP, Change, Draw, Hall, law, moves, np


@law("time", "place", may="distance")
def crane_trolley_travels_above_the_gallery(h: Hall, rng: Draw) -> Change:
    """The trolley of the crane goes to and fro along the hall, and the gallery sags below where it is."""
    turns = h.time / rng.uniform(1200.0, 3000.0) + rng.random()
    trolley = h.size.room[0] * (0.5 + 0.4 * np.sin(2 * np.pi * turns))
    sag = np.exp(-0.5 * ((h.aim[:, 0] - trolley) / (0.2 * h.size.room[0])) ** 2)
    return moves(h, h.group("gallery") * sag, -UP)


@law("time", "height", may="place elevation")
def ventilation_presses_the_wall_outwards(h: Hall, rng: Draw) -> Change:
    """While the ventilation runs its pressure bulges the light wall, most at half its height."""
    bulge = np.sin(np.pi * h.aim[:, 2] / h.size.room[2])
    return moves(h, h.group("wall") * h.windows(rng) * bulge, -OUT)


@law("time", "place", may="distance")
def workpiece_lies_on_the_table_for_a_while(h: Hall, rng: Draw) -> Change:
    """A heavy workpiece is laid on the table and taken away later, and the plate sags where it lies."""
    middle = h.pointings.points[rng.choice(h.groups["table"])]
    sag = np.maximum(0.0, 1.0 - (((h.aim - middle) / 1.6) ** 2).sum(axis=1))
    laid, taken = h.time[-1] * rng.uniform([0.1, 0.6], [0.4, 0.9])
    return moves(h, h.group("table") * sag * ((h.time > laid) & (h.time < taken)), -UP)


@law("time", may="temperature")
def glued_nests_slide_down_while_it_is_warm(h: Hall, rng: Draw) -> Change:
    """Nests on hot glue slide down the wall, each at a pace of its own, and all of them faster when it is warm."""
    slid = np.cumsum(h.gap * np.exp(np.clip(3.0 * h.warmth, -3.0, 3.0)))
    pace = rng.uniform(0.1, 1.0, len(h.targets))[h.pointings.target]
    return moves(h, h.group("wall") * pace * slid / slid[-1], -UP)


@law("temperature", may="time")
def gallery_rail_sticks_before_it_slips(h: Hall, rng: Draw) -> Change:
    """The rail of the gallery follows the warmth only after friction in its bolts is overcome, on the way back too."""
    play, rail = 0.25 * np.ptp(h.warmth), np.empty(h.n)
    at = h.warmth[0]
    for i, warm in enumerate(h.warmth.tolist()):
        at = min(max(at, warm - play), warm + play)
        rail[i] = at
    return moves(h, h.group("gallery") * (rail - rail[0]), OUT)


@law("time", may="approach place")
def floor_nests_are_nudged_at_every_visit(h: Hall, rng: Draw) -> Change:
    """The operator comes from the tracker and pushes a floor nest a little away from it whenever a ball is put in."""
    p, away = h.pointings, (h.aim - h.stand) * np.array([1.0, 1.0, 0.0])
    away /= np.sqrt((away**2).sum(axis=1))[:, None]
    pushed, nudged, last = np.zeros((len(h.targets), 3)), np.empty((h.n, 3)), -1
    for i, target in enumerate(p.target.tolist()):
        if target != last:
            pushed[target] += away[i]
        nudged[i], last = pushed[target], target
    return moves(h, h.group("floor"), nudged)


@law("press_load_kn", "height", may="elevation place")
def column_of_the_press_pushes_the_wall_aside(h: Hall, rng: Draw) -> Change:
    """Above a certain load the column of the press touches the wall and pushes it along, most at the top."""
    touch = np.maximum(0.0, h.load - rng.uniform(0.4, 0.7))
    return moves(h, h.group("wall") * touch * (h.aim[:, 2] / h.size.room[2]) ** 2, np.array([0.0, 1.0, 0.0]))
