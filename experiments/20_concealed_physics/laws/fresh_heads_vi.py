"""Fresh laws about heads: cables, lubricant, lenses, motors and fibres of a tracker."""

from ..law import UP, Change, Draw, Hall, law, leans, np, reads, varies


@law("azimuth|approach", may="time")
def a_stiff_cable_twists_the_stand(h: Hall, rng: Draw) -> Change:
    """The power cable winds round the head as it turns and twists the stand, until the cable slides on its guide."""
    return leans(h, np.tanh(h.wound / rng.uniform(3.0, 6.0)), UP)


@law("time|approach")
def cold_grease_is_worked_out_of_the_trunnion(h: Hall, rng: Draw) -> Change:
    """Thick grease holds one end of the transit axis up until the turning of the head has squeezed it out."""
    return varies(h, "transit-tilt", np.exp(-np.cumsum(np.abs(h.swing)) / rng.uniform(40.0, 90.0)))


@law("elevation", may="approach")
def a_balance_weight_topples_over(h: Hall, rng: Draw) -> Change:
    """A loose balance weight topples when the scope rises steeply, bends it, and falls back only well below."""
    return varies(h, "vertical-index", h.latched(h.elevation, rng.uniform(-0.25, -0.1), rng.uniform(0.2, 0.4)))


@law("approach", may="time face")
def a_loose_lens_is_thrown_aside(h: Hall, rng: Draw) -> Change:
    """A quick wide swing throws a loosely held lens aside, and its spring needs some pointings to press it back."""
    return varies(h, "beam-offset-lateral", h.fading(np.abs(h.swing) > 1.2, rng.uniform(20.0, 60.0)))


@law("approach|time")
def hot_motors_bend_one_head(h: Hall, rng: Draw) -> Change:
    """The motor of one tracker heats up by the turning it has done lately, and bends the scope's holder sideways."""
    mine = h.random_tracker(rng)
    return varies(h, "beam-tilt", mine * h.fading(mine * np.abs(h.swing), rng.uniform(600.0, 1500.0)))


@law("azimuth")
def a_twisted_fibre_turns_the_polarisation(h: Hall, rng: Draw) -> Change:
    """The fibre into the head twists with it and turns the light's polarisation, which the range meter feels."""
    return reads(h, "distance", np.cos(2.0 * h.circle + rng.uniform(-np.pi, np.pi)))
