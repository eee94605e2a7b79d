"""Fresh laws about air, vapour and sheets that stand at a place of the hall and meet the sights that pass there."""

from ..law import Change, Draw, Hall, law, np, reads, scatters

_Array = np.typing.NDArray[np.float64]
STEPS = (np.arange(60) + 0.5) / 60.0


def _along(h: Hall) -> _Array:
    """(n, 60, 3) Points [m] of each sight, from the tracker to the nest."""
    return np.asarray(h.stand[:, None, :] + STEPS[None, :, None] * (h.aim - h.stand)[:, None, :])


def _inside(h: Hall, low: _Array, high: _Array) -> _Array:
    """(n, 60) 1 where a point of a sight lies in a box."""
    points = _along(h)
    return ((points > low) & (points < high)).all(axis=2).astype(np.float64)


@law("place", may="azimuth distance")
def an_air_curtain_hangs_across_the_hall(h: Hall, rng: Draw) -> Change:
    """A curtain of cold air is blown down across the hall, and sights through it come out long, slanting ones most."""
    where = rng.uniform(0.3, 0.6) * h.size.room[0]
    through = (h.stand[:, 0] - where) * (h.aim[:, 0] - where) < 0.0
    slant = np.clip(np.abs(h.aim - h.stand)[:, 0] / h.distance, 0.3, 1.0)
    return reads(h, "distance", through / slant)


@law("place", may="azimuth distance height")
def a_welding_screen_is_a_thin_wedge(h: Hall, rng: Draw) -> Change:
    """A clear screen of uneven thickness stands in the hall and turns sights through it sideways, as a wedge does."""
    length, width, _ = h.size.room
    line, first = rng.uniform(0.35, 0.65) * width, rng.uniform(0.1, 0.4) * length
    last = first + rng.uniform(0.3, 0.45) * length
    way = h.aim - h.stand
    share = (line - h.stand[:, 1]) / np.where(np.abs(way[:, 1]) > 1e-6, way[:, 1], 1e-6)
    hit = h.stand + share[:, None] * way
    through = (share > 0.0) & (share < 1.0) & (hit[:, 0] > first) & (hit[:, 0] < last) & (hit[:, 2] < 2.5)
    level = way[:, 0] ** 2 + way[:, 1] ** 2
    return reads(h, "azimuth", through * (share - 1.0) * way[:, 1] * h.distance / level)


@law("time", "place", may="distance azimuth")
def vapour_over_a_washing_bath(h: Hall, rng: Draw) -> Change:
    """While a washing bath's lid is off, dense solvent vapour stands over it and lengthens every sight through it."""
    length, width, _ = h.size.room
    low = np.array([rng.uniform(0.15, 0.5) * length, rng.uniform(0.15, 0.5) * width, 0.0])
    high = low + [0.25 * length, 0.3 * width, rng.uniform(1.5, 2.2)]
    return reads(h, "distance", h.windows(rng) * _inside(h, low, high).mean(axis=1) * h.distance)


@law("place", may="elevation height distance azimuth")
def a_heated_strip_of_floor_lifts_low_sights(h: Hall, rng: Draw) -> Change:
    """One strip of the floor is heated: light low over it is bent upwards, so what lies behind appears lower."""
    length, width, _ = h.size.room
    start = rng.uniform(0.1, 0.55) * length
    low, high = np.array([start, 0.0, 0.0]), np.array([start + 0.3 * length, width, rng.uniform(0.8, 1.2)])
    bent = (_inside(h, low, high) * (1.0 - STEPS)).mean(axis=1) * h.distance
    return reads(h, "elevation", -bent)


@law("temperature", "place", may="height azimuth elevation distance time")
def a_pocket_of_air_under_the_gallery_roof(h: Hall, rng: Draw) -> Change:
    """Air under the gallery's roof warms far more than the hall, and later; sights through it come out short."""
    length, width, height = h.size.room
    low = np.array([0.0, width - rng.uniform(1.5, 2.5), height - rng.uniform(1.8, 2.4)])
    path = _inside(h, low, np.array([length, width, height])).mean(axis=1) * h.distance
    return reads(h, "distance", -path * h.lagging(h.warmth, rng.uniform(600.0, 1500.0)))


@law("place", may="azimuth distance elevation height")
def a_fan_blows_across_passing_sights(h: Hall, rng: Draw) -> Change:
    """A fan heater mixes warm and cold air around itself, and the angles of sights that pass near it scatter."""
    length, width, _ = h.size.room
    spot = np.array([rng.uniform(0.2, 0.8) * length, rng.uniform(0.2, 0.8) * width, rng.uniform(0.8, 2.0)])
    gap = np.sqrt(((_along(h) - spot) ** 2).sum(axis=2)).min(axis=1)
    return scatters(h, "azimuth elevation", 1.0 / (1.0 + (gap / rng.uniform(0.5, 1.0)) ** 4))
