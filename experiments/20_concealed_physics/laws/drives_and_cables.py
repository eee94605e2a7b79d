"""Fresh laws about drives, brakes, bearings and cables of the tracker."""

from ..law import UP, Change, Draw, Hall, law, leans, np, reads, varies


@law("approach|time", may="approach time")
def azimuth_motor_warms_the_yoke_at_every_swing(h: Hall, rng: Draw) -> Change:
    """Each swing leaves heat in the azimuth motor beside the yoke, and the transit axis tilts until that has cooled."""
    return varies(h, "transit-tilt", h.fading(np.abs(h.swing), rng.uniform(500.0, 1200.0)) / 50.0)


@law("approach", may="face time")
def long_swings_rock_the_counterweight(h: Hall, rng: Draw) -> Change:
    """A head that came a long way round still rocks when it is read, less so when the pause was longer."""
    beyond = np.maximum(np.abs(h.swing) - rng.uniform(1.0, 1.8), 0.0)
    return varies(h, "vertical-index", beyond * np.exp(-h.gap / rng.uniform(12.0, 25.0)))


@law("face", "elevation")
def plunged_head_is_pulled_aside_by_its_cable(h: Hall, rng: Draw) -> Change:
    """On the back face the cable loop lies across the yoke and pulls the head aside, more so when it looks up."""
    return reads(h, "azimuth", h.back * np.maximum(h.elevation - rng.uniform(-0.3, 0.0), 0.0))


@law("approach", may="azimuth time")
def a_taut_cable_turns_the_stand(h: Hall, rng: Draw) -> Change:
    """The power cable has slack for part of a turn; wound further it goes taut and turns the stand with the head."""
    if h.back.any():
        raise LookupError("a plunge has no shorter way round")
    slack = rng.uniform(0.25, 0.6) * np.pi
    return leans(h, np.sign(h.wound) * np.maximum(np.abs(h.wound) - slack, 0.0), UP)


@law("time")
def fresh_bearings_run_in(h: Hall, rng: Draw) -> Change:
    """After a service grease spreads in the bearings with every pointing, ever slower, and the axis finds its seat."""
    return varies(h, "transit-offset", np.log1p(np.arange(h.n) / rng.uniform(10.0, 40.0)))


@law("azimuth", may="place")
def a_hose_rubs_on_the_head_in_one_sector(h: Hall, rng: Draw) -> Change:
    """At one set-up a hose hangs against the housing and turns the tracker a little where the head looks that way."""
    sector = np.exp(rng.uniform(2.0, 5.0) * (np.cos(h.azimuth - rng.uniform(-np.pi, np.pi)) - 1.0))
    return leans(h, h.one_station(rng) * sector, UP)


@law("elevation|approach", may="elevation approach")
def the_balance_spring_snaps_over(h: Hall, rng: Draw) -> Change:
    """The spring that balances the head snaps over above one elevation, and back only below another."""
    middle = rng.uniform(-0.05, 0.15)
    return varies(h, "vertical-index", h.latched(h.elevation, middle - 0.2, middle + 0.2))
