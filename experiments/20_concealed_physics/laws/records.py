"""Fresh laws about known lengths, operators and noise of special kinds."""

from ..law import Change, Draw, Hall, gauge, law, moves, np, reads, scatters, varies


@law()
def the_bars_were_certified_in_another_room(h: Hall, rng: Draw) -> Change:
    """The known lengths were certified at another temperature, and nobody has reduced them."""
    return gauge(h, h.lengths)


@law()
def one_bar_was_dropped(h: Hall, rng: Draw) -> Change:
    """One of the bars fell down after its certificate was written."""
    return gauge(h, np.eye(len(h.lengths))[rng.integers(len(h.lengths))])


@law()
def the_certificates_forget_the_nests(h: Hall, rng: Draw) -> Change:
    """The bars were certified with other nests, and each is longer by the same."""
    return gauge(h, np.ones(len(h.lengths)))


@law("temperature", may="time")
def a_plastic_bar_grows_in_the_hall(h: Hall, rng: Draw) -> Change:
    """One bar is of plastic and grows with the hall while its certificate stays."""
    a, b = h.bars[rng.integers(len(h.bars))]
    points = h.pointings.points
    way = (points[b] - points[a]) / np.sqrt(((points[b] - points[a]) ** 2).sum())
    return moves(h, (h.pointings.target == b) * h.warmth, way)


@law("time")
def an_operator_who_does_not_wait(h: Hall, rng: Draw) -> Change:
    """Two operators take turns, and one of them holds the ball with his hand while it is measured."""
    return scatters(h, "distance azimuth elevation", np.where(h.windows(rng), 1.0, 0.02))


@law("time")
def the_operator_gets_tired(h: Hall, rng: Draw) -> Change:
    """Towards the end of each set-up the operator takes less care to let the tracker come to rest."""
    return scatters(h, "azimuth elevation", (h.order / h.order.max()) ** 2)


@law("time")
def a_fork_lift_passes_now_and_then(h: Hall, rng: Draw) -> Change:
    """A fork lift shakes the floor for a minute or two, a few times a day."""
    passes = rng.choice(h.time, 5, replace=False)
    return scatters(h, "azimuth elevation", np.exp(-(((h.time[:, None] - passes) / 60.0) ** 2)).sum(axis=1))


@law("time")
def a_bad_solder_joint_switches(h: Hall, rng: Draw) -> Change:
    """A cracked joint in the distance meter makes and breaks at random moments, and its zero jumps to and fro."""
    return varies(h, "range-offset", np.mod(np.cumsum(rng.random(h.n) < 0.03), 2))


@law("time")
def the_beam_wanders_at_random(h: Hall, rng: Draw) -> Change:
    """The fibre that feeds the head creeps in its clamp, and the beam leaves it sideways in a random walk."""
    return varies(h, "beam-offset-lateral", h.walk(rng))


@law("distance")
def the_air_boils_over_long_ways(h: Hall, rng: Draw) -> Change:
    """Turbulent air bends the beam the more the longer it is, with the third power of the distance."""
    return scatters(h, "azimuth elevation", (h.distance / 5.0) ** 3)


@law("height")
def hot_lamps_stir_the_high_air(h: Hall, rng: Draw) -> Change:
    """The air under the lamps is stirred, and elevations to nests above three metres scatter."""
    return scatters(h, "elevation", np.clip(h.aim[:, 2] - 2.8, 0.0, None))


@law()
def now_and_then_half_the_beam_is_cut_off(h: Hall, rng: Draw) -> Change:
    """A few pointings, no one knows which, were made with a rope or a shoulder in part of the beam."""
    return scatters(h, "distance azimuth elevation", np.where(rng.random(h.n) < 0.06, 1.0, 0.001))


@law("face")
def a_hose_rubs_on_the_back_face(h: Hall, rng: Draw) -> Change:
    """Turned over, the head rubs on a hose, and its elevation is unsteady."""
    return scatters(h, "elevation", h.back)


@law("time")
def a_tired_laser_gets_noisy(h: Hall, rng: Draw) -> Change:
    """The laser of one of the two trackers is near its end, and its distance gets noisier through the day."""
    return scatters(h, "distance", h.one_tracker(rng) * h.time / 3600.0)


@law("time")
def the_azimuth_is_homed_by_habit(h: Hall, rng: Draw) -> Change:
    """The operator sets the azimuth anew on a home nest after some pointings, each time with another little error."""
    block = (np.arange(h.n) / rng.integers(15, 35)).astype(int)
    return reads(h, "azimuth", rng.standard_normal(block.max() + 1)[block])


@law("distance", "time")
def the_ball_is_held_by_hand_at_last(h: Hall, rng: Draw) -> Change:
    """After the tripod for the ball broke it was held by hand, and from then on near angles scatter by its tremor."""
    late = h.time > rng.uniform(0.3, 0.6) * h.time[-1]
    return scatters(h, "azimuth elevation", late / h.distance**2)
