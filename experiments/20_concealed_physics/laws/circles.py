"""Used laws about the circles, their drives and what hangs on the head."""

from ..law import Change, Draw, Hall, law, np, reads


@law("azimuth|approach", may="azimuth approach time")
def cable_wind_up(h: Hall, rng: Draw) -> Change:
    """The head winds its cable round the column: its pull grows with the turns made since the set-up."""
    return reads(h, "azimuth", np.tanh(h.wound / rng.uniform(4.0, 9.0)))


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


@law("elevation|approach", may="elevation approach time")
def counterweight_tips_over(h: Hall, rng: Draw) -> Change:
    """A loose counterweight tips over when the tube has risen, and tips back only when it has come well down."""
    return reads(h, "elevation", h.latched(h.elevation, rng.uniform(-0.25, 0.0), rng.uniform(0.2, 0.5)))
