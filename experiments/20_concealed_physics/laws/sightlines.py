"""Laws about the air along lines of sight."""

from ..law import Change, Draw, Hall, law, np, reads, varies
from ..tracker import Array

LESS = 0.95
"""[ppm/K] That the refractive index of air loses with its warmth."""


def beyond(start: Array, end: Array, mark: float) -> Array:
    """Share of each line of sight that lies beyond a mark."""
    low, high = np.minimum(start, end), np.maximum(start, end)
    return np.clip((high - mark) / np.maximum(high - low, 1e-6), 0.0, 1.0)


@law("time", "place|distance")
def the_gate_lets_cold_air_in(h: Hall, rng: Draw) -> Change:
    """While the gate stands open the far part of the hall fills with cold air, and ranges through it get too long."""
    share = beyond(h.stand[:, 0], h.aim[:, 0], rng.uniform(0.5, 0.7) * h.size.room[0])
    return reads(h, "distance", LESS * h.windows(rng) * share * h.distance)


@law("time", "height", may="elevation distance place")
def warm_air_gathers_under_the_roof(h: Hall, rng: Draw) -> Change:
    """Waste heat gathers under the roof through the shift; lines into that layer are refracted at its lower side."""
    bottom = rng.uniform(2.6, 3.2)
    share = np.where(h.aim[:, 2] > bottom, beyond(h.stand[:, 2], h.aim[:, 2], bottom), 0.0)
    warm = LESS * share * h.time / h.time[-1]
    bent = warm / np.tan(np.where(share > 0.0, h.elevation, 0.5 * np.pi))
    return reads(h, "distance", -warm * h.distance) + reads(h, "elevation", bent)


@law("azimuth|place", may="distance")
def lines_past_an_oven_are_bent(h: Hall, rng: Draw) -> Change:
    """Hot air stands above an oven amid the hall; lines that pass beside it are bent away from it, on either side."""
    length, width, _ = h.size.room
    oven = rng.uniform([0.35 * length, 0.3 * width], [0.65 * length, 0.7 * width])
    way, out = (h.aim - h.stand)[:, :2], oven - h.stand[:, :2]
    along = (way * out).sum(axis=1) / (way**2).sum(axis=1)
    miss = (way[:, 0] * out[:, 1] - way[:, 1] * out[:, 0]) / np.sqrt((way**2).sum(axis=1)) / rng.uniform(0.5, 0.9)
    passes = (along > 0.0) & (along < 1.0)
    return reads(h, "azimuth", 5.0 * passes * (1.0 - along) * miss * np.exp(-(miss**2)))


@law("time", "elevation")
def the_tracker_looks_through_its_own_exhaust(h: Hall, rng: Draw) -> Change:
    """Warm air from the tracker's slots rises along the head once it has run for a while, and bends the steep lines."""
    warm = 1.0 - np.exp(-h.since_setup / rng.uniform(200.0, 700.0))
    return reads(h, "elevation", 5.0 * warm * np.maximum(np.sin(h.elevation), 0.0) ** 1.5)


@law("temperature", "height", may="distance elevation place")
def a_cool_floor_bends_low_lines(h: Hall, rng: Draw) -> Change:
    """The floor stays as it is when the hall warms, so low lines go through a gradient in the air above it."""
    low = np.exp(-h.aim[:, 2] / rng.uniform(0.3, 0.8))
    return reads(h, "elevation", h.warmth * low * h.distance)


@law("time", may="distance")
def shut_doors_let_the_fans_raise_the_pressure(h: Hall, rng: Draw) -> Change:
    """When the doors are shut the fans put the hall under pressure, which a barometer read once has not."""
    return varies(h, "range-scale", -h.windows(rng))
