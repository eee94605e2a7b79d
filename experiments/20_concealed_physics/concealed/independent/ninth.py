"""A ninth set of 24 laws that are in no catalogue: what a metrologist tells of thirty years beside trackers."""

from __future__ import annotations

import numpy as np

from .cause import (
    CLOCK,
    MICRO,
    OUT,
    TURN,
    UP,
    WARM,
    Cause,
    Draw,
    backwards,
    circle,
    gap,
    group,
    lagging,
    level,
    named,
    one_station,
    one_tracker,
    reading,
    swing,
    vary,
)
from .hall import LOAD, SIZE, WARMTH, Hall
from .tracker import CONSTANTS, Array, Change, within_a_turn

# What laws are made of


def direction(h: Hall) -> Array:
    """(n,) [rad] Where the line of sight goes in the room."""
    arm = h.pointings.arm
    return np.asarray(np.arctan2(arm[:, 1], arm[:, 0]))


def leaning(directions: Array) -> Array:
    """(..., 3) Rotation vector that leans what stands upright towards a level direction."""
    return np.cross(UP, directions)


def needed(h: Hall, column: str) -> Array:
    """A column (n,), where somebody wrote it down."""
    if column not in h.columns:
        raise LookupError(f"no {column}")
    return h.columns[column]


# Constants that drift or differ


def laser_hops_between_two_modes(h: Hall, rng: Draw) -> Cause:
    """The stabilised laser falls from one mode into its neighbour and back, and its wavelength with it."""
    hops = np.cumsum(rng.uniform(600.0, 2700.0, 60))
    mode = np.searchsorted(hops, h.pointings.time) % 2
    change = vary(h, "range-scale", mode.astype(np.float64))
    return Cause(change, "distance", (*CLOCK, "distance", "range"), ("distance",))


def transit_bearing_cools_in_the_breaks(h: Hall, rng: Draw) -> Cause:
    """The motor warms one bearing of the transit axis while it works; it cools while the stand is carried on."""
    warming, cooling = rng.uniform(300.0, 900.0), rng.uniform(900.0, 2400.0)
    heat = np.zeros(len(h.pointings))
    for i, seconds in enumerate(gap(h)[1:], start=1):
        resting = h.turn_of_work[i] == 0
        past = np.exp(-seconds / (cooling if resting else warming))
        heat[i] = past * heat[i - 1] + (0.0 if resting else 1.0 - past)
    return Cause(vary(h, "transit-tilt", heat), "transit-tilt", CLOCK, ("azimuth",))


def prism_slides_in_its_glue(h: Hall, rng: Draw) -> Cause:
    """A prism in soft glue creeps downhill: its offset follows how steeply the tracker looked these last minutes."""
    slope = lagging(h, np.sin(h.pointings.seen[:, 2]), rng.uniform(120.0, 480.0))
    change = vary(h, "beam-offset-vertical", slope - slope.mean())
    return Cause(change, "vertical-offset", ("elevation", "before", *CLOCK), ("elevation",))


# Readings that follow odd things


def receiver_recovers_from_a_jump_in_light(h: Hall, rng: Draw) -> Cause:
    """After a target much nearer or farther the gain of the receiver is not at rest when the distance is taken."""
    jump = h.since_before(np.log(h.pointings.seen[:, 0]))
    amount = jump * np.exp(-gap(h) / rng.uniform(7.0, 15.0))
    return Cause(reading(h, 0, amount), "distance", ("distance", "range", *TURN), ("distance",))


def low_sun_dazzles_the_sensor(h: Hall, rng: Draw) -> Cause:
    """Sights towards a window see the sky behind the reflector, the more the lower the sun: they are led upwards."""
    p = h.pointings
    off = within_a_turn(direction(h) - rng.uniform(-np.pi, np.pi)) / rng.uniform(0.3, 0.6)
    sinking = 0.3 + p.time / p.time[-1]
    amount = np.exp(-0.5 * off**2) * np.exp(-0.5 * (p.seen[:, 2] / 0.5) ** 2) * sinking
    words = ("azimuth", "direction", "elevation", *CLOCK)
    return Cause(reading(h, 2, amount), "elevation", words, ("elevation",))


# Stands


def leg_stands_on_a_soft_tile(h: Hall, rng: Draw) -> Cause:
    """One foot of a stand is on a loose tile, which gives way when the heavy side of the head is above it."""
    name, there = one_station(h, rng)
    leg = level(rng)
    head = direction(h) + backwards(h)
    weight = there * np.clip(np.column_stack([np.cos(head), np.sin(head)]) @ leg[:2], 0.0, None) ** 2
    change = Change(
        station=-0.5 * MICRO * weight[:, None] * UP,
        turn=MICRO * weight[:, None] * leaning(leg),
    )
    return Cause(change, "station", ("azimuth", "direction"), stations=(name,))


def cable_pulls_once_it_is_wound_up(h: Hall, rng: Draw) -> Cause:
    """The cable hangs slack until the head has wound it up; from then on every further turn pulls the stand over."""
    name, there = one_station(h, rng)
    wound = np.abs(h.wound)
    slack = np.quantile(wound[there > 0], rng.uniform(0.4, 0.6))
    pull = there * np.clip(wound - slack, 0.0, None)
    change = Change(turn=MICRO * pull[:, None] * leaning(level(rng)))
    return Cause(change, "station", ("wound", "turns", "cable", *TURN, *CLOCK), stations=(name,))


def planks_bend_under_the_crew(h: Hall, rng: Draw) -> Cause:
    """Who holds the reflector stands on the same planks: near by, the stand sinks and leans towards the target.

    The gallery has a floor of its own.
    """
    p = h.pointings
    across = p.arm * [1.0, 1.0, 0.0]
    far = np.sqrt((across**2).sum(axis=1))
    weight = np.exp(-far / rng.uniform(1.2, 2.5)) * (1.0 - group(h, "gallery")[1])
    change = Change(
        station=-MICRO * weight[:, None] * UP,
        turn=0.7 * MICRO * weight[:, None] * leaning(across / far[:, None]),
    )
    return Cause(change, "station", ("distance", "range", "target", "position"))


# Targets


def trolley_of_the_crane_bows_the_gallery(h: Hall, rng: Draw) -> Cause:
    """The gallery carries the rail of a crane, whose trolley goes to and fro, and it bends under it."""
    p = h.pointings
    names, inside = group(h, "gallery")
    trip = np.mod(p.time / rng.uniform(900.0, 2700.0) + rng.random(), 1.0)
    trolley = 1.0 - np.abs(2.0 * trip - 1.0)
    bent = np.sin(np.pi * p.points[p.target, 0] / SIZE[0]) * np.sin(np.pi * trolley)
    return Cause(Change(target=-MICRO * (inside * bent)[:, None] * UP), "targets", CLOCK, targets=names)


def gusts_lean_on_the_wall(h: Hall, rng: Draw) -> Cause:
    """Gusts press the outer wall inwards, which is held at its foot alone, and it comes back slowly."""
    p = h.pointings
    names, inside = group(h, "wall")
    came = rng.uniform(-600.0, p.time[-1], rng.integers(6, 14))
    force = rng.gamma(2.0, 0.5, len(came))
    since = np.clip(p.time[:, None] - came, 0.0, None)
    push = (force * (since / 60.0) * np.exp(-since / rng.uniform(240.0, 700.0))).sum(axis=1)
    bent = (p.points[p.target, 2] / SIZE[2]) ** 2
    return Cause(Change(target=MICRO * (inside * push * bent)[:, None] * OUT), "targets", CLOCK, targets=names)


def bar_is_pushed_along_its_cradle(h: Hall, rng: Draw) -> Cause:
    """Whenever the tracker is carried past, somebody brushes a scale bar, and it slides a little along its cradle."""
    p = h.pointings
    ends = h.bars[int(rng.integers(len(h.bars)))]
    way = p.points[ends[1]] - p.points[ends[0]]
    slid = np.cumsum(rng.standard_normal(len(h.stations)))[p.station]
    amount = slid * np.isin(p.target, ends)
    change = Change(target=MICRO * amount[:, None] * way / np.sqrt((way**2).sum()))
    return Cause(change, "targets", (*CLOCK, "station"), targets=tuple(h.targets[t] for t in ends))


# Air


def curtain_of_air_parts_the_hall(h: Hall, rng: Draw) -> Cause:
    """A curtain of warm air at a door blows across the hall: sights through it go further in it the more aslant."""
    p = h.pointings
    door = rng.uniform(0.35, 0.65) * SIZE[0]
    through = (p.position[p.station, 0] - door) * (p.points[p.target, 0] - door) < 0.0
    if not through.any():
        raise LookupError("nobody looks through the curtain")
    aslant = np.sqrt((p.arm**2).sum(axis=1)) / np.where(through, np.abs(p.arm[:, 0]), np.inf)
    words = ("station", "target", "position", "place", "side", "plane", "x")
    return Cause(reading(h, 0, -np.minimum(aslant, 4.0)), "distance", words, ("distance",))


def warm_bubble_stays_about_a_still_head(h: Hall, rng: Draw) -> Cause:
    """A swing of the head stirs the warm air about it; after a small one its bubble still bends the sight."""
    bubble = np.exp(-np.abs(swing(h)) / rng.uniform(0.3, 0.9)) * (h.turn_of_work > 0)
    return Cause(reading(h, 2, bubble), "elevation", TURN, ("elevation",))


# Noise


def forklifts_shake_what_is_near_their_aisle(h: Hall, rng: Draw) -> Cause:
    """Forklifts go along an aisle all day; nests near it tremble."""
    p = h.pointings
    off = (p.points[p.target, 1] - rng.uniform(0.15, 0.85) * SIZE[1]) / rng.uniform(0.6, 1.2)
    shaken = np.repeat(np.exp(-0.5 * off**2)[:, None], 3, axis=1)
    return Cause(Change(variance=shaken), "noise", ("target", "position", "place", "y"))


def servo_hunts_after_a_long_swing(h: Hall, rng: Draw) -> Cause:
    """The azimuth drive still hunts when the reading is taken soon after a long swing."""
    hunting = (np.abs(swing(h)) / np.pi) ** 2 * np.exp(-gap(h) / rng.uniform(6.0, 12.0))
    variance = np.zeros((len(hunting), 3))
    variance[:, 1] = hunting
    return Cause(Change(variance=variance), "noise", (*TURN, "azimuth"), ("azimuth",))


def light_comes_back_thin_at_grazing_sights(h: Hall, rng: Draw) -> Cause:
    """Reflectors that sit in their nests and are seen from aside send back little light, and the distance scatters."""
    p = h.pointings
    sight = p.arm / np.sqrt((p.arm**2).sum(axis=1, keepdims=True))
    facing = -(sight * h.normals[p.target]).sum(axis=1)
    variance = np.zeros((len(p), 3))
    variance[:, 0] = (1.0 - facing**2) ** rng.uniform(1.0, 3.0)
    return Cause(Change(variance=variance), "noise", ("incidence", "angle", "normal"), ("distance",))


# Order of the work, and what is written down


def weather_is_read_too_seldom(h: Hall, rng: Draw) -> Cause:
    """The controller asks its thermometer once in half an hour or more; till then its correction stands."""
    time, warmth = h.pointings.time, needed(h, WARMTH)
    every = rng.uniform(1800.0, 4500.0)
    asked = np.clip(time - np.mod(time + rng.uniform(0.0, every), every), 0.0, None)
    change = vary(h, "range-scale", warmth - np.interp(asked, time, warmth))
    return Cause(change, "distance", (*WARM, "order", "distance", "range"), ("distance",))


def every_round_homes_anew(h: Hall, rng: Draw) -> Cause:
    """Before every round the reflector goes home, and each time it sits a little otherwise in its place."""
    p = h.pointings
    if p.repeat.max() < 2:
        raise LookupError("one round only")
    seat = rng.standard_normal((len(h.stations), int(p.repeat.max())))
    amount = seat[p.station, p.repeat - 1]
    words = ("round", "repeat", "station", *CLOCK)
    return Cause(reading(h, 0, amount), "distance", words, ("distance",))


def hand_warms_the_reflector_on_the_way(h: Hall, rng: Draw) -> Cause:
    """The reflector is carried in the hand: after a long walk it comes warm into its nest, and cools there."""
    p = h.pointings
    walk = np.sqrt((np.diff(p.points[p.target], axis=0, prepend=p.points[p.target[:1]]) ** 2).sum(axis=1))
    walk = np.where(h.turn_of_work > 0, walk, 0.0)
    kept, warm = np.exp(-gap(h) / rng.uniform(15.0, 60.0)), walk.copy()
    for i in range(1, len(warm)):
        warm[i] += kept[i] * warm[i - 1]
    return Cause(reading(h, 0, -warm), "distance", ("walk", *TURN, "order"), ("distance",))


# Further columns


def table_lags_behind_the_hall(h: Hall, rng: Draw) -> Cause:
    """The legs at one side of the table are thin and those at the other thick: it tilts with the warmth, but later."""
    p = h.pointings
    names, inside = group(h, "table")
    warm = lagging(h, needed(h, WARMTH), rng.uniform(600.0, 2400.0))
    place = (p.points[p.target] - p.points[h.groups["table"]].mean(axis=0)) @ level(rng)
    amount = inside * (warm - warm.mean()) * (1.0 + place)
    return Cause(Change(target=MICRO * amount[:, None] * UP), "targets", WARM, targets=names)


def floor_dents_round_the_press(h: Hall, rng: Draw) -> Cause:
    """The press stands on the slab at a corner of the hall: under load the floor goes down, most beside it."""
    p = h.pointings
    names, inside = group(h, "floor")
    load = needed(h, LOAD) / 100.0
    press = np.array([SIZE[0] + 0.5, rng.uniform(0.0, 1.0) * SIZE[1]])
    far = np.sqrt(((p.points[p.target, :2] - press) ** 2).sum(axis=1))
    amount = inside * load / (0.5 + far)
    return Cause(Change(target=-MICRO * amount[:, None] * UP), "targets", (LOAD, "load", "time"), targets=names)


def stands_twist_while_the_hall_warms(h: Hall, rng: Draw) -> Cause:
    """The tubes of the stands are spiral-welded: while their outside is warmer than their inside, they twist."""
    warmth = needed(h, WARMTH)
    skin = warmth - lagging(h, warmth, rng.uniform(400.0, 1200.0))
    return Cause(Change(turn=MICRO * skin[:, None] * UP), "yaw", WARM)


# One of two trackers


def one_tracker_has_a_scratched_circle(h: Hall, rng: Draw) -> Cause:
    """One of the trackers was once opened: there is a scratch across a few degrees of its azimuth circle."""
    place, there = one_tracker(h, rng)
    off = within_a_turn(circle(h) - rng.uniform(-np.pi, np.pi)) / rng.uniform(0.1, 0.3)
    amount = there * np.exp(-0.5 * off**2)
    return Cause(reading(h, 1, amount), "azimuth", ("azimuth",), ("azimuth",), place=place)


def circle_of_one_tracker_creeps_on_its_hub(h: Hall, rng: Draw) -> Cause:
    """The circle of one tracker is loose on its hub: with each hard swing of the head it creeps on, always one way."""
    place, there = one_tracker(h, rng)
    hard = there * np.clip(np.abs(swing(h)) - rng.uniform(1.0, 2.0), 0.0, None)
    crept, phase = there * np.cumsum(hard), rng.uniform(-np.pi, np.pi)
    change = np.zeros((len(crept), len(CONSTANTS)))
    change[:, CONSTANTS.index("azimuth-eccentricity-cos")] = MICRO * crept * np.cos(phase)
    change[:, CONSTANTS.index("azimuth-eccentricity-sin")] = MICRO * crept * np.sin(phase)
    words = (*CLOCK, *TURN, "azimuth")
    return Cause(Change(constants=change), "eccentricity", words, ("azimuth",), place=place)


LAWS = named(
    laser_hops_between_two_modes,
    transit_bearing_cools_in_the_breaks,
    prism_slides_in_its_glue,
    receiver_recovers_from_a_jump_in_light,
    low_sun_dazzles_the_sensor,
    leg_stands_on_a_soft_tile,
    cable_pulls_once_it_is_wound_up,
    planks_bend_under_the_crew,
    trolley_of_the_crane_bows_the_gallery,
    gusts_lean_on_the_wall,
    bar_is_pushed_along_its_cradle,
    curtain_of_air_parts_the_hall,
    warm_bubble_stays_about_a_still_head,
    forklifts_shake_what_is_near_their_aisle,
    servo_hunts_after_a_long_swing,
    light_comes_back_thin_at_grazing_sights,
    weather_is_read_too_seldom,
    every_round_homes_anew,
    hand_warms_the_reflector_on_the_way,
    table_lags_behind_the_hall,
    floor_dents_round_the_press,
    stands_twist_while_the_hall_warms,
    one_tracker_has_a_scratched_circle,
    circle_of_one_tracker_creeps_on_its_hub,
)
