"""Used laws about stands, and the floor under them."""

from ..law import UP, Change, Draw, Hall, law, leans, level, np, shifts


@law("press_load_kn|time")
def floor_under_a_press(h: Hall, rng: Draw) -> Change:
    """A press stands on the slab of one station; as its load comes and goes, the slab and the station lean."""
    return leans(h, h.one_station(rng) * h.load, level(rng))


@law("time")
def vacuum_foot_is_pumped_up(h: Hall, rng: Draw) -> Change:
    """A stand on a vacuum foot sinks as the foot leaks, until the pump starts and lifts it within a moment."""
    phase = np.mod(h.time / rng.uniform(120.0, 400.0) + rng.random(), 1.0)
    return shifts(h, h.one_station(rng) * (np.exp(-rng.uniform(2.0, 5.0) * phase) - 1.0), UP)


@law("distance|place", may="distance place azimuth elevation height")
def floor_panel_gives_under_the_crew(h: Hall, rng: Draw) -> Change:
    """Who holds the reflector near the tripod bends the raised floor across its joists; on the gallery he does not."""
    x, y, _ = (h.aim - h.stand).T
    return leans(h, np.exp(-(x**2 + y**2) / rng.uniform(1.8, 2.8) ** 2) * (1.0 - h.group("gallery")), level(rng))
