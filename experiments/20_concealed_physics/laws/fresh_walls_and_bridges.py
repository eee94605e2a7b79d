"""Fresh laws about parts of the building that carry targets."""

from ..law import OUT, UP, Change, Draw, Hall, law, moves, np


@law("press_load_kn", "height", may="place")
def the_wall_nods_with_the_press(h: Hall, rng: Draw) -> Change:
    """The wall stands on the same footing as the press and tips into the hall with its load, most at its top."""
    height = np.clip(h.aim[:, 2] / h.size.room[2], 0.0, 1.0)
    return moves(h, h.group("wall") * h.load * height ** rng.uniform(1.0, 1.6), OUT)


@law("time", "place")
def a_bridge_crane_rides_along_the_gallery(h: Hall, rng: Draw) -> Change:
    """A crane goes to and fro on a rail at the gallery and bends it down where it is just then."""
    length = h.size.room[0]
    phase = np.mod(h.time / rng.uniform(1800.0, 5000.0) + rng.random(), 1.0)
    crane = length * 2.0 * np.abs(phase - 0.5)
    dip = np.exp(-(((h.aim[:, 0] - crane) / (rng.uniform(0.15, 0.3) * length)) ** 2))
    return moves(h, -h.group("gallery") * dip, UP)


@law("time", "place")
def a_slab_beyond_a_joint_sinks_under_a_truck(h: Hall, rng: Draw) -> Change:
    """Lorries are loaded on the slab beyond a joint of the floor; the targets on it sink while one stands there."""
    beyond = h.aim[:, 0] > rng.uniform(0.35, 0.65) * h.size.room[0]
    return moves(h, -h.group("floor") * beyond * h.windows(rng), UP)


@law("time", may="place")
def the_table_turns_on_its_swivel(h: Hall, rng: Draw) -> Change:
    """The table was turned into place shortly before and its swivel goes back, quickly first and then slowly."""
    centre = h.pointings.points[h.groups["table"]].mean(axis=0)
    back = 1.0 - np.exp(-h.time / rng.uniform(2400.0, 6000.0))
    return moves(h, h.group("table") * back, np.cross(UP, h.aim - centre))


@law("time")
def glued_nests_slide_down_the_wall(h: Hall, rng: Draw) -> Change:
    """The nests on the wall were glued on the same morning and all slide down together while the glue hardens."""
    return moves(h, -h.group("wall") * np.sqrt(h.time / 3600.0) ** rng.uniform(0.8, 1.4), UP)


@law("incidence", may="place height distance")
def a_ball_rides_up_on_the_rim_of_its_nest(h: Hall, rng: Draw) -> Change:
    """Turned to a beam that comes in flat, the ball's opening rides up on the nest's rim and lifts the ball."""
    over = np.log1p(np.exp((h.incidence - rng.uniform(0.7, 1.0)) / 0.08))
    return moves(h, 0.08 * over, h.normal)
