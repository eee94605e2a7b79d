"""Used laws about boxes: electronics, encoders, supplies and firmware."""

from ..law import Change, Draw, Hall, law, leans, level, np, reads, scatters, varies


@law("elevation", may="face")
def interpolator_skips_on_the_upper_half(h: Hall, rng: Draw) -> Change:
    """The table that interpolates the elevation circle was burned for one half only; it is flat above a limit."""
    return reads(h, "elevation", np.maximum(h.elevation - rng.uniform(-0.1, 0.2), 0.0) ** 2)


@law("approach", may="azimuth time")
def angles_are_older_than_ranges(h: Hall, rng: Draw) -> Change:
    """The azimuth goes through a slow filter and still tells some of where the head came from."""
    return reads(h, "azimuth", -h.fading(h.swing, rng.uniform(4.0, 12.0)))


@law("time")
def tilt_sensor_wanders(h: Hall, rng: Draw) -> Change:
    """The firmware levels all pointings by a tilt sensor with a bad contact, which wanders at random."""
    return leans(h, h.walk(rng), level(rng)) + leans(h, h.walk(rng), level(rng))


@law("time")
def counter_rounds_up_until_cleared(h: Hall, rng: Draw) -> Change:
    """The range counter keeps a rounding of each pointing and is cleared whenever its buffer is full."""
    return varies(h, "range-offset", np.mod(h.order, rng.integers(12, 24)))


@law("press_load_kn", may="elevation")
def mains_sag_under_the_press(h: Hall, rng: Draw) -> Change:
    """The press pulls the mains down and with them the lamp of the elevation circle, whose zero follows."""
    return varies(h, "vertical-index", h.load**2)


@law("press_load_kn", may="time")
def converter_of_the_press_hums(h: Hall, rng: Draw) -> Change:
    """The converter of the press disturbs the phase meter, so ranges scatter under load."""
    return scatters(h, "distance", h.load**2)


@law("press_load_kn", may="distance time")
def quartz_is_pulled_by_the_field(h: Hall, rng: Draw) -> Change:
    """The stray field of the press pulls the quartz of the range meter, which recovers slowly."""
    return varies(h, "range-scale", h.lagging(h.load, rng.uniform(200.0, 900.0)))


@law("face", "elevation")
def plunged_angles_get_the_wrong_sign(h: Hall, rng: Draw) -> Change:
    """The firmware adds the correction of the transit axis to azimuths of the back face with the sign of the front."""
    return reads(h, "azimuth", h.back * np.tan(h.elevation))


@law(may="distance")
def one_box_thinks_in_fahrenheit(h: Hall, rng: Draw) -> Change:
    """One of two trackers takes the air temperature for another unit, so all its ranges are out of scale."""
    return varies(h, "range-scale", h.one_tracker(rng))


@law("time", may="place")
def battery_of_one_tracker_runs_flat(h: Hall, rng: Draw) -> Change:
    """A fresh battery holds for a while, then the voltage of the range meter falls ever faster until it is changed."""
    return varies(h, "range-offset", h.one_tracker(rng) * (h.since_setup / 600.0) ** 3)


@law("temperature", may="distance")
def thermometer_stops_at_its_limit(h: Hall, rng: Draw) -> Change:
    """The thermometer of the tracker shows nothing above a limit, and from there on ranges lack their correction."""
    return varies(h, "range-scale", np.maximum(h.warmth - np.quantile(h.warmth, rng.uniform(0.4, 0.6)), 0.0))


@law("distance", "approach")
def gain_stage_switches_late(h: Hall, rng: Draw) -> Change:
    """The receiver goes to high gain beyond one distance and comes back only well below it; the stages differ."""
    low, high = np.quantile(h.distance, [0.25, 0.7])
    return varies(h, "range-offset", h.latched(h.distance, low, high))


@law("azimuth", may="face")
def fingerprint_on_the_azimuth_circle(h: Hall, rng: Draw) -> Change:
    """A fingerprint covers some degrees of the circle and pulls the reading there to one side."""
    return reads(h, "azimuth", np.exp((np.cos(h.circle - rng.uniform(-np.pi, np.pi)) - 1.0) / 0.08))
