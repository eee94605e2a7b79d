"""Fresh laws about stands, floors, cranes, presses and cables."""

from ..law import UP, Change, Draw, Hall, law, leans, level, np, shifts


def _swings(h: Hall) -> np.ndarray:
    """Turns of the head with their sign, which half a turn to the back face does not have."""
    if h.back.any():
        raise LookupError("two faces")
    return h.swing


@law("time", "place")
def a_crane_passes_overhead(h: Hall, rng: Draw) -> Change:
    """A crane travels along the hall and back, and the stand it is above of sinks with the floor."""
    cycle = rng.uniform(500.0, 1200.0)
    crane = h.size.room[0] * np.abs(2.0 * np.mod(h.time / cycle, 1.0) - 1.0)
    return shifts(h, np.exp(-(((h.stand[:, 0] - crane) / 2.0) ** 2)), -UP)


@law("time")
def the_column_grows_over_its_own_heater(h: Hall, rng: Draw) -> Change:
    """The tracker heats the aluminium column under it, which grows upwards anew at every set-up."""
    return shifts(h, 1.0 - np.exp(-h.since_setup / rng.uniform(250.0, 900.0)), UP)


@law("time")
def a_tripod_sinks_into_soft_tar(h: Hall, rng: Draw) -> Change:
    """One tripod stands on tar and sinks with the square root of the time."""
    return shifts(h, h.one_station(rng) * np.sqrt(h.since_setup), -UP)


@law("time")
def every_stand_settles_its_own_way(h: Hall, rng: Draw) -> Change:
    """Clamps and rubber feet creep with the logarithm of time after each set-up, each stand to a side of its own."""
    bearing = rng.uniform(-np.pi, np.pi, len(h.stations))[h.pointings.station]
    axis = np.column_stack([np.cos(bearing), np.sin(bearing), np.zeros(h.n)])
    return leans(h, np.log1p(h.since_setup / 60.0), axis)


@law("distance", "azimuth", may="place")
def the_floor_gives_under_the_operator(h: Hall, rng: Draw) -> Change:
    """The operator stands beside the ball, and the floor dips so that a near stand leans towards him."""
    beam = (h.aim - h.stand) / h.distance[:, None]
    return leans(h, np.exp(-h.distance / rng.uniform(1.0, 2.0)), np.cross(UP, beam))


@law("press_load_kn", "place", may="time")
def the_press_tips_the_floor_about_it(h: Hall, rng: Draw) -> Change:
    """The loaded press dents the floor, and stands lean towards it, the near ones more."""
    way = h.stand - np.array([*(rng.uniform(0.1, 0.9, 2) * h.size.room[:2]), 0.0])
    gap = np.hypot(way[:, 0], way[:, 1])
    return leans(h, h.load / (1.0 + gap), np.cross(way / gap[:, None], UP))


@law("press_load_kn", may="time")
def a_slab_lifts_off_under_high_load(h: Hall, rng: Draw) -> Change:
    """Under high load the slab of the trackers lifts off its bed and falls back only when the load is nearly gone."""
    return leans(h, h.latched(h.load, 0.2, 0.8), level(rng))


@law("approach", may="time azimuth")
def the_stand_twists_back_slowly(h: Hall, rng: Draw) -> Change:
    """Each swing of the head twists the rubber under the stand, which creeps back within minutes."""
    return leans(h, h.fading(_swings(h), rng.uniform(30.0, 150.0)), UP)


@law("approach", may="time azimuth")
def a_magnetic_foot_slips_with_long_swings(h: Hall, rng: Draw) -> Change:
    """The magnets that hold the foot let go a little when the head swings far, and the stand is left turned."""
    swing = _swings(h)
    return leans(h, np.cumsum(np.sign(swing) * (np.abs(swing) > rng.uniform(1.0, 1.8))), UP)


@law("approach", may="azimuth time")
def the_wound_cable_pulls_the_stand_over(h: Hall, rng: Draw) -> Change:
    """The cable winds up about the column, gets short and pulls the stand over to the controller's side."""
    way = np.cumsum(_swings(h))
    return leans(h, (way - way[h.starts]) ** 2, level(rng))


@law("azimuth", may="face")
def one_leg_is_weaker(h: Hall, rng: Draw) -> Change:
    """The head is not balanced, and when its heavy side is over the weak leg of one stand, that stand leans."""
    axis = h.pointings.rotation[h.pointings.station] @ np.array([0.0, 1.0, 0.0])
    return leans(h, h.one_station(rng) * np.clip(np.cos(h.circle), 0.0, None), axis)


@law("time")
def a_hydraulic_stand_leaks(h: Hall, rng: Draw) -> Change:
    """The lifting column of one of the two trackers leaks oil, so it sinks and is pumped up at the next set-up."""
    return shifts(h, h.one_tracker(rng) * h.since_setup / 600.0, -UP)


@law("time")
def air_springs_are_filled_by_a_valve(h: Hall, rng: Draw) -> Change:
    """The stands float on air springs that leak until a valve fills them with a jerk, over and over."""
    cycle = rng.uniform(200.0, 700.0)
    return leans(h, np.mod(h.time + rng.uniform(0.0, cycle), cycle) / cycle, level(rng))


@law("temperature", "height", may="time place")
def tall_stands_wag_with_the_warmth(h: Hall, rng: Draw) -> Change:
    """The columns are warped by the temperature, and a tracker that stands high is carried sideways farther."""
    return shifts(h, h.warmth * (h.stand[:, 2] - 1.0), level(rng))


@law("temperature", "time")
def fresh_feet_slide_when_it_warms(h: Hall, rng: Draw) -> Change:
    """Feet that are newly set slide on the warming floor, and hold better the longer they have stood."""
    return shifts(h, np.cumsum(h.change(h.warmth) * np.exp(-h.since_setup / 400.0)), level(rng))
