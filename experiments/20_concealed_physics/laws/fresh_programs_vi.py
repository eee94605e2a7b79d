"""Fresh laws about programs: number formats, filters, tables and modes of firmware."""

from ..law import Change, Draw, Hall, law, np, reads, scatters, varies


@law("distance")
def short_floats_coarsen_long_ranges(h: Hall, rng: Draw) -> Change:
    """Ranges are passed on as short floating-point numbers, whose last digit doubles at each doubling of the range."""
    return scatters(h, "distance", 4.0 ** np.floor(np.log2(h.distance / rng.uniform(0.7, 1.4))))


@law("temperature", may="time distance")
def the_weather_is_averaged_too_long(h: Hall, rng: Draw) -> Change:
    """The program corrects ranges with a running mean of the air's temperature that trails behind the true one."""
    return varies(h, "range-scale", h.warmth - h.lagging(h.warmth, rng.uniform(1200.0, 3000.0)))


@law("distance")
def the_camera_zooms_in_on_far_balls(h: Hall, rng: Draw) -> Change:
    """Beyond some metres the tracking camera zooms in, and its picture's centre jumps upwards in the scope."""
    return varies(h, "vertical-index", h.distance > rng.uniform(3.5, 5.5))


@law("azimuth", may="face")
def a_filter_averages_across_the_full_turn(h: Hall, rng: Draw) -> Change:
    """Where the azimuth circle's count wraps round, a filter mixes both ends of it and pulls readings off the seam."""
    seam = np.exp(-(np.pi - np.abs(h.circle)) / rng.uniform(0.1, 0.3))
    return reads(h, "azimuth", -np.sign(h.circle) * seam)


@law("face", "elevation")
def the_back_face_lacks_its_table(h: Hall, rng: Draw) -> Change:
    """The firmware corrects azimuths for the tilted transit axis on the front face but forgets it on the back face."""
    return reads(h, "azimuth", h.back * np.tan(h.elevation))


@law("elevation")
def a_coarse_table_corrects_the_collimation(h: Hall, rng: Draw) -> Change:
    """The collimation's correction is looked up in a coarse table by elevation, without interpolating the rows."""
    rows = h.elevation / np.radians(rng.uniform(15.0, 25.0)) + rng.random()
    return varies(h, "beam-tilt", rows - np.round(rows))
