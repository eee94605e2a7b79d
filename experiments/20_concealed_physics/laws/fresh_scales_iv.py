"""Fresh laws about scales, certificates and the axes that carry the circles."""

from ..law import Change, Draw, Hall, gauge, law, moves, np, reads, varies


@law()
def two_sheets_corrected_with_opposite_signs(h: Hall, rng: Draw) -> Change:
    """The laboratory brought one length to the reference temperature with the right sign and the other with the wrong one, and halved the difference."""
    return gauge(h, h.lengths * [1.0, -1.0])


@law()
def upright_length_certified_lying(h: Hall, rng: Draw) -> Change:
    """The lengths were certified lying on two supports; the upright one is shortened by its weight, and the lying one bends a little less."""
    return gauge(h, [rng.uniform(-0.3, 0.1), 1.0])


@law("temperature", may="time place")
def rods_breathe_behind_the_hall(h: Hall, rng: Draw) -> Change:
    """The rods of the known lengths follow the hall's temperature with a lag and grow from their middles, while one certified value is used."""
    way, ends = np.zeros((h.n, 3)), h.pointings.points[h.bars]
    for (a, b), (low, high) in zip(h.bars, ends, strict=True):
        way += np.where((h.pointings.target == b)[:, None], high - low, 0.0) - np.where((h.pointings.target == a)[:, None], high - low, 0.0)
    return moves(h, h.lagging(h.warmth, rng.uniform(600.0, 2400.0)), 0.5 * way)


@law("approach", may="azimuth time")
def circle_slips_on_its_hub_at_fast_swings(h: Hall, rng: Draw) -> Change:
    """The azimuth circle is loose on its hub and slips a little further at every long and fast swing, against the swing's sense."""
    return reads(h, "azimuth", np.cumsum(np.sign(h.swing) * (np.abs(h.swing) > rng.uniform(1.5, 2.5))))


@law("azimuth")
def dented_race_of_the_standing_axis(h: Hall, rng: Draw) -> Change:
    """The race of the standing axis has a dent from a fall, and the transit axis tips while the head stands over it."""
    return varies(h, "transit-tilt", np.exp((np.cos(h.circle - rng.uniform(-np.pi, np.pi)) - 1.0) / rng.uniform(0.05, 0.2)))


@law("elevation")
def counterweight_touches_its_stop(h: Hall, rng: Draw) -> Change:
    """Above some tilt the counterweight leans on a stop that was put on askew, and twists the beam sideways in proportion."""
    return varies(h, "beam-tilt", np.clip(h.elevation - rng.uniform(-0.1, 0.3), 0.0, None))
