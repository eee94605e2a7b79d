"""Fresh laws about firmware and controllers."""

from ..law import Change, Draw, Hall, law, leans, np, reads, scatters, varies


@law("approach", may="face azimuth elevation")
def average_keeps_a_trace_of_the_last_target(h: Hall, rng: Draw) -> Change:
    """The circles' averaging filter is not emptied: a trace of the raw angles before stays in each reading."""
    raw = np.where(h.back > 0, np.pi - h.elevation, h.elevation)
    return reads(h, "azimuth", -h.swing) + reads(h, "elevation", -h.change(raw) * (1.0 - 2.0 * h.back))


@law("temperature", "time")
def air_temperature_is_polled_too_seldom(h: Hall, rng: Draw) -> Change:
    """The air's temperature is asked for at long intervals only, and an old one scales distances in between."""
    slot = np.floor((h.time + rng.uniform(0.0, 3000.0)) / rng.uniform(1500.0, 4000.0))
    return varies(h, "range-scale", h.warmth - h.warmth[np.searchsorted(slot, slot)])


@law("azimuth")
def one_controller_has_a_coarse_index_table(h: Hall, rng: Draw) -> Change:
    """One of two controllers takes the nearest entry of the table of its index by azimuth, and does not interpolate."""
    step = 2 * np.pi / rng.integers(8, 17)
    return varies(h, "vertical-index", h.random_tracker(rng) * (np.mod(h.circle / step + rng.random(), 1.0) - 0.5))


@law("time")
def level_buffer_fills_and_is_emptied(h: Hall, rng: Draw) -> Change:
    """The live level sums rounding errors, leaning the frame, until its buffer is full, and then begins anew."""
    axis = h.yaw[h.pointings.station] + rng.uniform(-np.pi, np.pi)
    length = rng.integers(18, 50)
    return leans(h, np.mod(h.order, length) / length, np.column_stack([np.cos(axis), np.sin(axis), np.zeros(h.n)]))


@law("face", may="elevation")
def back_face_forgets_the_circle_map(h: Hall, rng: Draw) -> Change:
    """After an update the second-order map of the vertical circle is no longer used on the back face."""
    if not h.back.any():
        raise LookupError("one face only")
    return varies(h, "elevation-second-order-sin", h.back)


@law("distance")
def tracking_gain_is_doubled_too_late(h: Hall, rng: Draw) -> Change:
    """The tracking loop doubles its gain at each doubling of the distance; before each step the angles scatter."""
    octave = np.log2(h.distance) + rng.random()
    return scatters(h, "azimuth elevation", np.mod(octave, 1.0) ** rng.uniform(1.0, 3.0))
