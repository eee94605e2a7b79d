"""Used laws about people: how they place balls, walk, write down and file."""

from ..law import UP, Change, Draw, Hall, gauge, law, leans, moves, np, reads, scatters


@law("time", may="place")
def second_shift_has_another_ball(h: Hall, rng: Draw) -> Change:
    """Two people take turns from set-up to set-up, and the ball of one is larger than the list says."""
    return moves(h, np.mod(h.pointings.station, 2.0), h.normal)


@law("place", may="height")
def ball_held_by_hand_up_there(h: Hall, rng: Draw) -> Change:
    """The magnets on the gallery are too weak, so somebody holds the ball there by hand."""
    return scatters(h, "distance azimuth elevation", h.group("gallery"))


@law("time|approach")
def ball_not_pushed_home_in_a_hurry(h: Hall, rng: Draw) -> Change:
    """Somebody wipes the ball before each pointing and in a hurry does not push it fully back into its nest."""
    return moves(h, (h.order > 0) * np.exp(-h.gap / rng.uniform(3.0, 8.0)), h.normal)


@law("distance", may="azimuth place")
def person_at_a_near_nest_tips_the_stand(h: Hall, rng: Draw) -> Change:
    """Who holds the ball stands beside the nest; the floor yields and tips a near tracker towards that side."""
    way = (h.aim - h.stand) / h.distance[:, None]
    return leans(h, np.exp(-h.distance / rng.uniform(1.0, 2.0)), np.cross(UP, way))


@law("temperature", "distance", may="time")
def air_typed_in_once_a_set_up(h: Hall, rng: Draw) -> Change:
    """The temperature is typed in when a set-up begins, and ranges follow what the air does after that."""
    return reads(h, "distance", h.distance * (h.warmth - h.warmth[h.starts]))


@law("temperature", "distance")
def air_rounded_to_half_degrees(h: Hall, rng: Draw) -> Change:
    """Somebody reads a coarse thermometer to half a degree for the correction of the ranges."""
    return reads(h, "distance", h.distance * (h.warmth - 0.5 * np.round(2.0 * h.warmth)))


@law("time", may="place")
def ball_from_a_warm_pocket(h: Hall, rng: Draw) -> Change:
    """The ball is carried in the pocket between set-ups and shrinks while it cools."""
    return moves(h, np.exp(-h.since_setup / rng.uniform(120.0, 400.0)), h.normal)


@law("time", may="place")
def grease_is_pressed_out_of_the_nests(h: Hall, rng: Draw) -> Change:
    """The floor's nests were greased in the morning; every visit presses some of it out and the ball sits deeper."""
    visits = h.pointings.station * h.pointings.repeat.max() + h.pointings.repeat
    return moves(h, h.group("floor") * np.exp(-visits / rng.uniform(1.0, 3.0)), h.normal)


@law("time", may="place height")
def tools_lie_on_the_table(h: Hall, rng: Draw) -> Change:
    """The mechanics lay their heavy tools on the end of the table for a part of every job and take them off again."""
    return moves(h, -h.group("table") * h.windows(rng) * (h.aim[:, 0] - h.size.room[0] + 3.0), UP)


@law(may="place height time")
def one_crew_books_the_wrong_nest_height(h: Hall, rng: Draw) -> Change:
    """The crew of one tracker has an old list, in which the floor's nests are of another height."""
    return moves(h, h.group("floor") * h.one_tracker(rng), UP)


@law(may="distance")
def certificate_at_the_wrong_temperature(h: Hall, rng: Draw) -> Change:
    """The bars were certified in a warm laboratory and nobody brought the lengths back to twenty degrees."""
    return gauge(h, 10.0 * h.lengths)


@law()
def bar_was_dropped_after_calibration(h: Hall, rng: Draw) -> Change:
    """One of the bars fell on its end after it had been certified and is shorter now."""
    return gauge(h, np.eye(len(h.bars))[rng.integers(len(h.bars))])


@law(may="distance")
def end_caps_added_to_both_bars(h: Hall, rng: Draw) -> Change:
    """The clerk added the caps of the ends to both certified lengths, which held them already."""
    return gauge(h, np.ones(len(h.bars)))


@law("time", may="place")
def wall_nests_unscrew_themselves(h: Hall, rng: Draw) -> Change:
    """The nests of the wall turn a little in their threads with each visit and screw themselves outwards."""
    return moves(h, h.group("wall") * np.sqrt(h.pointings.station), h.normal)
