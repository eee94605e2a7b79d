"""Fresh laws about vapour, draughts, lamps and weather."""

from ..law import UP, Change, Draw, Hall, law, leans, level, np, reads, scatters, shifts, varies


@law("time", "place", may="azimuth elevation distance height")
def steam_cloud_over_the_wash_bay(h: Hall, rng: Draw) -> Change:
    """While parts are washed a cloud of steam hangs in the hall, and beams that cross it measure another air."""
    bay = rng.uniform(0.3, 0.7, 3) * h.size.room * [1.0, 1.0, 0.5]
    along = np.clip(((bay - h.stand) * (h.aim - h.stand)).sum(axis=1) / h.distance**2, 0.0, 1.0)
    miss = ((h.stand + along[:, None] * (h.aim - h.stand) - bay) ** 2).sum(axis=1)
    return reads(h, "distance", h.windows(rng) * np.exp(-miss / rng.uniform(0.7, 1.4) ** 2))


@law("azimuth|place", may="elevation height distance")
def a_work_lamp_dazzles_the_position_sensor(h: Hall, rng: Draw) -> Change:
    """A bright lamp somewhere in the hall pulls the tracking sensor aside when the beam looks towards it."""
    lamp = rng.uniform(0.1, 0.9, 3) * h.size.room - h.stand
    towards = (lamp * (h.aim - h.stand)).sum(axis=1) / h.distance / np.sqrt((lamp**2).sum(axis=1))
    return varies(h, "beam-offset-lateral", np.exp((towards - 1.0) / rng.uniform(0.1, 0.25)))


@law("elevation", "time", may="height")
def skylight_brightens_above_the_horizon(h: Hall, rng: Draw) -> Change:
    """As the day brightens, steep beams look into the skylight, and its glare shifts the vertical index."""
    steep = 0.5 * (1.0 + np.tanh((h.elevation - rng.uniform(0.0, 0.3)) / rng.uniform(0.08, 0.2)))
    return varies(h, "vertical-index", steep * (h.time / h.time[-1]) ** 2)


@law("time", "place", may="distance")
def draught_curtain_at_the_gate(h: Hall, rng: Draw) -> Change:
    """While the gate is open a curtain of draught crosses the hall, and angles of beams through it scatter."""
    gate = rng.uniform(0.3, 0.7) * h.size.room[0]
    return scatters(h, "azimuth elevation", h.windows(rng) * ((h.stand[:, 0] - gate) * (h.aim[:, 0] - gate) < 0.0))


@law("time")
def squall_line_lifts_the_pressure(h: Hall, rng: Draw) -> Change:
    """A squall passes, and within minutes the pressure, which was typed in by hand before, is another one."""
    moment = rng.choice(h.time)
    return varies(h, "range-scale", np.tanh((h.time - moment) / rng.uniform(100.0, 600.0)))


@law("time")
def compressor_blows_on_one_leg(h: Hall, rng: Draw) -> Change:
    """The compressor's exhaust blows on a leg of one stand while it runs, which leans and grows with a lag."""
    grown = h.random_station(rng) * h.lagging(h.windows(rng), rng.uniform(100.0, 500.0))
    return leans(h, grown, level(rng)) + shifts(h, rng.uniform(0.3, 0.8) * grown, UP)
