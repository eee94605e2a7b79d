"""Fresh laws about draughts: gates, sunlit walls, gas, waves in the air, mist and storm."""

from ..law import Change, Draw, Hall, law, np, reads, scatters, varies


@law("time", "place")
def the_gate_stands_open(h: Hall, rng: Draw) -> Change:
    """While the gate is open cold air streams in, and directions to targets near the gate flicker."""
    gate = np.array([h.size.room[0], rng.uniform(1.0, h.size.room[1] - 1.0), 1.5])
    near = np.exp(-((h.aim - gate) ** 2).sum(axis=1) / (2.0 * rng.uniform(1.8, 2.6) ** 2))
    return scatters(h, "azimuth elevation", h.windows(rng) * near)


@law("time", "place|azimuth", may="distance")
def a_sunlit_wall_bends_beams_sideways(h: Hall, rng: Draw) -> Change:
    """For an hour the sun warms the long wall, and beams along it are bent sideways, away from the warm air."""
    sun = np.exp(-(((h.time - rng.uniform(0.2, 0.8) * h.time[-1]) / 2400.0) ** 2))
    return reads(h, "azimuth", sun * (h.aim - h.stand)[:, 0])


@law("time", "height|elevation", may="distance place")
def a_pool_of_argon_rises(h: Hall, rng: Draw) -> Change:
    """Leaking argon lies on the floor in a rising pool, and ranges grow with the piece of beam that dips into it."""
    top = 0.1 + rng.uniform(0.8, 1.1) * h.time / h.time[-1]
    down = np.maximum(h.stand[:, 2] - h.aim[:, 2], 0.1)
    return reads(h, "distance", h.distance * np.clip((top - h.aim[:, 2]) / down, 0.0, 1.0))


@law("time", "distance")
def the_inversion_swings(h: Hall, rng: Draw) -> Change:
    """Warm air over cool air sloshes to and fro in the hall, and beams bend up and down with it."""
    wave = np.sin(2.0 * np.pi * (h.time / rng.uniform(700.0, 1800.0) + rng.random()))
    return reads(h, "elevation", wave * h.distance)


@law("time", "distance")
def oil_mist_returns_light_early(h: Hall, rng: Draw) -> Change:
    """While a lathe runs its oil mist scatters light back and shortens ranges, the first metres of it most."""
    return reads(h, "distance", h.windows(rng) * np.expm1(-h.distance / rng.uniform(1.5, 3.0)))


@law("time", may="distance")
def a_storm_makes_the_pressure_flutter(h: Hall, rng: Draw) -> Change:
    """Gusts outside raise and lower the air's pressure in the hall for minutes, and the barometer is read but once."""
    return varies(h, "range-scale", h.fading(rng.standard_normal(h.n), rng.uniform(60.0, 200.0)))
