"""Fresh laws about rotas: breaks, trains, deliveries, heaters, self-checks and compressors that keep to a timetable."""

from ..law import UP, Change, Draw, Hall, law, leans, level, moves, np, scatters, varies


@law("time")
def the_head_cools_in_the_breaks(h: Hall, rng: Draw) -> Change:
    """In each break the head cools down, the longer the break the more, and its axes close up again with the work."""
    cold = h.fading(np.maximum(h.gap - 60.0, 0.0) / 1800.0, rng.uniform(150.0, 500.0))
    return varies(h, "transit-offset", cold)


@law("time")
def trains_pass_behind_the_hall(h: Hall, rng: Draw) -> Change:
    """A train passes at regular times, and for a minute or two the ground tilts all stands towards the track."""
    passing = np.mod(h.time + rng.uniform(0.0, 900.0), rng.uniform(500.0, 900.0)) < rng.uniform(60.0, 150.0)
    return leans(h, passing, level(rng))


@law("time", "place")
def pallets_pile_up_on_the_floor(h: Hall, rng: Draw) -> Change:
    """A pallet is put down at each delivery, always in the same corner, and the floor targets round it sink further."""
    away = h.aim[:, :2] - rng.uniform([2.0, 1.5], [h.size.room[0] - 2.0, h.size.room[1] - 1.5])
    pallets = np.floor(h.time / rng.uniform(1200.0, 2400.0) + rng.random())
    return moves(h, -h.group("floor") * pallets * np.exp(-(away**2).sum(axis=1) / 8.0), UP)


@law("temperature", may="time")
def a_radiant_heater_keeps_switching(h: Hall, rng: Draw) -> Change:
    """A heater with a coarse thermostat shines on the stands from one side, so that they lean with a delay."""
    heated = 1.0 - h.latched(h.warmth, -0.1, 0.1)
    return leans(h, h.lagging(heated, rng.uniform(60.0, 240.0)), level(rng))


@law("time")
def each_self_check_sets_another_index(h: Hall, rng: Draw) -> Change:
    """After a fixed number of pointings the head checks itself and sets its vertical index anew, never quite alike."""
    check = np.arange(h.n) // int(rng.integers(20, 41))
    return varies(h, "vertical-index", rng.standard_normal(check[-1] + 1)[check])


@law("time")
def the_compressor_next_door_runs(h: Hall, rng: Draw) -> Change:
    """A compressor next door runs for a part of each cycle and shakes the scope up and down."""
    return scatters(h, "elevation", h.windows(rng))
