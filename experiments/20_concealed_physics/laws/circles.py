"""Used laws about the circles, their drives and what hangs on the head."""

from ..law import Change, Draw, Hall, law, np, reads


@law("azimuth|approach", may="azimuth approach time")
def cable_wind_up(h: Hall, rng: Draw) -> Change:
    """The head winds its cable round the column: its pull grows with the turns made since the set-up."""
    return reads(h, "azimuth", np.tanh(h.wound / rng.uniform(4.0, 9.0)))


@law("azimuth")
def scratched_circle(h: Hall, rng: Draw) -> Change:
    """The circle has a scratch: along a sector the error climbs, and at its end it falls back at once."""
    width, start = rng.uniform(0.4, 1.2), rng.uniform(-np.pi, np.pi)
    along = np.mod(h.circle - start, 2 * np.pi) / width
    return reads(h, "azimuth", np.where(along < 1, along, 0.0))


@law("approach|azimuth", may="azimuth")
def long_swing_twists_the_mount(h: Hall, rng: Draw) -> Change:
    """A swing longer than some angle is made at full speed and leaves the mount twisted until the head turns over."""
    beyond = np.maximum(np.abs(h.swing) - rng.uniform(1.3, 1.9), 0.0) / rng.uniform(0.3, 0.8)
    return reads(h, "azimuth", np.sign(h.swing) * np.tanh(beyond))


@law("elevation")
def hose_at_its_stop(h: Hall, rng: Draw) -> Change:
    """A hose reaches its stop when the scope looks up, and pulls the harder the farther up it looks."""
    limit = np.quantile(h.elevation, rng.uniform(0.4, 0.7))
    return reads(h, "elevation", np.maximum(h.elevation - limit, 0.0) ** 1.5)


@law("time")
def thermostat(h: Hall, rng: Draw) -> Change:
    """The cabinet's heater goes on and off by its thermostat, and the scope bends to and fro with a lag."""
    phase = np.mod(h.time / rng.uniform(500.0, 1500.0) + rng.random(), 1.0)
    late = rng.uniform(0.1, 0.3)
    return reads(h, "elevation", np.where(phase < 0.5, 1 - np.exp(-phase / late), np.exp(-(phase - 0.5) / late)))


@law("elevation|approach", may="elevation approach time")
def counterweight_tips_over(h: Hall, rng: Draw) -> Change:
    """A loose counterweight tips over when the tube has risen, and tips back only when it has come well down."""
    return reads(h, "elevation", h.latched(h.elevation, rng.uniform(-0.25, 0.0), rng.uniform(0.2, 0.5)))


@law("elevation|height|place", "time")
def lamps_shine_into_the_camera(h: Hall, rng: Draw) -> Change:
    """The lamps under the roof, while they are lit, draw the spot aside of a camera that looks up at them."""
    steep = np.clip((h.elevation - rng.uniform(0.0, 0.3)) / rng.uniform(0.1, 0.4), 0.0, 1.0)
    return reads(h, "elevation", steep * h.windows(rng))


@law("approach", may="time azimuth")
def level_slops_after_a_swing(h: Hall, rng: Draw) -> Change:
    """The firmware corrects elevations by a liquid level, which still slops a few seconds after the head has swung."""
    return reads(h, "elevation", h.swing * np.exp(-h.gap / rng.uniform(5.0, 12.0)))
