"""Laws about the electronics that read range and circles."""

from ..law import Change, Draw, Hall, law, np, reads, varies


@law("distance")
def strong_light_drives_the_detector_over(h: Hall, rng: Draw) -> Change:
    """The return of near reflectors is so strong that the range detector clips it, and its phase comes late."""
    return reads(h, "distance", 10.0 * np.exp(-h.distance / rng.uniform(0.8, 1.6)))


@law("distance")
def stray_light_beats_with_a_fading_return(h: Hall, rng: Draw) -> Change:
    """A constant leak inside the range unit beats with the return; it counts for more as the return gets weaker."""
    wave = np.sin(2 * np.pi * (h.distance / rng.uniform(0.8, 1.8) + rng.random()))
    return reads(h, "distance", 0.1 * wave * h.distance**2)


@law("azimuth", may="face")
def a_scratch_on_the_azimuth_disc(h: Hall, rng: Draw) -> Change:
    """Where the reading head comes over a scratch of the disc it reads too far, within some ten degrees."""
    own = h.one_tracker(rng) if len(h.trackers) > 1 else np.ones(h.n)
    off = np.sin(0.5 * (h.circle - rng.choice(h.circle))) / np.sin(0.5 * rng.uniform(0.15, 0.35))
    return reads(h, "azimuth", 5.0 * own * np.exp(-(off**2)))


@law("approach", may="distance time")
def the_gain_still_fits_the_target_before(h: Hall, rng: Draw) -> Change:
    """The gain of the range receiver follows slowly, so it is still a bit too low or high for the new return."""
    left = np.exp(-h.gap / rng.uniform(10.0, 30.0))
    return reads(h, "distance", 10.0 * left * h.change(np.log(h.distance)))


@law("press_load_kn", may="distance")
def the_supply_sags_under_the_press(h: Hall, rng: Draw) -> Change:
    """The press pulls the mains down, and the crystal that is the scale of the ranges goes with its supply."""
    return varies(h, "range-scale", h.load * rng.choice([-1.0, 1.0]))


@law("time", "elevation")
def the_elevation_reader_warms_up(h: Hall, rng: Draw) -> Change:
    """Cold amplifiers of the six reading marks are unequal, so the elevation waves; as they warm up the wave dies."""
    wave = np.sin(6.0 * h.elevation)
    return reads(h, "elevation", 5.0 * wave * np.exp(-h.time / rng.uniform(1500.0, 4500.0)))


@law("time|press_load_kn")
def the_azimuth_counter_misses_at_each_stroke(h: Hall, rng: Draw) -> Change:
    """The spark of the press's switch costs the azimuth counter a pulse each time; a set-up begins with a new count."""
    struck = np.maximum(h.change(h.latched(h.load, 0.3, 0.7)), 0.0)
    counted = np.cumsum(struck)
    return reads(h, "azimuth", 3.0 * (counted - counted[h.starts]))
