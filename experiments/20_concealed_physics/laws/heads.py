"""Laws about circles, bearings and glass of the head."""

from ..law import Change, Draw, Hall, law, np, reads, scatters, varies


@law("azimuth", may="face")
def a_scratch_crosses_the_azimuth_scale(h: Hall, rng: Draw) -> Change:
    """Over a scratched sector of the glass disc the read head of the azimuth interpolates wrongly."""
    mine = h.pointings.tracker == rng.integers(len(h.trackers))
    off = np.mod(h.circle - rng.uniform(-np.pi, np.pi) + np.pi, 2 * np.pi) - np.pi
    return reads(h, "azimuth", mine * np.exp(-((off / rng.uniform(0.12, 0.35)) ** 2)))


@law("elevation", may="face height")
def the_tape_of_the_elevation_has_a_seam(h: Hall, rng: Draw) -> Change:
    """The ends of the tape scale meet with a gap within reach of the front face, and beyond it all readings are off."""
    mine = h.pointings.tracker == rng.integers(len(h.trackers))
    return reads(h, "elevation", mine * (1.0 - h.back) * (h.elevation > rng.uniform(-0.3, 0.4)))


@law("temperature", "approach", may="elevation time face")
def cold_grease_twists_the_elevation_shaft(h: Hall, rng: Draw) -> Change:
    """In the cold the grease of the transit drags, and the shaft stays twisted against the way it came."""
    side = 1.0 - 2.0 * h.back
    turn = h.change(np.where(h.back > 0, np.pi - h.elevation, h.elevation))
    stiff = np.clip(np.quantile(h.warmth, 0.7) - h.warmth, 0.0, None)
    return reads(h, "elevation", -side * stiff * np.tanh(turn / rng.uniform(0.1, 0.4)))


@law("time", may="azimuth face")
def one_of_two_read_heads_falls_out(h: Hall, rng: Draw) -> Change:
    """From some time on only one of two opposite read heads works, and the disc shows how far it is off its axis."""
    mine = h.pointings.tracker == rng.integers(len(h.trackers))
    alone = mine * (h.time > np.quantile(h.time[mine], rng.uniform(0.25, 0.75)))
    way = rng.uniform(-np.pi, np.pi)
    parts = {"azimuth-eccentricity-cos": np.cos(way), "azimuth-eccentricity-sin": np.sin(way)}
    first, second = (varies(h, name, share * alone) for name, share in parts.items())
    return first + second


@law("elevation", may="height")
def the_transit_axis_rattles(h: Hall, rng: Draw) -> Change:
    """A worn bearing lets the transit axis tip a little at random, which turns steep views aside and level ones not."""
    mine = h.pointings.tracker == rng.integers(len(h.trackers))
    return scatters(h, "azimuth", mine * np.tan(h.elevation) ** 2)


@law("elevation", may="approach height")
def a_loose_fold_mirror_drops_between_its_stops(h: Hall, rng: Draw) -> Change:
    """A fold mirror of the distance meter came loose and falls from stop to stop when the head looks up or down."""
    tip = rng.uniform(0.05, 0.25)
    return reads(h, "distance", rng.choice([-1.0, 1.0]) * h.latched(h.elevation, -tip, tip))


@law("distance", may="face")
def the_focusing_lens_runs_out_of_line(h: Hall, rng: Draw) -> Change:
    """The lens that focuses on near balls runs on a crooked slide and takes the beam sideways with it."""
    mine, way = h.pointings.tracker == rng.integers(len(h.trackers)), rng.uniform(-np.pi, np.pi)
    run = 3.0 * mine / h.distance
    return varies(h, "beam-offset-lateral", np.cos(way) * run) + varies(h, "beam-offset-vertical", np.sin(way) * run)


@law("azimuth", may="elevation height face")
def one_station_stands_under_a_plastic_dome(h: Hall, rng: Draw) -> Change:
    """At one station a dome keeps the dust off; the head is not in its middle, so its shell bends beams like a lens."""
    here, off = h.one_station(rng), h.azimuth - rng.uniform(-np.pi, np.pi)
    aside, above = np.sin(off) / np.cos(h.elevation), np.cos(off) * np.sin(h.elevation)
    return reads(h, "azimuth", here * aside) + reads(h, "elevation", here * above)
