"""Fresh laws about the distance meter, its laser, the detector and what disturbs the signal."""

from ..law import Change, Draw, Hall, law, np, reads, varies


@law("distance")
def the_receiver_changes_its_gain_far_out(h: Hall, rng: Draw) -> Change:
    """Far out the weaker return is given to a second amplifier with another delay; in between both are blended."""
    border = rng.uniform(0.35, 0.65) * h.distance.max()
    return reads(h, "distance", np.tanh((h.distance - border) / rng.uniform(0.2, 0.6)))


@law("temperature", may="time")
def the_laser_hops_from_mode_to_mode(h: Hall, rng: Draw) -> Change:
    """The wavelength of an unlocked laser drifts with the warmth, and hops back a mode every few tenths of a kelvin."""
    hops = h.warmth / rng.uniform(0.15, 0.4) + rng.random()
    return varies(h, "range-scale", hops - np.floor(hops))


@law("press_load_kn", may="time")
def a_relay_answers_to_the_press(h: Hall, rng: Draw) -> Change:
    """The press pulls the mains down; a relay puts the meter on its other supply, and back once the load is low."""
    return varies(h, "range-offset", h.latched(h.load, rng.uniform(0.1, 0.4), rng.uniform(0.6, 0.9)))


@law("time")
def the_meter_zeroes_itself_by_the_clock(h: Hall, rng: Draw) -> Change:
    """The phase runs off steadily, and an inner reference path sets it back whenever so many minutes are over."""
    period = rng.uniform(1200.0, 2700.0)
    return varies(h, "range-offset", np.mod(h.time + rng.uniform(0.0, period), period) / period)


@law("distance", "incidence")
def a_faint_return_shifts_the_phase(h: Hall, rng: Draw) -> Change:
    """Less light comes back from far and from aslant, and the phase that the meter finds depends on the light."""
    light = (0.15 + np.maximum(np.cos(h.incidence), 0.0)) ** rng.uniform(1.0, 2.0) / (1.0 + h.distance / 4.0) ** 2
    return reads(h, "distance", -np.log(light))


@law("place|azimuth", may="place azimuth elevation height distance")
def a_lamp_on_the_long_wall_pulls_the_spot(h: Hall, rng: Draw) -> Change:
    """A bright lamp on the long wall shines into the detector, and beams that pass close are steered towards it."""
    lamp = np.array([rng.uniform(0.2, 0.8), 1.0, rng.uniform(0.6, 0.9)]) * h.size.room - h.stand
    lamp, beam = lamp / np.linalg.norm(lamp, axis=1)[:, None], (h.aim - h.stand) / h.distance[:, None]
    near = np.exp(((lamp * beam).sum(axis=1) - 1.0) / rng.uniform(0.05, 0.15))
    aside = near * np.cross(beam, lamp)[:, 2] / np.cos(h.elevation)
    return reads(h, "azimuth", aside) + reads(h, "elevation", near * (lamp - beam)[:, 2])


@law("place", may="distance azimuth")
def solvent_vapour_lies_in_one_bay(h: Hall, rng: Draw) -> Change:
    """Vapour of the paint shop fills one end of the hall, and slows light on the part of its path that lies there."""
    border = rng.uniform(0.35, 0.65) * h.size.room[0]
    inside = np.abs(np.minimum(h.aim[:, 0], border) - np.minimum(h.stand[:, 0], border))
    return reads(h, "distance", h.distance * inside / np.maximum(np.abs(h.aim[:, 0] - h.stand[:, 0]), 1e-3))
