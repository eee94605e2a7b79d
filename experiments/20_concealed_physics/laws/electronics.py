"""Fresh laws about lasers, distance meters, circles, motors, firmware and clocks."""

from ..law import Change, Draw, Hall, law, leans, np, reads, scatters, varies


@law("time")
def the_laser_finds_its_lock_after_every_move(h: Hall, rng: Draw) -> Change:
    """The laser is switched off to be carried, and its wavelength settles anew at every set-up."""
    return varies(h, "range-scale", np.exp(-h.since_setup / rng.uniform(150.0, 500.0)))


@law("time")
def the_laser_hops_between_two_modes(h: Hall, rng: Draw) -> Change:
    """The tube grows as it warms and the laser hops between two modes, ever more slowly."""
    hops = rng.uniform(8.0, 14.0) * (1.0 - np.exp(-h.time / rng.uniform(2500.0, 5000.0)))
    return varies(h, "range-scale", np.where(np.mod(hops, 2.0) < 1.0, 1.0, 0.0))


@law("distance", "approach", may="time")
def the_amplifier_changes_its_range_with_hysteresis(h: Hall, rng: Draw) -> Change:
    """The amplifier of the distance meter turns up when a target is far and down again only when one is near."""
    low, high = np.quantile(h.distance, rng.uniform([0.2, 0.6], [0.4, 0.8]))
    return reads(h, "distance", h.latched(h.distance, low, high))


@law("distance", "incidence")
def weak_light_makes_the_distance_long(h: Hall, rng: Draw) -> Change:
    """The phase of the distance meter drifts with the light that returns, which slanting balls and distance weaken."""
    light = rng.uniform(1.0, 3.0) * np.log(np.clip(np.cos(h.incidence), 0.1, None)) - 2.0 * np.log(h.distance)
    return reads(h, "distance", -light)


@law("distance")
def a_table_in_the_firmware_ends_too_early(h: Hall, rng: Draw) -> Change:
    """The firmware's table of range corrections ends at some distance, and beyond it the last value is kept."""
    return reads(h, "distance", np.clip(h.distance - np.quantile(h.distance, rng.uniform(0.5, 0.75)), 0.0, None))


@law("distance", "temperature")
def crosstalk_comes_with_the_warmth(h: Hall, rng: Draw) -> Change:
    """A warm oscillator leaks into the receiver, and the distance waves the more the warmer it is."""
    wave = np.sin(2 * np.pi * h.distance / rng.uniform(1.2, 4.0) + rng.uniform(0.0, 2 * np.pi))
    return reads(h, "distance", wave * (h.warmth - h.warmth.min()))


@law("approach|time", may="distance")
def near_balls_heat_the_detector(h: Hall, rng: Draw) -> Change:
    """The strong light of near balls heats the detector, and the zero of the range remembers it for some minutes."""
    return varies(h, "range-offset", h.fading(1.0 / h.distance**2, rng.uniform(80.0, 300.0)))


@law("approach|time", may="azimuth")
def a_pillar_eats_counts(h: Hall, rng: Draw) -> Change:
    """Each time the head swings past a pillar the beam is broken, and the interferometer loses some counts more."""
    side = np.sin(h.azimuth - rng.uniform(-np.pi, np.pi)) > 0
    passes = (h.change(side.astype(float)) != 0.0) & (np.abs(h.swing) < 2.0)
    total = np.cumsum(passes)
    return reads(h, "distance", h.one_station(rng) * (total - total[h.starts]))


@law("time")
def the_zero_of_the_range_is_made_anew_by_a_timer(h: Hall, rng: Draw) -> Change:
    """A timer calibrates the distance meter every quarter of an hour, and each time the zero comes out differently."""
    block = (h.time / rng.uniform(600.0, 1100.0)).astype(int)
    return varies(h, "range-offset", rng.standard_normal(block.max() + 1)[block])


@law("time")
def one_of_two_reading_heads_fails(h: Hall, rng: Draw) -> Change:
    """One of two opposite reading heads of the azimuth circle drops out, and from then on the eccentricity is seen."""
    return varies(h, "azimuth-eccentricity-sin", h.time > rng.uniform(0.3, 0.7) * h.time[-1])


@law("approach|time", may="face")
def the_elevation_circle_slips_with_every_plunge(h: Hall, rng: Draw) -> Change:
    """The ring of the elevation circle is loose on its shaft and slips a little whenever the head is turned over."""
    return varies(h, "vertical-index", np.cumsum(np.abs(h.change(h.back))))


@law("approach|time")
def busy_motors_tilt_the_transit_axis(h: Hall, rng: Draw) -> Change:
    """The azimuth motor heats one bearing of the transit axis with every turn, and the heat leaves slowly."""
    return varies(h, "transit-tilt", h.fading(np.abs(h.swing), rng.uniform(200.0, 700.0)))


@law("time")
def a_thermostat_swings_the_beam(h: Hall, rng: Draw) -> Change:
    """The thermostat of the optical bench heats and rests by turns, and the beam tilts to and fro like a saw."""
    cycle = rng.uniform(400.0, 1200.0)
    saw = np.mod(h.time + rng.uniform(0.0, cycle), cycle) / cycle
    return varies(h, "beam-tilt", np.abs(2.0 * saw - 1.0))


@law("time")
def mains_hum_beats_with_the_reading_rate(h: Hall, rng: Draw) -> Change:
    """Hum of the mains leaks into the azimuth reading and beats slowly with the rate at which it is sampled."""
    return reads(h, "azimuth", np.sin(2 * np.pi * h.time / rng.uniform(150.0, 500.0) + rng.uniform(0.0, 6.0)))


@law("temperature", may="time")
def the_level_in_the_foot_drifts_with_warmth(h: Hall, rng: Draw) -> Change:
    """The firmware levels the readings by an inclinometer in the foot whose zero moves with the temperature."""
    axis = h.pointings.rotation[h.pointings.station] @ np.array([np.cos(0.7), np.sin(0.7), 0.0])
    return leans(h, h.warmth, axis)


@law("face", "elevation")
def the_tube_hangs_on_the_other_side(h: Hall, rng: Draw) -> Change:
    """Turned over, the head rests on another ball of its bearing and sags the more the higher it looks."""
    return reads(h, "elevation", h.back * np.clip(h.elevation - rng.uniform(-0.3, 0.3), 0.0, None))


@law("approach", may="time azimuth")
def read_before_the_head_has_settled(h: Hall, rng: Draw) -> Change:
    """The reading is triggered by a fixed delay, and after long swings the head still shakes."""
    if h.back.any():
        raise LookupError("on two faces nearly every swing is half a turn")
    return scatters(h, "azimuth", h.swing**2)


@law("time")
def the_filter_is_empty_when_work_begins(h: Hall, rng: Draw) -> Change:
    """The firmware's filter of the elevation starts at zero, and the first pointings of each set-up read low."""
    return reads(h, "elevation", np.exp(-h.order / rng.uniform(3.0, 8.0)))
