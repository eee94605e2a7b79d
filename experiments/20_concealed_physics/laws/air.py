"""Laws about the air that beams go through."""

from ..law import Change, Draw, Hall, law, np, reads, scatters
from ..tracker import Array

STEPS = (np.arange(24) + 0.5) / 24
"""(24,) Share of the way from the tracker to the target, at which the air is asked."""


def _ways(h: Hall) -> Array:
    """(n, 24, 3) [m] Points in the room along each beam."""
    return np.asarray(h.stand[:, None] + (h.aim - h.stand)[:, None] * STEPS[:, None])


@law("place|height", may="elevation distance azimuth")
def beams_bend_over_a_hot_pipe(h: Hall, rng: Draw) -> Change:
    """A hot pipe runs the length of the hall, and beams that cross over it closely are bent upwards behind it."""
    y, z = rng.uniform([0.3, 0.1], [0.7, 0.2]) * h.size.room[1:]
    share = (y - h.stand[:, 1]) / (h.aim - h.stand)[:, 1]
    above = h.stand[:, 2] + share * (h.aim - h.stand)[:, 2] - z
    over = (share > 0.0) & (share < 1.0) & (above > 0.0)
    bend = np.exp(-np.where(over, above, 0.0) / rng.uniform(0.3, 0.8))
    return reads(h, "elevation", -np.where(over, bend * (1.0 - share), 0.0))


@law("time", "height|elevation|place", may="distance")
def cold_air_flows_in_along_the_floor(h: Hall, rng: Draw) -> Change:
    """While a gate is open cold air lies on the floor, in which beams are slower and steeper than above it."""
    down = h.stand[:, 2] - h.aim[:, 2]
    deep = np.clip(rng.uniform(0.4, 1.0) - h.aim[:, 2], 0.0, None)
    share, level_m = np.where(deep > 0.0, deep / down, 0.0), np.cos(h.elevation) * h.distance
    cold = h.windows(rng) * share
    return reads(h, "distance", cold * h.distance) + reads(h, "elevation", cold * level_m / down)


@law("height|elevation|place", may="distance")
def a_duct_blows_under_the_ceiling(h: Hall, rng: Draw) -> Change:
    """A duct blows warm air across the hall at one height, and beams that meet it soon flicker most."""
    z, thick = rng.uniform(0.45, 0.6) * h.size.room[2], rng.uniform(0.5, 1.0)
    blown = 0.03 + (np.abs(_ways(h)[:, :, 2] - z) < thick / 2)  # the whole air is stirred a little
    return scatters(h, "azimuth elevation", h.distance * (blown * (1.0 - STEPS)).mean(axis=1))


@law("azimuth", "time")
def the_tracker_looks_through_its_own_warm_air(h: Hall, rng: Draw) -> Change:
    """The fan in the base blows out at one side; when the tracker is warm, beams over that side are bent upwards."""
    mine = h.pointings.tracker == rng.integers(len(h.trackers))
    off = np.mod(h.azimuth - rng.uniform(-np.pi, np.pi) + np.pi, 2 * np.pi) - np.pi
    warm = 1.0 - np.exp(-h.since_setup / rng.uniform(200.0, 600.0))
    return reads(h, "elevation", mine * -warm * np.exp(-((off / rng.uniform(0.3, 0.6)) ** 2)))


@law("place", may="distance azimuth")
def solvent_vapour_lingers_at_one_end(h: Hall, rng: Draw) -> Change:
    """From a paint booth at one end of the hall comes vapour, thinner with every metre, in which light is slower."""
    away = np.abs(_ways(h)[:, :, 0] - rng.choice([0.0, 1.0]) * h.size.room[0])
    return reads(h, "distance", h.distance * np.exp(-away / rng.uniform(1.0, 2.5)).mean(axis=1))


@law("temperature", "place", may="azimuth elevation distance height time")
def a_thermostat_heater_bends_passing_beams(h: Hall, rng: Draw) -> Change:
    """A gas heater goes on in the cold and off in the warmth, and beams that pass through its plume are bent."""
    burns = 1.0 - h.latched(h.warmth, *np.quantile(h.warmth, [0.35, 0.65]))
    away = _ways(h)[:, :, :2] - rng.uniform(0.25, 0.75, 2) * h.size.room[:2]
    plume = np.exp(-(away**2).sum(axis=2) / rng.uniform(0.4, 0.9) ** 2)
    return reads(h, "elevation", -burns * h.distance * (plume * (1.0 - STEPS)).mean(axis=1))


@law("distance", may="place height elevation incidence")
def the_warm_floor_shimmers(h: Hall, rng: Draw) -> Change:
    """Over a heated floor the air shimmers, and balls near it dance up and down, the more the farther off they are."""
    return scatters(h, "elevation", h.group("floor") * (h.distance / 5.0) ** rng.uniform(1.5, 3.0))


@law("time", "place", may="distance azimuth")
def a_cold_lorry_stands_in_the_gate(h: Hall, rng: Draw) -> Change:
    """A lorry comes in from the frost at one end, and the air round it is dense for half an hour."""
    ago = h.time - np.quantile(h.time, rng.uniform(0.2, 0.6))
    cold = np.where(ago > 0.0, np.exp(-np.clip(ago, 0.0, None) / rng.uniform(900.0, 2400.0)), 0.0)
    near = _ways(h)[:, :, 0] > h.size.room[0] * rng.uniform(0.6, 0.75)
    return reads(h, "distance", cold * h.distance * near.mean(axis=1))
