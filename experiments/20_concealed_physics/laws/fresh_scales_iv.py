"""Fresh laws about scales, certificates and the axes that carry the circles."""

from ..law import Change, Draw, Hall, gauge, law, moves, np, reads, varies


@law()
def two_sheets_corrected_with_opposite_signs(h: Hall, rng: Draw) -> Change:
    """Two lengths were brought to the reference temperature with opposite signs, and the difference was halved."""
    return gauge(h, h.lengths * [1.0, -1.0])


@law()
def upright_length_certified_lying(h: Hall, rng: Draw) -> Change:
    """The lengths were certified lying; its weight shortens the upright one, and the lying one bends a little less."""
    return gauge(h, [rng.uniform(-0.3, 0.1), 1.0])


@law("incidence")
def three_lobed_ball_has_one_diameter(h: Hall, rng: Draw) -> Change:
    """The ball is three-lobed, which no certified diameter tells, and stands high or low by how it is turned."""
    return moves(h, np.cos(3.0 * h.incidence + rng.uniform(-np.pi, np.pi)), h.normal)


@law("approach", may="azimuth time")
def circle_slips_on_its_hub_at_fast_swings(h: Hall, rng: Draw) -> Change:
    """The azimuth circle is loose on its hub and slips a little further at every long swing, against its sense."""
    return reads(h, "azimuth", np.cumsum(np.sign(h.swing) * (np.abs(h.swing) > rng.uniform(1.5, 2.5))))


@law("temperature", may="time")
def thick_cheek_of_the_yoke_warms_late(h: Hall, rng: Draw) -> Change:
    """The thick cheek of the yoke warms later than the thin one, which meanwhile pushes the transit axis off."""
    thick, thin = (h.lagging(h.warmth, delay) for delay in (rng.uniform(1500.0, 4000.0), rng.uniform(60.0, 400.0)))
    return varies(h, "transit-offset", thin - thick)


@law("elevation")
def counterweight_touches_its_stop(h: Hall, rng: Draw) -> Change:
    """Above some tilt the counterweight leans on an askew stop, and twists the beam sideways in proportion."""
    return varies(h, "beam-tilt", np.clip(h.elevation - rng.uniform(-0.1, 0.3), 0.0, None))
