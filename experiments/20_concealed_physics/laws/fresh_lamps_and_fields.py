"""Fresh laws about stray light, shiny things, electric fields and weak returns."""

from ..law import Change, Draw, Hall, law, np, reads, scatters, varies


@law("place", may="azimuth elevation")
def an_arc_lamp_pulls_the_tracking_spot(h: Hall, rng: Draw) -> Change:
    """The light of a bright lamp in the hall falls on the position detector and pulls both angles towards the lamp."""
    length, width, height = h.size.room
    lamp = np.array([rng.uniform(0.2, 0.8) * length, rng.uniform(0.2, 0.8) * width, rng.uniform(0.3, 0.8) * height])
    to, way = lamp - h.stand, h.aim - h.stand
    aside = np.arctan2(to[:, 1], to[:, 0]) - np.arctan2(way[:, 1], way[:, 0])
    aside = np.angle(np.exp(1j * aside))
    above = np.arctan2(to[:, 2], np.hypot(to[:, 0], to[:, 1])) - np.arctan2(way[:, 2], np.hypot(way[:, 0], way[:, 1]))
    width_ = rng.uniform(0.3, 0.5)
    near = np.exp(-(np.hypot(aside * np.cos(h.elevation), above) ** 2) / width_**2) / width_
    return reads(h, "azimuth", near * aside) + reads(h, "elevation", near * above)


@law("time", "azimuth|place", may="azimuth place")
def low_sun_goes_round_the_windows(h: Hall, rng: Draw) -> Change:
    """The sun is low and moves on by fifteen degrees an hour; pointings near its bearing read too high by its glare."""
    way = h.aim - h.stand
    sun = rng.uniform(-np.pi, np.pi) - np.radians(15.0) * h.time / 3600.0
    away = np.angle(np.exp(1j * (np.arctan2(way[:, 1], way[:, 0]) - sun)))
    return reads(h, "elevation", np.exp(-((away / rng.uniform(0.3, 0.6)) ** 2)))


@law("place", may="distance azimuth incidence")
def a_polished_sheet_echoes_near_it(h: Hall, rng: Draw) -> Change:
    """A polished sheet stands in the hall: ranges to reflectors near its front come out long by an echo over it."""
    length, width, _ = h.size.room
    spot = np.array([rng.uniform(0.3, 0.8) * length, rng.uniform(0.3, 0.8) * width, rng.uniform(0.2, 1.5)])
    bearing = rng.uniform(-np.pi, np.pi)
    front = (h.stand - spot) @ np.array([np.cos(bearing), np.sin(bearing), 0.0]) > 0.0
    gap = np.sqrt(((h.aim - spot) ** 2).sum(axis=1))
    return reads(h, "distance", front * np.exp(-gap / rng.uniform(1.0, 2.0)))


@law("place")
def a_transformer_sets_the_range_zero_off(h: Hall, rng: Draw) -> Change:
    """The field of a welding transformer couples into the range electronics, more the nearer a tracker stands."""
    length, width, _ = h.size.room
    spot = np.array([rng.uniform(0.2, 0.8) * length, rng.uniform(0.2, 0.8) * width, 1.0])
    gap = np.sqrt(((h.stand - spot) ** 2).sum(axis=1))
    return varies(h, "range-offset", (1.0 + gap) ** -rng.uniform(1.5, 2.5) * 10.0)


@law("incidence")
def ranges_scatter_at_oblique_reflectors(h: Hall, rng: Draw) -> Change:
    """A reflector that is hit obliquely sends little light back, and the range meter's readings scatter more."""
    return scatters(h, "distance", np.tan(0.9 * h.incidence) ** rng.uniform(1.5, 2.5))


@law("press_load_kn")
def the_press_shakes_beyond_a_load(h: Hall, rng: Draw) -> Change:
    """Beyond some load the press works in blows, and the angles of all trackers tremble."""
    return scatters(h, "azimuth elevation", np.clip(h.load - rng.uniform(0.4, 0.7), 0.0, None))
