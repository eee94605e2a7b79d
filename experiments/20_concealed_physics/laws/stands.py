"""Used laws about stands, and the floor under them."""

from ..law import UP, Change, Draw, Hall, law, leans, level, np, shifts


@law("press_load_kn|time")
def floor_under_a_press(h: Hall, rng: Draw) -> Change:
    """A press stands on the slab of one station; as its load comes and goes, the slab and the station lean."""
    return leans(h, h.one_station(rng) * h.load, level(rng))


@law("time")
def sun_on_a_tripod(h: Hall, rng: Draw) -> Change:
    """The sun comes through a window for part of a set-up and turns the tripod, which cools down afterwards."""
    here = h.one_station(rng)
    times = h.time[here > 0]
    start, width = rng.uniform(times[0], times[-1]), rng.uniform(0.2, 0.5) * np.ptp(times)
    return leans(h, here * np.exp(-(((h.time - start) / width) ** 2)), UP)


@law("azimuth")
def weak_leg(h: Hall, rng: Draw) -> Change:
    """One stand is weak in one direction: the head, out of balance, pushes it there and back as it turns."""
    weak, beam = level(rng), (h.aim - h.stand) / h.distance[:, None]
    return shifts(h, h.one_station(rng) * (beam @ weak), weak)


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


@law("approach|azimuth", may="azimuth time")
def base_creeps_back_under_the_head(h: Hall, rng: Draw) -> Change:
    """The base stands on a sticky mat: every swing of the head turns it backwards, and it comes home in minutes."""
    return leans(h, -h.fading(h.swing, rng.uniform(40.0, 200.0)), UP)
