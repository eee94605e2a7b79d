"""Fresh laws about drives, bearings and cables inside the head."""

from ..law import Change, Draw, Hall, law, np, reads, varies


@law("time|approach", may="time approach")
def a_hub_of_the_circle_slips_at_hard_slews(h: Hall, rng: Draw) -> Change:
    """At every slew above some length the glued hub of one tracker's azimuth circle slips sideways a bit."""
    own = (h.pointings.tracker == 0).astype(np.float64)
    slips = own * np.cumsum(own * (np.abs(h.swing) > rng.uniform(1.2, 2.2)))
    phase = rng.uniform(-np.pi, np.pi)
    amount = slips / 50.0
    cos = varies(h, "azimuth-eccentricity-cos", amount * np.cos(phase))
    return cos + varies(h, "azimuth-eccentricity-sin", amount * np.sin(phase))


@law("temperature", may="time")
def uneven_yokes_follow_the_hall_slowly(h: Hall, rng: Draw) -> Change:
    """One yoke of the fork is thicker and follows the hall's warmth later, so the transit axis tilts with it."""
    return varies(h, "transit-tilt", h.lagging(h.warmth, rng.uniform(900.0, 2400.0)))


@law("face", may="elevation")
def a_loose_mirror_cell_hangs_on_its_other_stop(h: Hall, rng: Draw) -> Change:
    """On the back face a mirror cell with play falls against its other stop and sets the beam off in height."""
    hanging = h.back * np.cos(h.elevation) ** rng.uniform(0.5, 1.5)
    return varies(h, "beam-offset-vertical", hanging)


@law("approach", may="time azimuth")
def a_wound_up_power_loop_pulls_the_head(h: Hall, rng: Draw) -> Change:
    """The power loop is slack for the first turns; wound further it pulls at the housing, and the index gives way."""
    slack = rng.uniform(2.0, 3.5)
    pull = np.sign(h.wound) * np.clip(np.abs(h.wound) - slack, 0.0, 6.0)
    return varies(h, "vertical-index", pull / 3.0)


@law("approach", may="time elevation")
def the_heat_of_tipping_stretches_the_circle(h: Hall, rng: Draw) -> Change:
    """The elevation motor warms as the head tips, and its heat stretches the elevation circle until it has gone."""
    heat = h.fading(np.abs(h.change(h.elevation)), rng.uniform(200.0, 600.0))
    return varies(h, "elevation-second-order-sin", heat / 5.0)


@law("approach", may="elevation")
def short_tips_end_inside_the_dead_band(h: Hall, rng: Draw) -> Change:
    """A short move of the elevation drive ends before friction is overcome, a long one runs through to its end."""
    move = h.change(h.elevation)
    band = rng.uniform(0.25, 0.5)
    return reads(h, "elevation", np.sign(move) * (np.abs(move) < band))
