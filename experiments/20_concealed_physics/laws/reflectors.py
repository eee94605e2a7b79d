"""Laws about balls and nests, and the people who put one into the other."""

from ..law import UP, Change, Draw, Hall, law, moves, np, reads, scatters
from ..tracker import Array


def _visits(h: Hall) -> Array:
    """(n,) 1 where the ball was put into this nest just before, 0 where it was there already."""
    same = (np.diff(h.pointings.target, prepend=-1) == 0) & (h.order > 0)
    return np.where(same, 0.0, 1.0)


@law("time", may="height place")
def hot_glue_creeps_down_the_wall(h: Hall, rng: Draw) -> Change:
    """Nests on the wall were glued on in the morning and creep down, each at its own pace, slower and slower."""
    pace = rng.uniform(0.2, 1.0, len(h.targets))[h.pointings.target]
    return moves(h, h.group("wall") * pace * np.log1p(h.time / rng.uniform(300.0, 1200.0)), -UP)


@law("time")
def the_relief_operator_seats_the_ball_otherwise(h: Hall, rng: Draw) -> Change:
    """From the change of shift on another person seats the ball, who does not press it home into the nests."""
    return moves(h, 1.0 * (h.time > np.quantile(h.time, rng.uniform(0.25, 0.75))), h.normal)


@law("time", may="approach")
def two_balls_take_turns(h: Hall, rng: Draw) -> Change:
    """Two people go round with a ball each, from nest to nest in turn, and the vertex of one ball lies too deep."""
    return reads(h, "distance", np.mod(np.cumsum(_visits(h)) + rng.integers(2), 2.0))


@law("time", may="place height")
def tape_gives_way_at_every_removal(h: Hall, rng: Draw) -> Change:
    """Nests on the floor are held by tape, and each time the magnet lets the ball go they come up a little more."""
    visit, own = _visits(h), np.equal.outer(h.pointings.target, np.arange(len(h.targets)))
    before = (np.cumsum(own * visit[:, None], axis=0) * own).sum(axis=1) - 1.0
    weak = rng.uniform(0.2, 1.0, len(h.targets))[h.pointings.target]
    return moves(h, h.group("floor") * weak * before, h.normal)


@law(may="azimuth place height distance elevation incidence")
def floor_plates_tip_under_the_operator(h: Hall, rng: Draw) -> Change:
    """He who holds the ball on a loose floor plate stands behind it, out of the beam, and tips it away from there."""
    way = (h.aim - h.stand) * [1.0, 1.0, 0.0]
    loose = rng.uniform(0.3, 1.0, len(h.targets))[h.pointings.target]
    return moves(h, h.group("floor") * loose, way / np.sqrt((way**2).sum(axis=1))[:, None])


@law("incidence", may="distance")
def the_rim_of_the_ball_cuts_the_beam(h: Hall, rng: Draw) -> Change:
    """Where a ball is seen too far aslant its rim cuts the beam, and the tracker aims at the middle of what is left."""
    out = (h.aim - h.stand) / h.distance[:, None]
    left = np.cross(UP, out) / np.cos(h.elevation)[:, None]
    middle = h.normal / np.sin(h.incidence)[:, None]  # across the beam it has the length of one
    cut = np.clip(h.incidence - rng.uniform(0.6, 0.9), 0.0, None) / h.distance
    aside, above = cut * (middle * left).sum(axis=1), cut * (middle * np.cross(out, left)).sum(axis=1)
    return reads(h, "azimuth", aside / np.cos(h.elevation)) + reads(h, "elevation", above)


@law("time", may="place")
def the_rotary_table_comes_back_not_quite(h: Hall, rng: Draw) -> Change:
    """Between the set-ups the rotary table works, and it never comes back to quite the same angle."""
    table = h.group("table")
    lever = h.aim - (table[:, None] * h.aim).sum(axis=0) / table.sum()
    return moves(h, table * rng.standard_normal(len(h.stations))[h.pointings.station], np.cross(UP, lever))


@law()
def a_nest_on_thin_sheet_rings(h: Hall, rng: Draw) -> Change:
    """One nest was stuck on thin sheet, which drums with every machine in the hall."""
    return scatters(h, "distance azimuth elevation", 1.0 * (h.pointings.target == rng.integers(len(h.targets))))
