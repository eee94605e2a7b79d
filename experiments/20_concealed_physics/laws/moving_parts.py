"""Laws about axes, bearings, circles and cables of the tracker."""

from ..law import UP, Change, Draw, Hall, law, np, reads, shifts, varies


@law("approach", may="azimuth time")
def cable_pulls_once_its_slack_is_wound_up(h: Hall, rng: Draw) -> Change:
    """The cable of the head has slack for some turning to either side; wound further it pulls the transit axis over."""
    slack = rng.uniform(1.0, 2.0)
    return varies(h, "transit-tilt", np.sign(h.wound) * np.maximum(0.0, np.abs(h.wound) - slack))


@law("approach", may="time elevation")
def grease_lifts_the_head_after_a_large_tip(h: Hall, rng: Draw) -> Change:
    """A large tip of the scope drags grease below the journals; the head rides higher until it is squeezed out."""
    return shifts(h, h.fading(np.abs(h.change(h.elevation)), rng.uniform(30.0, 90.0)), UP)


@law("temperature")
def standing_bearing_loses_its_preload_in_the_warm(h: Hall, rng: Draw) -> Change:
    """Above a certain temperature the housing has grown off the bearing, and the head nods under its own overhang."""
    return varies(h, "vertical-index", np.maximum(0.0, h.warmth - np.quantile(h.warmth, rng.uniform(0.3, 0.6))))


@law("elevation", may="approach")
def counterweight_falls_over_its_dead_centre(h: Hall, rng: Draw) -> Change:
    """A loose counterweight tips over when the scope rises past one elevation, and back when it sinks below another."""
    over = h.latched(h.elevation, rng.uniform(-0.25, -0.05), rng.uniform(0.05, 0.25))
    return varies(h, "beam-offset-vertical", over)


@law("azimuth", may="face")
def dent_in_the_ball_race_of_one_head(h: Hall, rng: Draw) -> Change:
    """One tracker was dropped in its case: its balls left a dent in the race, and over it the head nods."""
    from_dent = np.angle(np.exp(1j * (h.circle - rng.uniform(-np.pi, np.pi))))
    return varies(h, "vertical-index", h.one_tracker(rng) * np.exp(-0.5 * (from_dent / rng.uniform(0.2, 0.4)) ** 2))


@law("azimuth", may="face")
def scale_band_is_too_short_for_its_drum(h: Hall, rng: Draw) -> Change:
    """The scale band round the drum is a trace too short: the azimuth runs ahead for a turn and jumps at the joint."""
    turn = np.mod(h.circle - rng.uniform(-np.pi, np.pi), 2 * np.pi)
    return reads(h, "azimuth", turn / (2 * np.pi))


@law("face", "elevation")
def cable_loom_presses_on_the_tube_when_it_is_plunged(h: Hall, rng: Draw) -> Change:
    """On the back face the loom lies against the tube, and bends it sideways the more the steeper it looks up."""
    return varies(h, "beam-tilt", h.back * np.maximum(0.0, h.elevation - rng.uniform(-0.3, 0.0)))


@law("temperature", "elevation")
def plastic_tube_softens_with_warmth(h: Hall, rng: Draw) -> Change:
    """The tube is of plastic, and hangs through more the warmer it is, most when it lies level."""
    return reads(h, "elevation", h.warmth * np.cos(h.elevation) ** 2)
