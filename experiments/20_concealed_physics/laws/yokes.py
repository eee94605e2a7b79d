"""Laws about constants of the tracker that do not stay constant."""

from ..law import Change, Draw, Hall, law, np, reads, varies


@law("time")
def a_fan_cools_the_index(h: Hall, rng: Draw) -> Change:
    """The fan in the yoke runs by its own thermostat, and the plate that bears the index mark follows with a lag."""
    return varies(h, "vertical-index", h.lagging(h.windows(rng), rng.uniform(150.0, 500.0)))


@law("elevation", may="approach")
def a_loose_lens_falls_to_the_other_side(h: Hall, rng: Draw) -> Change:
    """A lens with play in a slanted cell lies on one side when the tube looks up, on the other when it looks down."""
    return varies(h, "beam-tilt", 5.0 * h.latched(h.elevation, rng.uniform(-0.25, -0.1), rng.uniform(0.0, 0.15)))


@law("approach|time")
def the_motors_warm_one_side_of_the_yoke(h: Hall, rng: Draw) -> Change:
    """Each turn of the head leaves heat of the drive in one arm of the yoke, which grows, and cools in half an hour."""
    return varies(h, "transit-tilt", h.fading(np.abs(h.swing), rng.uniform(1000.0, 2500.0)) / 10.0)


@law("distance")
def the_focus_carriage_runs_on_a_bent_rail(h: Hall, rng: Draw) -> Change:
    """The lens that focuses at the reflector's distance rides on a rail that is bent sideways, and turns the beam."""
    return varies(h, "beam-tilt", 3.0 * np.sin(2 * np.pi * (h.distance / rng.uniform(4.0, 7.0) + rng.random())))


@law("temperature", may="azimuth face time")
def a_disc_hub_grows_out_of_centre(h: Hall, rng: Draw) -> Change:
    """The azimuth disc is cemented to its hub on one side, and the warmth of the hall drives it out of centre, late."""
    warm, way = 5.0 * h.lagging(h.warmth, rng.uniform(300.0, 900.0)), rng.uniform(-np.pi, np.pi)
    cosine = varies(h, "azimuth-eccentricity-cos", np.cos(way) * warm)
    return cosine + varies(h, "azimuth-eccentricity-sin", np.sin(way) * warm)


@law("time|place")
def each_start_finds_another_zero(h: Hall, rng: Draw) -> Change:
    """At every set-up the tracker is switched on anew and seeks its elevation mark, never quite the same."""
    return varies(h, "vertical-index", 3.0 * rng.standard_normal(len(h.stations))[h.pointings.station])


@law("time")
def the_laser_tube_is_knocked_in_the_longest_pause(h: Hall, rng: Draw) -> Change:
    """When a tracker was carried over in the longest break its laser tube slipped sideways in the clamp."""
    own = h.one_tracker(rng) if len(h.trackers) > 1 else np.ones(h.n)
    return varies(h, "beam-offset-lateral", 10.0 * own * (h.time >= h.time[np.argmax(h.gap)]))


@law("face", "time")
def a_cable_loom_presses_on_the_plunged_tube(h: Hall, rng: Draw) -> Change:
    """On the back face the loom lies on the tube; it softens as the head warms through, and presses less and less."""
    if h.back.max() == 0.0:
        raise LookupError("one face only")
    return reads(h, "elevation", 5.0 * h.back * np.exp(-h.time / rng.uniform(2000.0, 5000.0)))
