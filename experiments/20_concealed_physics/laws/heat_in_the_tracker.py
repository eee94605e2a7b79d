"""Fresh laws about warmth that gets into the tracker, and what it bends there."""

from ..law import Change, Draw, Hall, law, np, reads, varies


@law("temperature", may="time")
def the_glass_circle_slides_on_its_hub(h: Hall, rng: Draw) -> Change:
    """Glass and steel grow differently, and the azimuth circle creeps off centre as the base takes on the warmth."""
    return varies(h, "azimuth-eccentricity-cos", h.lagging(h.warmth, rng.uniform(900.0, 2700.0)))


@law("time")
def the_sun_reaches_the_tracker(h: Hall, rng: Draw) -> Change:
    """From some hour on sun falls through the gate, warms the housing on one side, and tilts the beam ever further."""
    return varies(h, "beam-tilt", np.maximum(h.time - rng.uniform(0.3, 0.6) * h.time[-1], 0.0) / 3600.0)


@law("elevation", "time")
def warm_air_off_the_housing_bends_steep_beams(h: Hall, rng: Draw) -> Change:
    """Warm air rises from a tracker that is at work and bends beams that look up through it, not at a cool start."""
    warm = 1.0 - np.exp(-h.since_setup / rng.uniform(400.0, 1200.0))
    return reads(h, "elevation", warm * np.maximum(h.elevation - rng.uniform(-0.1, 0.2), 0.0))


@law("approach|elevation|time", may="approach elevation time")
def holding_the_head_steep_heats_its_motor(h: Hall, rng: Draw) -> Change:
    """The motor heats up while it holds the head off the level, and lifts the mirror until it has cooled again."""
    memory = rng.uniform(500.0, 1500.0)
    given = np.sin(h.elevation) ** 2 * np.minimum(h.gap, 60.0) / memory
    return varies(h, "beam-offset-vertical", h.fading(given, memory))


@law("time")
def a_battery_runs_empty_at_one_set_up(h: Hall, rng: Draw) -> Change:
    """Where no socket was near the tracker ran on a battery, whose voltage falls slowly first and then ever faster."""
    return varies(h, "range-offset", h.one_station(rng) * (h.since_setup / 900.0) ** rng.uniform(2.0, 4.0))


@law("temperature|time", may="temperature time")
def the_rim_warms_before_the_hub(h: Hall, rng: Draw) -> Change:
    """How fast the hall warms moves the elevation circle, whose thin rim follows at once and its hub late."""
    return varies(h, "elevation-eccentricity-sin", h.warmth - h.lagging(h.warmth, rng.uniform(900.0, 2400.0)))


@law("temperature", may="time")
def one_tracker_has_lost_its_thermal_table(h: Hall, rng: Draw) -> Change:
    """One of two trackers came back from repair without the table that corrects its mirror for the temperature."""
    return varies(h, "transit-offset", h.one_tracker(rng) * (h.warmth + rng.uniform(0.0, 0.2) * h.warmth**2))
