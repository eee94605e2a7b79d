"""Laws about what lies between the tracker and its targets."""

from ..law import Change, Draw, Hall, law, np, reads, varies


@law("time", "height", "distance", may="elevation place")
def cold_air_creeps_in_below_the_gate(h: Hall, rng: Draw) -> Change:
    """While the gate is open cold air creeps over the floor and bends the beams that end in it."""
    depth = rng.uniform(0.3, 0.8)
    return reads(h, "elevation", h.windows(rng) * np.exp(-h.aim[:, 2] / depth) * h.distance)


@law("azimuth|place", may="elevation distance")
def bright_window_pulls_the_spot(h: Hall, rng: Draw) -> Change:
    """When the tracker looks towards a bright window of the hall its daylight pulls the spot on the detector."""
    way = h.aim - h.stand
    off = np.angle(np.exp(1j * (np.arctan2(way[:, 1], way[:, 0]) - rng.uniform(-np.pi, np.pi))))
    return varies(h, "beam-offset-vertical", np.exp(-0.5 * (off / rng.uniform(0.3, 0.6)) ** 2))


@law("press_load_kn", may="time")
def air_sensor_hangs_above_the_oil_pump_of_the_press(h: Hall, rng: Draw) -> Change:
    """The sensor of the air hangs above the oil pump of the press; it warms with the load, minutes late."""
    return varies(h, "range-scale", h.lagging(h.load, rng.uniform(200.0, 600.0)))


@law("azimuth", may="place")
def seam_in_the_dust_hood_of_one_tracker(h: Hall, rng: Draw) -> Change:
    """At one station the clear dust hood stays on, and its upright seam bends the beams beside it, left and right."""
    off = np.angle(np.exp(1j * (h.azimuth - rng.uniform(-np.pi, np.pi)))) / rng.uniform(0.25, 0.5)
    return reads(h, "azimuth", h.one_station(rng) * off * np.exp(-0.5 * off**2))


@law("time", "place", may="height distance")
def solvent_vapour_lies_over_the_table(h: Hall, rng: Draw) -> Change:
    """Parts on the table are wiped with solvent; its vapour slows the light to the table's targets till it is gone."""
    since = h.time - rng.uniform(0.1, 0.6) * h.time[-1]
    gone = np.exp(-np.maximum(since, 0.0) / rng.uniform(900.0, 2400.0))
    return reads(h, "distance", h.group("table") * (since > 0) * gone)
