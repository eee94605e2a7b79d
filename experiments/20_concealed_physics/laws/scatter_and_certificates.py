"""Fresh laws about scatter that changes, and about certificates of the known lengths."""

from ..law import Change, Draw, Hall, gauge, law, np, scatters


@law("press_load_kn", may="time")
def the_floor_trembles_under_load(h: Hall, rng: Draw) -> Change:
    """Pumps of the press shake the floor the more the higher its load, and the angles scatter with it."""
    return scatters(h, "azimuth elevation", h.load ** rng.uniform(1.0, 2.0))


@law("incidence")
def the_beam_is_clipped_by_the_rim_of_the_nest(h: Hall, rng: Draw) -> Change:
    """From far aside the rim of the nest cuts into the beam, and the light that is left makes the distance flicker."""
    return scatters(h, "distance", h.incidence ** rng.uniform(3.0, 5.0))


@law("time")
def haste_at_the_beginning_of_a_set_up(h: Hall, rng: Draw) -> Change:
    """The crew does not wait for the head to come to rest at the first targets of a set-up, and grows calmer."""
    return scatters(h, "distance azimuth elevation", np.exp(-h.order / rng.uniform(8.0, 25.0)))


@law("face")
def the_brake_rattles_on_the_back_face(h: Hall, rng: Draw) -> Change:
    """A worn brake rattles on the back face and hangs free on the front; the elevation suffers most."""
    return scatters(h, "elevation", h.back) + scatters(h, "azimuth", rng.uniform(0.1, 0.5) * h.back)


@law()
def one_bar_was_glued_again_after_its_calibration(h: Hall, rng: Draw) -> Change:
    """An end of one of the bars fell off and was glued on again, and its certificate is of the time before."""
    return gauge(h, rng.choice([-1.0, 1.0]) * (np.arange(len(h.bars)) == rng.integers(len(h.bars))))


@law()
def the_adapters_are_not_in_the_certificate(h: Hall, rng: Draw) -> Change:
    """The laboratory measured the bars without the adapters that carry the balls, which add about the same to each."""
    return gauge(h, rng.uniform(0.8, 1.2, len(h.bars)))


@law()
def the_corrections_of_two_bars_were_exchanged(h: Hall, rng: Draw) -> Change:
    """The correction of each bar stands on the certificate of the other: one is too long, the other too short."""
    return gauge(h, rng.choice([-1.0, 1.0]) * np.array([1.0, -1.0]))
