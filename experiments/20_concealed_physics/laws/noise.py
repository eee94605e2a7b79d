"""Used laws about readings that scatter more than stated, here or then."""

from ..law import Change, Draw, Hall, law, np, scatters


@law("approach", may="azimuth time")
def ringing_head(h: Hall, rng: Draw) -> Change:
    """The head still rings when it reads: after a long turn the azimuth scatters more than after a short one."""
    return scatters(h, "azimuth", (h.swing / np.pi) ** 2)


@law("time", may="place")
def shaking_gallery(h: Hall, rng: Draw) -> Change:
    """A gallery shakes while people walk on it, for part of every cycle: what hangs from it is never where it was."""
    return scatters(h, "distance azimuth elevation", h.group("gallery") * h.windows(rng))


@law("elevation", may="height place")
def servo_hunts_about_a_balance(h: Hall, rng: Draw) -> Change:
    """Where the tube is nearly balanced its motor hunts: elevations scatter about one elevation as at a resonance."""
    off = (h.elevation - rng.uniform(-0.2, 0.4)) / rng.uniform(0.08, 0.2)
    return scatters(h, "elevation", 1.0 / (1.0 + off**2))
