"""Fresh laws about circuits: supplies, diodes, oscillators, lamps and batteries."""

from ..law import Change, Draw, Hall, law, np, reads, scatters, varies


@law("press_load_kn")
def the_supply_sags_under_the_press(h: Hall, rng: Draw) -> Change:
    """At a high load the press pulls down the mains, and the range meter's phase shifts with its supply voltage."""
    return varies(h, "range-offset", np.maximum(h.load - rng.uniform(0.4, 0.7), 0.0))


@law("distance")
def a_near_ball_floods_the_photodiode(h: Hall, rng: Draw) -> Change:
    """The strong return of a near ball drives the photodiode of the range meter into saturation and delays it."""
    return reads(h, "distance", np.exp(-h.distance / rng.uniform(0.7, 1.5)))


@law("temperature", may="distance")
def the_laser_hops_between_modes(h: Hall, rng: Draw) -> Change:
    """The laser's frequency is drawn along by the temperature until it hops back by one mode."""
    hop = rng.uniform(0.3, 0.5)
    return varies(h, "range-scale", np.mod(h.warmth / hop + rng.random(), 1.0))


@law("time")
def mains_hum_beats_with_the_sampling(h: Hall, rng: Draw) -> Change:
    """Hum in the amplifier of the azimuth circle beats slowly with the rate at which the circle is sampled."""
    return reads(h, "azimuth", np.sin(2.0 * np.pi * (h.time / rng.uniform(240.0, 600.0) + rng.random())))


@law("time")
def a_battery_runs_low(h: Hall, rng: Draw) -> Change:
    """As a battery runs low the laser dims and ranges scatter more, until the next battery is put in."""
    return scatters(h, "distance", np.mod(h.time / rng.uniform(2400.0, 4200.0) + rng.random(), 1.0) ** 3)


@law("time", may="azimuth")
def the_lamp_of_the_circle_warms_its_ring(h: Hall, rng: Draw) -> Change:
    """Switched on at each set-up, the lamp warms the azimuth scale, which two clamps pull into an oval at first."""
    return varies(h, "azimuth-second-order-cos", np.exp(-h.since_setup / rng.uniform(120.0, 400.0)))
