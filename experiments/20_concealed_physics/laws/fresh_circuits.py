"""Fresh laws about circuits: receiver, counter, scale, oscillator."""

from ..law import Change, Draw, Hall, law, np, reads, varies


@law("distance")
def a_gain_stage_is_switched_in_beyond_a_distance(h: Hall, rng: Draw) -> Change:
    """Far returns are weak, a second amplifier is switched in beyond some distance, and its delay is not calibrated."""
    return reads(h, "distance", (h.distance > rng.uniform(3.5, 6.5)).astype(float))


@law("approach|time", may="distance")
def fringes_are_lost_on_the_way_from_the_home_nest(h: Hall, rng: Draw) -> Change:
    """The counter drops some fringes for every metre that the ball is carried, until it is set in the home nest."""
    carried = np.cumsum(np.abs(h.change(h.distance)))
    return reads(h, "distance", -0.02 * (carried - carried[h.starts]))


@law("azimuth")
def a_scratch_on_the_azimuth_scale(h: Hall, rng: Draw) -> Change:
    """Over a few degrees a scratch on the glass scale pulls the one read head that sees it."""
    off = np.cos(h.circle - rng.choice(h.circle) - rng.normal(0.0, 0.03))
    width = np.radians(rng.uniform(5.0, 14.0))
    return reads(h, "azimuth", np.exp((off - 1.0) / width**2))


@law("temperature", may="time")
def a_knot_of_the_temperature_table_is_wrong(h: Hall, rng: Draw) -> Change:
    """The range is corrected by a table over the temperature, and one of its knots holds a wrong number."""
    knot = rng.uniform(*np.quantile(h.warmth, [0.2, 0.8]))
    return reads(h, "distance", np.clip(1.0 - np.abs(h.warmth - knot) / rng.uniform(0.15, 0.35), 0.0, None))


@law("time")
def a_welder_disturbs_the_phase_meter(h: Hall, rng: Draw) -> Change:
    """While a welding machine runs at the same mains, its field shifts the phase that the distance meter measures."""
    return reads(h, "distance", h.windows(rng))


@law("time", may="place distance")
def the_oscillator_sags_on_an_empty_battery(h: Hall, rng: Draw) -> Change:
    """One station is measured on battery; its voltage falls ever faster, and the modulation frequency with it."""
    here = h.random_station(rng)
    spent = h.since_setup / h.since_setup[here > 0].max()
    return varies(h, "range-scale", here * spent ** rng.uniform(1.5, 3.0))
