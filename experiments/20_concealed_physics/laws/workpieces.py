"""Fresh laws about walls, tables and floors that carry the nests, and nests that do not hold still."""

from ..law import OUT, UP, Change, Draw, Hall, law, moves, np


@law("time", "height|place", may="height place")
def the_wall_bellies_out_in_the_sun(h: Hall, rng: Draw) -> Change:
    """Sun makes the wall belly inwards between floor and roof, and it goes back when the sun has passed."""
    up = h.aim[:, 2] / h.size.room[2]
    sun = np.sin(np.pi * h.time / (rng.uniform(1.0, 1.5) * h.time[-1]))
    return moves(h, h.group("wall") * 4.0 * up * (1.0 - up) * sun, OUT)


@law("time", "place")
def the_table_tips_as_parts_are_taken_off(h: Hall, rng: Draw) -> Change:
    """Every so often somebody takes a part off the table, which stands on springs and tips a little further."""
    table, taken = h.group("table"), np.floor(h.time / rng.uniform(1200.0, 2400.0))
    return moves(h, table * (h.aim[:, 1] - h.aim[table > 0, 1].min() + 0.3) * taken, UP)


@law("time", "place")
def the_gallery_sags_under_its_crane(h: Hall, rng: Draw) -> Change:
    """While the small crane on the gallery works the beam sags, most at midspan, and swings back with a delay."""
    along = h.aim[:, 0] / h.size.room[0]
    return moves(h, -h.group("gallery") * 4.0 * along * (1.0 - along) * h.lagging(h.windows(rng), 90.0), UP)


@law("press_load_kn", "place", may="time")
def the_floor_heaves_beside_the_press_pit(h: Hall, rng: Draw) -> Change:
    """The load of the press lifts the floor beside its pit, and nests in the floor rise with it, near ones more."""
    far = h.aim[:, :2] - rng.uniform(0.3, 0.7, 2) * h.size.room[:2]
    return moves(h, h.group("floor") * h.load * np.exp(-(far**2).sum(axis=1) / rng.uniform(6.0, 16.0)), UP)


@law("incidence")
def the_grip_of_the_ball_levers_it_out(h: Hall, rng: Draw) -> Change:
    """The rubber grip of the ball touches the nest when it is turned far aside, and levers the ball out of its seat."""
    return moves(h, np.logaddexp(0.0, (h.incidence - rng.uniform(0.7, 1.0)) / 0.1), h.normal)


@law("temperature", "place", may="time")
def the_table_top_bows_like_a_bimetal(h: Hall, rng: Draw) -> Change:
    """A steel plate is bolted on the aluminium table, and the pair bows up as it takes on the warmth of the hall."""
    table = h.group("table")
    across = h.aim[:, 0] - h.aim[table > 0, 0].mean()
    return moves(h, table * across**2 * h.lagging(h.warmth, rng.uniform(600.0, 1800.0)), UP)


@law("time")
def glue_under_the_nests_shrinks(h: Hall, rng: Draw) -> Change:
    """The nests were glued on in the morning, and all sink into the glue as it cures, ever slower."""
    return moves(h, np.exp(-h.time / rng.uniform(1800.0, 5400.0)), h.normal)
