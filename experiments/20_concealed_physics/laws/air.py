"""Used laws about the air between tracker and target."""

from ..law import Change, Draw, Hall, law, np, reads


@law("time", "height|elevation|place", may="distance")
def argon_pools_on_the_floor(h: Hall, rng: Draw) -> Change:
    """Shielding gas of a welder gathers on the floor while he works; it is thinner for light than air."""
    low, high = h.aim[:, 2], h.stand[:, 2]
    inside = h.distance * np.maximum(0.0, rng.uniform(0.5, 0.9) - low) / (high - low)
    return reads(h, "distance", -inside * h.lagging(h.windows(rng), rng.uniform(200.0, 600.0)))


@law("time", "distance")
def still_air_lies_in_sheets_until_a_gate_stirs_it(h: Hall, rng: Draw) -> Change:
    """Level beams bend the more the longer the gate was shut; whenever it opens, the air is mixed at once."""
    opened = np.sort(np.append(rng.uniform(-2000.0, h.time[-1], int(rng.integers(4, 9))), -3000.0))
    since = h.time - opened[np.searchsorted(opened, h.time, side="right") - 1]
    return reads(h, "elevation", h.distance * np.cos(h.elevation) * (1.0 - np.exp(-since / rng.uniform(600.0, 1800.0))))
