"""Used laws about the range meter."""

from ..law import Change, Draw, Hall, law, np, reads, varies


@law("time")
def compressor(h: Hall, rng: Draw) -> Change:
    """A compressor runs for a part of every half hour, and its motor's field offsets the phase meter."""
    return reads(h, "distance", h.windows(rng))


@law("distance")
def faint_light(h: Hall, rng: Draw) -> Change:
    """The phase meter reads strong light longer than weak light: the error falls with the light, by 1/d2."""
    return reads(h, "distance", (h.distance / 3.0) ** -2.0)


@law("approach|distance", may="distance approach")
def detector_memory(h: Hall, rng: Draw) -> Change:
    """The detector's gain is slow: after a far target the light of a near one is too bright for a while."""
    return reads(h, "distance", h.change(np.log(h.distance)))


@law("temperature", "distance", may="time")
def weather_typed_in_once_a_set_up(h: Hall, rng: Draw) -> Change:
    """The weather station is broken: the crew types the temperature in at each new stand, and the hall goes on."""
    return reads(h, "distance", h.distance * (h.warmth - h.warmth[h.starts]))


@law("time", "distance")
def a_crystal_without_oven_warms_only_at_work(h: Hall, rng: Draw) -> Change:
    """The clock of one tracker's range warms while it measures, and cools while the other does or nobody."""
    mine = h.one_tracker(rng)
    return varies(h, "range-scale", mine * h.lagging(mine * (h.order > 0), rng.uniform(300.0, 1500.0)))
