"""Fresh laws about laser, lenses, windows and glare."""

from ..law import UP, Change, Draw, Hall, law, np, reads, scatters, varies


@law("time")
def the_tube_sweeps_through_its_modes_as_it_warms(h: Hall, rng: Draw) -> Change:
    """The beam nods sideways with each mode that the lengthening laser tube passes, quickly at first, slowly later."""
    passed = rng.uniform(2.5, 7.0) * (1.0 - np.exp(-h.time / rng.uniform(2000.0, 6000.0)))
    return varies(h, "beam-tilt", np.cos(2 * np.pi * (passed + rng.random())))


@law("place|azimuth", may="incidence elevation height")
def the_roll_of_the_reflector_turns_the_polarisation(h: Hall, rng: Draw) -> Change:
    """The mirrors turn the polarisation with their roll about the beam, and the phase of the fringes with it."""
    beam = (h.aim - h.stand) / h.distance[:, None]
    right = np.cross(beam, UP)
    right /= np.linalg.norm(right, axis=1)[:, None]
    upper = np.cross(right, beam)
    roll = np.arctan2((h.normal * right).sum(axis=1), (h.normal * upper).sum(axis=1))
    return reads(h, "distance", np.cos(2 * roll + rng.uniform(-np.pi, np.pi)))


@law("elevation", "approach", may="face")
def a_loose_lens_rolls_over_in_its_cell(h: Hall, rng: Draw) -> Change:
    """A loose lens falls to the other seat of its cell when the head tips up, and back only when it tips low."""
    tip = np.where(h.back > 0, np.pi - h.elevation, h.elevation)
    low, high = rng.uniform(-0.30, -0.08), rng.uniform(0.08, 0.35)
    return varies(h, "vertical-index", rng.choice([-1.0, 1.0]) * h.latched(tip, low, high))


@law("time")
def the_cold_window_is_misted_at_one_station(h: Hall, rng: Draw) -> Change:
    """The tracker came in from the yard; the mist on its window spoils every reading until it has dried off."""
    mist = h.random_station(rng) * np.exp(-h.since_setup / rng.uniform(200.0, 700.0))
    return scatters(h, "distance azimuth elevation", mist)


@law("distance")
def the_fringes_fade_where_two_modes_fall_out_of_step(h: Hall, rng: Draw) -> Change:
    """The laser runs in two modes; their fringes cancel, and ranges are noisy, at odd halves of the tube's length."""
    tube = rng.uniform(0.35, 0.95)
    return scatters(h, "distance", np.sin(np.pi * h.distance / tube) ** 4)


@law("azimuth|place", "distance")
def the_bright_gate_draws_the_spot_to_its_side(h: Hall, rng: Draw) -> Change:
    """Daylight from the gate draws the centre of the spot towards it, the more the weaker a far reflector returns."""
    side = np.arctan2(h.aim[:, 1] - h.stand[:, 1], h.aim[:, 0] - h.stand[:, 0])
    off = side - rng.uniform(-np.pi, np.pi)
    off = np.arctan2(np.sin(off), np.cos(off)) / rng.uniform(0.3, 0.7)
    return reads(h, "azimuth", -off * np.exp(0.5 - 0.5 * off**2) * (h.distance / 5.0) ** 2)
