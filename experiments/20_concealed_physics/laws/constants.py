"""Used laws about constants of the tracker that do not stay what they were."""

from ..law import Change, Draw, Hall, law, np, varies


@law("time")
def laser_tires(h: Hall, rng: Draw) -> Change:
    """The glue of a prism creeps under its spring: the beam's tilt runs off with the logarithm of the time."""
    return varies(h, "beam-tilt", np.log1p(h.time / rng.uniform(300.0, 1200.0)))


@law("azimuth", "time")
def sun_walks_round_the_hall(h: Hall, rng: Draw) -> Change:
    """Sun through the roof lights warms the head's brow when it faces the sun, which goes round with the hours."""
    x, y, _ = (h.aim - h.stand).T
    sun = rng.uniform(-np.pi, np.pi) - np.radians(15.0) * h.time / 3600.0
    return varies(h, "vertical-index", np.maximum(0.0, np.cos(np.arctan2(y, x) - sun)))


@law("time")
def carried_on_its_side(h: Hall, rng: Draw) -> Change:
    """One of the trackers travels on its side, and in every set-up its collimator creeps back to where it was."""
    return varies(h, "beam-offset-vertical", h.one_tracker(rng) * np.exp(-h.since_setup / rng.uniform(120.0, 400.0)))
