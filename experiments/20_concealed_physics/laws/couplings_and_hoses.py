"""Laws about batteries, plugs, cables, motors and the mains."""

from ..law import UP, Change, Draw, Hall, law, leans, np, reads, varies


@law("time")
def the_battery_goes_flat_before_the_stand_is_done(h: Hall, rng: Draw) -> Change:
    """Each stand begins with a fresh battery.

    It holds for a while, then its voltage falls away and the beam is bent aside.
    """
    minutes = rng.uniform(0.25, 0.55) * h.since_setup.max()
    return varies(h, "beam-tilt", (np.maximum(h.since_setup - minutes, 0.0) / 600.0) ** rng.uniform(1.0, 1.8))


@law("approach", may="azimuth time")
def the_cable_round_the_column_runs_out_of_slack(h: Hall, rng: Draw) -> Change:
    """The cable winds round the column as the head turns; once its slack is used up it twists the stand along."""
    slack, start = rng.uniform(0.6, 2.0), rng.uniform(-1.5, 1.5)
    wound = h.wound + start
    return leans(h, np.sign(wound) * np.minimum(np.maximum(np.abs(wound) - slack, 0.0), 3.0), UP)


@law("approach|time", may="approach time azimuth")
def busy_motors_warm_one_arm_of_the_fork(h: Hall, rng: Draw) -> Change:
    """The motor sits in one arm of the fork; the more it has had to turn of late, the longer that arm has grown."""
    heat = h.fading(np.abs(h.swing), rng.uniform(150.0, 600.0))
    return varies(h, "transit-tilt", heat / (heat + 0.7 * heat.max()))


@law("azimuth", may="face")
def a_worn_slip_ring_touches_badly_in_one_sector(h: Hall, rng: Draw) -> Change:
    """In one sector of the turn the ring that feeds the distance meter touches badly, and the meter runs late there."""
    middle, half = rng.uniform(-np.pi, np.pi), rng.uniform(0.35, 0.8)
    off = np.abs(np.arctan2(np.sin(h.circle - middle), np.cos(h.circle - middle)))
    return varies(h, "range-offset", 1.0 / (1.0 + np.exp((off - half) / 0.05)))


@law("time")
def the_mains_beats_with_the_sampling(h: Hall, rng: Draw) -> Change:
    """Hum on both motors is sampled close to its own rate.

    A slow beat is left that carries the beam round a circle.
    """
    phase = 2 * np.pi * (h.time / rng.uniform(240.0, 700.0) + rng.random())
    aside = rng.uniform(0.4, 1.0) / np.cos(h.elevation)
    return reads(h, "azimuth", aside * np.cos(phase)) + reads(h, "elevation", np.sin(phase))
