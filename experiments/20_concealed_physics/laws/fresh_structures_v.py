"""Fresh laws about floors, walls, galleries and what loads them."""

from ..law import OUT, UP, Change, Draw, Hall, law, leans, moves, np, scatters, shifts


@law("time", "place")
def the_floor_dips_towards_the_crane_as_it_travels(h: Hall, rng: Draw) -> Change:
    """The bridge of a crane goes to and fro; the floor sags under it, and a stand leans towards where the crane is."""
    travel = np.sin(2 * np.pi * (h.time / rng.uniform(1500.0, 5000.0) + rng.random()))
    ahead = (h.size.room[0] * (0.5 + 0.4 * travel) - h.stand[:, 0]) / rng.uniform(1.5, 3.5)
    return leans(h, ahead * np.exp(-0.5 * ahead**2), np.array([0.0, 1.0, 0.0]))


@law("time", "height|place")
def the_sunny_wall_bows_out_between_floor_and_roof(h: Hall, rng: Draw) -> Change:
    """The outer side of the wall warms while the sun is on it, and the wall bows out, most at half its height."""
    sun = np.maximum(np.sin(2 * np.pi * (h.time / rng.uniform(14000.0, 30000.0) + rng.random())), 0.0)
    bow = np.sin(np.pi * h.aim[:, 2] / h.size.room[2])
    return moves(h, h.group("wall") * h.lagging(sun, rng.uniform(300.0, 1500.0)) * bow, -OUT)


@law("press_load_kn", "place")
def the_press_sinks_a_bowl_into_the_floor(h: Hall, rng: Draw) -> Change:
    """The load of the press sinks the floor about its foundation, with the nests and the stands that are near."""
    press = rng.uniform([0.2, 0.1], [0.8, 0.9]) * h.size.room[:2]
    wide = rng.uniform(1.2, 3.0)
    nests, stands = (np.exp(-0.5 * ((p[:, :2] - press) ** 2).sum(axis=1) / wide**2) for p in (h.aim, h.stand))
    return moves(h, h.group("floor") * nests * h.load, -UP) + shifts(h, stands * h.load, -UP)


@law("time", "place")
def the_tide_swings_a_gallery_that_is_hinged_to_the_quay(h: Hall, rng: Draw) -> Change:
    """One end of the gallery stands on the quay, the other on a floating dock that rises and falls with the tide."""
    tide = np.sin(2 * np.pi * (h.time / 44714.0 + rng.random()))
    share = h.aim[:, 0] / h.size.room[0]
    share = share if rng.random() < 0.5 else 1.0 - share
    return moves(h, h.group("gallery") * tide * share, np.array([0.0, rng.uniform(-0.4, 0.4), 1.0]))


@law("press_load_kn", may="place distance height")
def the_strokes_of_the_press_make_the_gallery_tremble(h: Hall, rng: Draw) -> Change:
    """The gallery trembles with the strokes of the press, the harder the more; seen from near it is wider."""
    tremble = h.load ** rng.uniform(1.0, 2.0) * (5.0 / h.distance) ** 2
    return scatters(h, "azimuth elevation", h.group("gallery") * tremble)


@law("temperature", "place", may="time")
def the_rail_of_the_gallery_sticks_and_slips(h: Hall, rng: Draw) -> Change:
    """The rail would lengthen with the temperature from its anchor on; it sticks to its clamps, and slips in jerks."""
    held, step, warmth = np.empty(h.n), rng.uniform(0.12, 0.4), h.warmth
    last = warmth[0]
    for i, now in enumerate(warmth.tolist()):
        last = now if abs(now - last) > step else last
        held[i] = last
    anchor = rng.choice([0.0, 0.5, 1.0]) * h.size.room[0]
    return moves(h, h.group("gallery") * held * (h.aim[:, 0] - anchor) / 5.0, OUT)
