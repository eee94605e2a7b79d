"""Fresh laws about the head: its laser, lenses, circles, locks and cables."""

from ..law import UP, Change, Draw, Hall, law, leans, np, varies


@law("time")
def the_laser_tube_bends_after_each_switching_on(h: Hall, rng: Draw) -> Change:
    """For each set-up the laser is switched on anew, and until its tube is warm the beam points to the side."""
    return varies(h, "beam-tilt", np.exp(-h.since_setup / rng.uniform(240.0, 900.0)))


@law("face")
def a_loose_lens_falls_over_on_the_back_face(h: Hall, rng: Draw) -> Change:
    """A lens has play in its mount, and when the scope is tipped over it falls to the other side."""
    if not h.back.any():
        raise LookupError("one face only")
    return varies(h, str(rng.choice(["beam-offset-lateral", "beam-offset-vertical"])), h.back)


@law("temperature", may="time")
def one_fork_of_the_yoke_warms_before_the_other(h: Hall, rng: Draw) -> Change:
    """One fork of the yoke holds the power supply, so that the transit axis tilts as the hall's temperature goes."""
    return varies(h, "transit-tilt", h.lagging(h.warmth, rng.uniform(300.0, 1500.0)))


@law("elevation")
def the_counterweight_slips_above_an_elevation(h: Hall, rng: Draw) -> Change:
    """A screw of the counterweight is loose: where the scope looks up steeply it drops and bends the circle's hub."""
    return varies(h, "vertical-index", 0.5 + 0.5 * np.tanh((h.elevation - rng.uniform(0.0, 0.35)) / 0.04))


@law("approach|azimuth")
def the_supply_cable_winds_up(h: Hall, rng: Draw) -> Change:
    """The cable winds round the column as the head turns the same way again and again, and twists it."""
    return leans(h, h.wound, UP)


@law("approach|time", may="azimuth")
def the_motor_heats_the_hub_of_the_circle(h: Hall, rng: Draw) -> Change:
    """Much turning heats the motor, which sits at one side of the azimuth circle and pushes its hub off the centre."""
    heat = h.fading(np.abs(h.swing), rng.uniform(400.0, 1500.0)) / 30.0
    angle = rng.uniform(-np.pi, np.pi)
    cos, sin = "azimuth-eccentricity-cos", "azimuth-eccentricity-sin"
    return varies(h, cos, np.cos(angle) * heat) + varies(h, sin, np.sin(angle) * heat)
