"""Fresh laws about amplifiers, supplies, counters and lasers."""

from ..law import Change, Draw, Hall, law, np, reads, scatters, varies


@law("distance", "incidence")
def second_gain_stage_delays_weak_signals(h: Hall, rng: Draw) -> Change:
    """A weak return, from afar or hit askew, is amplified by a second stage, which delays it by a fixed time."""
    signal = np.clip(np.cos(h.incidence), 0.05, 1.0) ** rng.uniform(1.0, 2.0) / h.distance**2
    return reads(h, "distance", 1.0 * (signal < np.quantile(signal, rng.uniform(0.3, 0.6))))


@law("time")
def mains_beats_with_the_sampling_clock(h: Hall, rng: Draw) -> Change:
    """Mains hum in the signal of the vertical circle beats slowly with the clock that samples it."""
    return reads(h, "elevation", np.sin(2 * np.pi * h.time / rng.uniform(150.0, 500.0) + rng.uniform(0.0, 2 * np.pi)))


@law("approach", may="time azimuth")
def supply_sags_after_long_slews(h: Hall, rng: Draw) -> Change:
    """Each slew in azimuth drains the common supply, and the phase meter's zero recovers only within a minute."""
    return varies(h, "range-offset", h.fading(np.abs(h.swing), rng.uniform(20.0, 70.0)))


@law("time", may="elevation")
def loose_contact_drops_one_read_head(h: Hall, rng: Draw) -> Change:
    """A loose contact drops one of two opposite read heads at times, and the vertical circle reads off its centre."""
    phase, breaks = rng.uniform(-np.pi, np.pi), np.sort(rng.uniform(0.0, h.time[-1], 2 * rng.integers(2, 6)))
    dropped = np.searchsorted(breaks, h.time) % 2
    across = varies(h, "elevation-eccentricity-cos", np.cos(phase) * dropped)
    return across + varies(h, "elevation-eccentricity-sin", np.sin(phase) * dropped)


@law("elevation", may="face")
def a_bit_of_the_vertical_counter_leaks(h: Hall, rng: Draw) -> Change:
    """A bit of the vertical counter leaks into the interpolator: a fixed amount is added wherever it is set."""
    raw, step = np.where(h.back > 0, np.pi - h.elevation, h.elevation), rng.uniform(0.12, 0.35)
    return reads(h, "elevation", np.mod(np.floor(raw / step), 2.0) * (1.0 - 2.0 * h.back))


@law("temperature")
def laser_modes_compete_at_one_temperature(h: Hall, rng: Draw) -> Change:
    """Near one temperature of the hall two modes of the laser compete, and distances scatter until it is left again."""
    return scatters(h, "distance", np.exp(-(((h.warmth - rng.choice(h.warmth)) / rng.uniform(0.06, 0.2)) ** 2)))
