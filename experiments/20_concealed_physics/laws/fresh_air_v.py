"""Fresh laws about the air that beams go through."""

from collections.abc import Callable

from ..law import Change, Draw, Hall, law, np, reads, scatters, varies

PARTS = (np.arange(20) + 0.5) / 20


def along(h: Hall, field: Callable[[np.ndarray], np.ndarray], weights: np.ndarray) -> np.ndarray:
    """(n,) Weighted mean along each beam, from tracker to nest, of a field of points (n, 20, 3) [m]."""
    points = h.stand[:, None] + PARTS[:, None] * (h.aim - h.stand)[:, None]
    return np.asarray(field(points) @ (weights / weights.sum()))


def room_azimuth(h: Hall) -> np.ndarray:
    """(n,) [rad] Direction of the beam in the room."""
    return np.arctan2(h.aim[:, 1] - h.stand[:, 1], h.aim[:, 0] - h.stand[:, 0])


@law("time", "height", may="distance elevation place")
def gas_of_dry_ice_pools_on_the_floor(h: Hall, rng: Draw) -> Change:
    """Moulds are cleaned with dry ice; its heavy gas, of higher refractive index, lies on the floor for a while."""
    memory, depth = rng.uniform(900.0, 2700.0), rng.uniform(0.3, 0.8)
    since = h.time[:, None] - h.time[-1] * rng.uniform(0.0, 0.9, int(rng.integers(2, 5)))
    gas = (np.exp(-np.maximum(since, 0.0) / memory) * (since > 0)).sum(axis=1)
    low = along(h, lambda p: np.exp(-np.maximum(p[..., 2], 0.0) / depth), np.ones(20))
    return reads(h, "distance", gas * low * h.distance)


@law("place", may="azimuth distance elevation height")
def a_curtain_parts_warm_air_from_cold(h: Hall, rng: Draw) -> Change:
    """A strip curtain divides the hall; beams through it are bent as at a pane of water, and run on in another air."""
    curtain, jump = rng.uniform(0.3, 0.7) * h.size.room[0], rng.choice([-1.0, 1.0])
    run = h.aim - h.stand
    crossing = (h.stand[:, 0] - curtain) * (h.aim[:, 0] - curtain) < 0.0
    beyond = np.where(crossing, np.abs(h.aim[:, 0] - curtain) / np.maximum(np.abs(run[:, 0]), 1e-3), 0.0)
    jumps = jump * np.sign(run[:, 0]) * beyond
    beam = run / h.distance[:, None]
    slope = np.column_stack([np.zeros(h.n), beam[:, 1:] / np.maximum(np.abs(beam[:, :1]), 0.25)])
    level = np.hypot(beam[:, 0], beam[:, 1])
    left = (beam[:, 0] * slope[:, 1] - beam[:, 1] * slope[:, 0]) / level
    upwards = level * slope[:, 2] - beam[:, 2] * (beam[:, :2] * slope[:, :2]).sum(axis=1) / level
    bent = reads(h, "azimuth", jumps * left / level) + reads(h, "elevation", jumps * upwards)
    return bent + reads(h, "distance", jumps * h.distance)


@law("place", may="azimuth distance")
def the_air_beside_an_oven_boils(h: Hall, rng: Draw) -> Change:
    """Air that rises beside an oven trembles; directions are unsteady where the beam passes close to it."""
    oven = rng.uniform([0.2, 0.2], [0.8, 0.8]) * h.size.room[:2]
    wide = rng.uniform(0.4, 1.0)
    boiling = along(h, lambda p: np.exp(-0.5 * ((p[..., :2] - oven) ** 2).sum(axis=2) / wide**2), 1.0 - PARTS)
    return scatters(h, "azimuth elevation", boiling)


@law("time", "distance|place", may="azimuth height")
def the_warm_layer_swings_like_water_in_a_tub(h: Hall, rng: Draw) -> Change:
    """Layers of warm and cool air swing from end to end of the hall; beams bend upwards here, downwards there."""
    swinging = np.sin(2 * np.pi * (h.time / rng.uniform(500.0, 1500.0) + rng.random()))
    end = along(h, lambda p: np.cos(np.pi * p[..., 0] / h.size.room[0]), 1.0 - PARTS)
    return reads(h, "elevation", swinging * end * h.distance / 5.0)


@law("time")
def a_patch_of_sun_passes_over_the_weather_probe(h: Hall, rng: Draw) -> Change:
    """A patch of sunlight wanders over the probe; its false temperature enters the range until the probe has cooled."""
    begin, stay = h.time[-1] * rng.uniform(0.1, 0.7), rng.uniform(600.0, 2000.0)
    sunny = ((h.time > begin) & (h.time < begin + stay)).astype(float)
    return varies(h, "range-scale", h.lagging(sunny, rng.uniform(150.0, 700.0)))


@law("time", "place", may="azimuth distance")
def clouds_come_and_go_before_the_hot_glass_front(h: Hall, rng: Draw) -> Change:
    """While the sun is out the glass front warms the air before it, and beams that run along the front bend away."""
    sun = h.lagging(h.windows(rng), rng.uniform(120.0, 500.0))
    depth = rng.uniform(0.6, 1.8)
    near = along(h, lambda p: np.exp(-p[..., 0] / depth), 1.0 - PARTS)
    return reads(h, "azimuth", sun * near * h.distance * np.sin(room_azimuth(h)))
