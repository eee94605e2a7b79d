"""Used laws about light: beams, detectors, reflectors and the air between them."""

from ..law import Change, Draw, Hall, law, moves, np, reads, scatters, varies


@law("incidence")
def glass_prism_lengthens_slanting_beams(h: Hall, rng: Draw) -> Change:
    """The reflectors are glass prisms fixed in their nests; a slanting beam has a longer way through the glass."""
    return reads(h, "distance", np.sqrt(1.51**2 - np.sin(h.incidence) ** 2) - 1.51)


@law("incidence", may="place")
def cube_sits_deep_in_the_ball(h: Hall, rng: Draw) -> Change:
    """The balls stand with their opening upwards, and their cubes lie too deep, which slanting beams show the most."""
    return moves(h, -(np.sin(h.incidence) ** 2), h.normal)


@law("incidence")
def grazing_beams_are_clipped(h: Hall, rng: Draw) -> Change:
    """The more a reflector looks away from the beam the more of the spot is clipped, and its centre dances."""
    return scatters(h, "azimuth elevation", np.sin(h.incidence) ** rng.uniform(4.0, 8.0))


@law("height", may="elevation place")
def shimmer_over_the_warm_floor(h: Hall, rng: Draw) -> Change:
    """Heating pipes lie in the floor, and the air above it shimmers: elevations of low nests scatter."""
    return scatters(h, "elevation", np.exp(-h.aim[:, 2] / rng.uniform(0.4, 0.9)))


@law("distance", "incidence")
def gain_follows_the_returned_power(h: Hall, rng: Draw) -> Change:
    """The phase of the amplifier depends on the power returned, less from afar and less from a slanting reflector."""
    power = np.cos(0.8 * h.incidence) / (1.0 + h.distance**2 / 9.0)
    return reads(h, "distance", np.log(np.maximum(power, 1e-3)))


@law("distance", may="elevation")
def spot_moves_on_the_sensor_close_by(h: Hall, rng: Draw) -> Change:
    """Near reflectors throw a ghost beside the spot, which pulls its centre on the sensor; far ones do not."""
    return reads(h, "elevation", np.exp(-h.distance / rng.uniform(1.0, 2.5)))


@law("place", may="azimuth distance")
def beams_bend_around_a_furnace(h: Hall, rng: Draw) -> Change:
    """The hot air around a furnace bends beams aside that pass it, to the left on one side and right on the other."""
    furnace = rng.uniform(0.3, 0.7, 2) * np.array(h.size.room[:2]) - h.stand[:, :2]
    beam = (h.aim - h.stand)[:, :2] / h.distance[:, None]
    aside, along = furnace[:, 0] * beam[:, 1] - furnace[:, 1] * beam[:, 0], (furnace * beam).sum(axis=1)
    return reads(h, "azimuth", (along > 0) * (along < h.distance) * aside / (aside**2 + 0.3))


@law("elevation", may="distance")
def polarisation_turns_with_the_mirror(h: Hall, rng: Draw) -> Change:
    """The mirror of the tube turns the polarisation with the elevation, and the phase meter takes that for length."""
    return reads(h, "distance", np.sin(4.0 * h.elevation + rng.uniform(-np.pi, np.pi)))


@law("face")
def window_is_a_wedge_on_the_back_face(h: Hall, rng: Draw) -> Change:
    """When the tube is turned over the beam leaves by a thicker part of the window, a little longer on its way."""
    return varies(h, "range-offset", h.back)


@law("time", "azimuth|place", may="elevation")
def low_sun_blinds_the_sensor(h: Hall, rng: Draw) -> Change:
    """The sun stands low, wanders round, and pulls the spot on the sensor up where a beam looks towards it."""
    way, sun = (h.aim - h.stand)[:, :2], rng.uniform(-np.pi, np.pi) + h.time / rng.uniform(7000.0, 15000.0)
    return reads(h, "elevation", np.exp(2.0 * np.cos(np.arctan2(way[:, 1], way[:, 0]) - sun) - 2.0))


@law("time", may="place")
def coolant_mist_drifts_through(h: Hall, rng: Draw) -> Change:
    """While a milling machine cuts, mist hangs in the air and ranges scatter."""
    return scatters(h, "distance", h.windows(rng))


@law("place", may="distance")
def strip_curtain_divides_the_hall(h: Hall, rng: Draw) -> Change:
    """A curtain of clear plastic divides the hall; a beam through it is longer by what the plastic delays it."""
    at = rng.uniform(0.35, 0.65) * h.size.room[0]
    return reads(h, "distance", ((h.stand[:, 0] - at) * (h.aim[:, 0] - at) < 0) * 1.0)
