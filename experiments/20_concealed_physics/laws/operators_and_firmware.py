"""Laws about the people at the keyboard and the program that they use."""

from ..law import Change, Draw, Hall, law, moves, np, reads, varies


@law("temperature", may="time distance")
def the_air_is_typed_in_now_and_then(h: Hall, rng: Draw) -> Change:
    """Nobody connected the weather station.

    The warmth of the air is typed in every so often, and is out of date until it is typed in again.
    """
    every = rng.uniform(2400.0, 6000.0)
    shift = np.floor((h.time + rng.uniform(0.0, every)) / every)
    first = np.searchsorted(shift, shift)
    return varies(h, "range-scale", h.warmth - h.warmth[first])


@law("elevation|height", "face")
def the_table_of_the_back_face_is_an_old_one(h: Hall, rng: Draw) -> Change:
    """After a repair the correction of the elevation circle was loaded for the front face only.

    The back face has last year's.
    """
    if not h.back.any():
        raise LookupError("two faces")
    wave = rng.uniform(2.6, 4.2)
    return reads(h, "elevation", h.back * np.sin(wave * h.elevation + rng.uniform(-np.pi, np.pi)))


@law("time")
def a_check_of_the_axes_is_botched_at_lunch(h: Hall, rng: Draw) -> Change:
    """Between two stands somebody runs the check of the axes on a shaky ball, and accepts it.

    From then on tilt of the beam, tilt of the transit and index are all wrong.
    """
    starts = np.unique(h.starts)
    later = (np.arange(h.n) >= starts[int(rng.integers(1, len(starts)))]).astype(np.float64)
    tilt, transit, index = rng.standard_normal(3)
    return (
        varies(h, "beam-tilt", tilt * later)
        + varies(h, "transit-tilt", transit * later)
        + varies(h, "vertical-index", index * later)
    )


@law("time")
def the_second_round_is_done_in_a_hurry(h: Hall, rng: Draw) -> Change:
    """In the second round nobody wipes the nests any more, nor twists the ball home, and it sits a little proud."""
    if h.pointings.repeat.max() < 2:
        raise LookupError("two rounds")
    return moves(h, (h.pointings.repeat == 2).astype(np.float64), h.normal)


@law("approach", may="azimuth time")
def the_level_is_applied_one_pointing_late(h: Hall, rng: Draw) -> Change:
    """The compensator measures how the stand leans along the beam.

    But the program applies what it found at the pointing before.
    """
    way = h.azimuth - rng.uniform(-np.pi, np.pi)
    return reads(h, "elevation", h.change(np.cos(way)))


@law("approach", may="time distance")
def the_counter_loses_fringes_on_long_pulls(h: Hall, rng: Draw) -> Change:
    """The ball is carried in the beam.

    On a long pull the counter loses a few fringes, one more each time, until the next set-up sets it right.
    """
    pull = np.abs(h.change(h.distance))
    lost = np.cumsum(pull > np.quantile(pull[pull > 1e-3], rng.uniform(0.7, 0.9)))
    first = lost[h.starts]
    return reads(h, "distance", -(lost - first).astype(np.float64))
