"""Fresh laws about bearings, drives and the weight of the head."""

from ..law import UP, Change, Draw, Hall, law, leans, np, shifts, varies


def tipped(h: Hall) -> np.ndarray:
    """(n,) [rad] Angle through which the head is tipped; beyond the zenith on the back face."""
    return np.where(h.back > 0, np.pi - h.elevation, h.elevation)


def level_axes(angle: np.ndarray) -> np.ndarray:
    """(n, 3) Level unit vectors at angles (n,) [rad] from the x axis of the room."""
    return np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])


@law("approach", may="azimuth time")
def the_oil_film_lifts_the_head_that_has_just_turned(h: Hall, rng: Draw) -> Change:
    """Oil drawn into the standing bearing by turning carries the head higher; at rest it is squeezed out again."""
    turning = h.fading(np.abs(h.swing), rng.uniform(40.0, 180.0))
    return shifts(h, 1.0 - np.exp(-turning / rng.uniform(2.0, 6.0)), UP)


@law("approach", may="azimuth time")
def the_cable_loom_without_slack_skews_the_transit_axis(h: Hall, rng: Draw) -> Change:
    """Once the turns of the head have used up the slack of the cables inside, they pull the transit axis askew."""
    slack = rng.uniform(0.5, 1.6)
    pull = np.sign(h.wound) * np.maximum(np.abs(h.wound) - slack, 0.0)
    return varies(h, "transit-tilt", rng.choice([-1.0, 1.0]) * pull)


@law("approach", may="azimuth")
def the_transit_shaft_slides_to_one_stop_at_hard_turns(h: Hall, rng: Draw) -> Change:
    """The transit shaft has end play; a turn that is wide, hence quick, throws it against the other stop."""
    hard = rng.uniform(0.5, 1.3)
    return varies(h, "beam-offset-lateral", h.latched(h.swing, -hard, hard) - 0.5)


@law("elevation", may="face")
def the_teeth_of_the_tipping_belt_pull_at_the_transit_axis(h: Hall, rng: Draw) -> Change:
    """Each tooth of the belt that tips the head draws the transit axis forward as it runs on to the pulley."""
    teeth = int(rng.integers(12, 28))
    return varies(h, "transit-offset", np.cos(teeth * tipped(h) + rng.uniform(-np.pi, np.pi)))


@law("azimuth", may="face")
def the_softest_leg_gives_way_under_the_heavy_side(h: Hall, rng: Draw) -> Change:
    """The front of the head is the heavier one; the stand dips when it comes over the softest of the legs."""
    leg = rng.uniform(-np.pi, np.pi)
    over = np.maximum(np.cos(h.circle - leg), 0.0) ** rng.uniform(1.0, 3.0)
    return leans(h, over, level_axes(h.yaw[h.pointings.station] + leg + np.pi / 2))


@law("approach", may="azimuth time")
def the_ball_cage_rolls_on_at_less_than_half_the_pace(h: Hall, rng: Draw) -> Change:
    """One ball of the standing bearing is too large; it goes round with the cage, at less than half the pace."""
    carried = rng.uniform(0.40, 0.48) * np.cumsum(h.swing) + rng.uniform(-np.pi, np.pi)
    return leans(h, np.ones(h.n), level_axes(h.yaw[h.pointings.station] + carried))
