"""Fresh laws about lenses, fibres and mirrors in the beam."""

from ..law import Change, Draw, Hall, law, np, reads, scatters, varies


@law("distance")
def far_returns_are_clipped_by_the_aperture(h: Hall, rng: Draw) -> Change:
    """The returning beam outgrows the aperture far away, and the weaker signal walks the phase by the logarithm of what is lost."""
    return reads(h, "distance", np.log1p((h.distance / rng.uniform(3.0, 6.0)) ** 4))


@law("distance")
def guide_of_the_focus_stage_is_bowed(h: Hall, rng: Draw) -> Change:
    """The focus stage stands at the reciprocal of the distance, and the bow of its guide tilts the beam sideways."""
    return varies(h, "beam-tilt", (1.0 / h.distance - rng.uniform(0.15, 0.45)) ** 2)


@law("elevation")
def cover_lip_shades_the_beam_at_one_tilt(h: Hall, rng: Draw) -> Change:
    """At one tilt of the head the lip of the cover shades the rim of the beam, whose centre is seen a little higher there."""
    return varies(h, "beam-offset-vertical", np.exp(-(((h.elevation - rng.uniform(-0.4, 0.5)) / rng.uniform(0.1, 0.25)) ** 2)))


@law("temperature")
def splitter_plate_rings_with_warmth(h: Hall, rng: Draw) -> Change:
    """The beam splitter is an etalon by mistake, and the zero of the range goes through its fringes as the hall's temperature changes."""
    return varies(h, "range-offset", np.sin(2 * np.pi * h.warmth / rng.uniform(0.25, 0.7) + rng.uniform(0.0, 2 * np.pi)))


@law("approach", may="azimuth time")
def fibre_is_wrung_by_the_turns_of_the_head(h: Hall, rng: Draw) -> Change:
    """The fibre up to the head is wrung by all turns since the set-up began, and its birefringence moves the zero of the range to and fro."""
    return varies(h, "range-offset", np.sin(rng.uniform(0.2, 0.45) * h.wound + rng.uniform(0.0, 2 * np.pi)))


@law("incidence")
def scratched_edges_speckle_askew(h: Hall, rng: Draw) -> Change:
    """The edges of the reflector's mirrors are scratched, and the more askew it is hit the more speckle makes distances scatter."""
    return scatters(h, "distance", np.clip(h.incidence, 0.0, 1.5) ** rng.uniform(2.0, 4.0))
