"""Laws about stands, and what they stand on."""

from ..law import UP, Change, Draw, Hall, law, leans, level, np, scatters, shifts


@law("azimuth", may="face")
def a_stiff_cable_drags_on_the_stand(h: Hall, rng: Draw) -> Change:
    """The cable to the head is too short, so its pull tilts the stand the more the farther the head turned from it."""
    mine = h.pointings.tracker == rng.integers(len(h.trackers))
    pull = np.mod(h.circle - rng.uniform(-np.pi, np.pi), 2 * np.pi) / np.pi - 1.0
    bearing = h.yaw[h.pointings.station] + rng.uniform(-np.pi, np.pi)
    outlet = np.column_stack([np.cos(bearing), np.sin(bearing), np.zeros(h.n)])
    return leans(h, mine * pull, outlet)


@law("approach", may="time azimuth face")
def the_head_winds_up_its_tripod(h: Hall, rng: Draw) -> Change:
    """Each turn of the heavy head twists the joints of the tripod a little, and they creep back within minutes."""
    turn = h.change(h.azimuth + np.pi * h.back)
    return leans(h, -h.fading(turn, rng.uniform(40.0, 150.0)), UP)


@law("time")
def a_compressor_hose_lies_under_one_foot(h: Hall, rng: Draw) -> Change:
    """A hose swells under one foot of the tripod while the compressor runs, and tips and lifts the stand."""
    swollen = h.one_station(rng) * h.windows(rng)
    return leans(h, swollen, level(rng)) + shifts(h, 0.3 * swollen, UP)


@law("time")
def sun_between_clouds_bends_the_stands(h: Hall, rng: Draw) -> Change:
    """Whenever the sun comes out it warms one side of the column, which bends away from the window with some delay."""
    return leans(h, h.lagging(h.windows(rng), rng.uniform(250.0, 500.0)), level(rng))


@law("approach", may="time azimuth")
def a_pipe_stand_rings_after_a_long_swing(h: Hall, rng: Draw) -> Change:
    """The head is stopped at the end of a long swing, and a slim stand still rings where the reading follows soon."""
    return scatters(h, "azimuth elevation", np.abs(h.change(h.azimuth)) * np.exp(-h.gap / rng.uniform(8.0, 16.0)))


@law("press_load_kn", may="place time")
def the_press_dishes_the_slab(h: Hall, rng: Draw) -> Change:
    """Under the load of the press the slab is dished, and the stands lean towards the press, those near it most."""
    press = rng.uniform([0.2, 0.2, 0.0], [0.8, 0.8, 0.0]) * h.size.room
    way = (press - h.stand) * [1.0, 1.0, 0.0]
    far = np.sqrt((way**2).sum(axis=1))
    return leans(h, h.load * np.exp(-far / rng.uniform(1.5, 4.0)), np.cross(UP, way / far[:, None]))


@law("time")
def a_leaking_lift_stand_is_pumped_up(h: Hall, rng: Draw) -> Change:
    """The jack of a lift stand leaks and sinks until its regulator pumps it up again, over and over."""
    period = rng.uniform(240.0, 600.0)
    return shifts(h, -h.one_station(rng) * np.mod(h.time + rng.uniform(0.0, period), period) / period, UP)


@law("distance", may="place height azimuth elevation")
def raised_boards_give_way_to_the_operator(h: Hall, rng: Draw) -> Change:
    """One station stands on raised boards, which dip towards the operator when he holds the ball near by."""
    way = (h.aim - h.stand) * [1.0, 1.0, 0.0]
    far = np.sqrt((way**2).sum(axis=1))
    dip = h.one_station(rng) * (h.aim[:, 2] < 1.8) * np.exp(-far / rng.uniform(0.9, 1.8))
    return leans(h, dip, np.cross(UP, way / far[:, None]))
