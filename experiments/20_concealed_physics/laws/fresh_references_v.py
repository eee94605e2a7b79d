"""Fresh laws about nests, reflectors and known lengths."""

from ..law import OUT, UP, Change, Draw, Hall, gauge, law, moves, np, varies


def placed(h: Hall) -> np.ndarray:
    """(n,) 1 where the reflector was carried to another nest before the pointing, 0 where it stayed."""
    return np.diff(h.pointings.target, prepend=-1) != 0


@law("approach|time", may="place")
def each_placing_presses_soft_glue_a_little_further(h: Hall, rng: Draw) -> Change:
    """Nests on wall and gallery are glued on; with every placing the glue yields a little, less each time."""
    visits, new = np.zeros(h.n), placed(h)
    for target in np.unique(h.pointings.target):
        own = h.pointings.target == target
        visits[own] = np.cumsum(new[own])
    yielded = 1.0 - np.exp(-visits / rng.uniform(1.5, 5.0))
    return moves(h, (h.group("wall") + h.group("gallery")) * yielded, -h.normal)


@law("incidence")
def the_ball_is_out_of_round_where_it_rests(h: Hall, rng: Draw) -> Change:
    """The ball rests on another part of its surface when it is turned to another tracker, and rises where it is fat."""
    lobes = int(rng.integers(2, 5))
    return moves(h, np.cos(lobes * h.incidence + rng.uniform(-np.pi, np.pi)), h.normal)


@law()
def the_deviations_of_two_bars_are_exchanged(h: Hall, rng: Draw) -> Change:
    """The certificate gives the deviation of each bar from its nominal length; they were written down crosswise."""
    return gauge(h, rng.choice([-1.0, 1.0]) * np.array([1.0, -1.0]))


@law("temperature", may="place time")
def brackets_of_unequal_length_carry_the_wall_nests(h: Hall, rng: Draw) -> Change:
    """Each nest of the wall has a bracket of its own length, which follows the temperature of the hall with a delay."""
    lengths = rng.uniform(0.0, 1.0, len(h.targets)) ** 2
    return moves(
        h, h.group("wall") * lengths[h.pointings.target] * h.lagging(h.warmth, rng.uniform(200.0, 1500.0)), OUT
    )


@law("time", may="place")
def the_table_floats_up_while_its_compressor_runs(h: Hall, rng: Draw) -> Change:
    """The table has air cushions; it rises while the compressor runs, further at the end where the hose comes in."""
    middle = h.aim[h.group("table") > 0].mean(axis=0)
    rise = 1.0 + rng.uniform(-0.5, 0.5) * (h.aim[:, 0] - middle[0]) + rng.uniform(-0.5, 0.5) * (h.aim[:, 1] - middle[1])
    return moves(h, h.group("table") * rise * h.lagging(h.windows(rng), rng.uniform(30.0, 150.0)), UP)


@law("approach|time")
def two_reflectors_take_turns(h: Hall, rng: Draw) -> Change:
    """One man places a reflector while the other is measured; their centres are not at the same depth."""
    return varies(h, "range-offset", rng.choice([-1.0, 1.0]) * np.mod(np.cumsum(placed(h)), 2))
