"""Fresh laws about lenses, fibres and mirrors in the beam."""

from ..law import Change, Draw, Hall, law, np, reads, scatters, varies


@law("distance")
def far_returns_are_clipped_by_the_aperture(h: Hall, rng: Draw) -> Change:
    """The beam from afar outgrows the aperture, and the signal walks the phase by the logarithm of what is lost."""
    return reads(h, "distance", np.log1p((h.distance / rng.uniform(3.0, 6.0)) ** 4))


@law("distance")
def guide_of_the_focus_stage_is_bowed(h: Hall, rng: Draw) -> Change:
    """The focus stage stands at the reciprocal of the distance, and the bow of its guide tilts the beam sideways."""
    return varies(h, "beam-tilt", (1.0 / h.distance - rng.uniform(0.15, 0.45)) ** 2)


@law("approach", may="distance")
def slack_focus_spindle_drops_the_lens(h: Hall, rng: Draw) -> Change:
    """The focus spindle has slack, and the lens sits high or low as the last refocusing was nearer or farther."""
    slack = rng.uniform(0.1, 0.8)
    return varies(h, "beam-offset-vertical", h.latched(h.change(h.distance), -slack, slack))


@law("press_load_kn")
def fibre_duct_is_squeezed_under_a_plate(h: Hall, rng: Draw) -> Change:
    """The reference fibre runs under a floor plate, which the press bends down on it above some load."""
    return varies(h, "range-offset", np.clip(h.load - rng.uniform(0.2, 0.6), 0.0, None))


@law("approach", may="azimuth time")
def fibre_is_wrung_by_the_turns_of_the_head(h: Hall, rng: Draw) -> Change:
    """All turns since the set-up began wring the fibre, whose birefringence moves the zero of the range to and fro."""
    return varies(h, "range-offset", np.sin(rng.uniform(0.2, 0.45) * h.wound + rng.uniform(0.0, 2 * np.pi)))


@law("incidence")
def scratched_edges_speckle_askew(h: Hall, rng: Draw) -> Change:
    """The reflector's mirror edges are scratched; the more askew it is hit, the more speckle scatters distances."""
    return scatters(h, "distance", np.clip(h.incidence, 0.0, 1.5) ** rng.uniform(2.0, 4.0))
