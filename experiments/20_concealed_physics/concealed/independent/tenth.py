"""A tenth set of 24 laws that are in no catalogue: anecdotes of halls, their machines and what people do there."""

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
    aims,
    decaying,
    group,
    latched,
    level,
    named,
    one_station,
    one_tracker,
    reading,
    swing,
    vary,
    windows,
)
from .hall import LOAD, SIZE, WARMTH, Hall
from .tracker import CONSTANTS, Array, Change, within_a_turn

# What laws are made of


def placings(h: Hall) -> Array:
    """(n,) 1 where the ball was put into another nest before the pointing."""
    other = np.diff(h.pointings.target, prepend=-1) != 0
    return (other | (h.turn_of_work == 0)).astype(np.float64)


def heads(h: Hall) -> Array:
    """(n, 3) [m] Where the head is, in the room."""
    return np.asarray(h.pointings.position[h.pointings.station])


def bell(values: Array, width: float) -> Array:
    """(n,) 1 at zero, and little beyond a width."""
    return np.asarray(np.exp(-0.5 * (values / width) ** 2))


def wave(h: Hall, rng: Draw, shortest: float, longest: float) -> Array:
    """(n,) A sine of the clock with a period between two [s]."""
    return np.asarray(np.sin(2 * np.pi * (h.pointings.time / rng.uniform(shortest, longest) + rng.random())))


def moved(amount: Array, way: Array) -> Array:
    """(n, 3) Micrometres or microradians (n,) along a way (3,) or ways (n, 3)."""
    return np.asarray(MICRO * amount[:, None] * way)


# Constants of the instrument


def telescope_warps_with_the_work_of_the_motors(h: Hall, rng: Draw) -> Cause:
    """Every turn of the head heats its motors, whose warmth goes into the telescope and out again in a while."""
    steps = np.abs(h.since_before(h.pointings.seen[:, 2])) + np.abs(swing(h))
    return Cause(vary(h, "beam-tilt", decaying(h, steps, rng.uniform(300.0, 1500.0))), "beam-tilt", (*CLOCK, *TURN))


def trunnion_takes_another_seat_at_each_carrying(h: Hall, rng: Draw) -> Cause:
    """A worn bearing of the transit axis settles differently whenever the tracker was carried."""
    seats = rng.standard_normal(len(h.stations))
    return Cause(vary(h, "transit-tilt", seats[h.pointings.station]), "transit-tilt", ("station", "visit", *CLOCK))


def sun_from_a_skylight_pushes_the_circle_aside(h: Hall, rng: Draw) -> Cause:
    """The side of the housing that the sun shines on grows; the sun passes the skylight once and goes on round."""
    time = h.pointings.time
    noon, length = rng.uniform(0.3, 0.7) * time[-1], rng.uniform(1800.0, 5400.0)
    bearing = rng.uniform(-np.pi, np.pi) - np.radians(15.0) * time / 3600.0
    sun = np.column_stack([np.cos(bearing), np.sin(bearing), np.zeros(len(time))])
    local = (sun[:, None, :] @ h.pointings.rotation[h.pointings.station])[:, 0]
    change = np.zeros((len(time), len(CONSTANTS)))
    for axis, constant in enumerate(("azimuth-eccentricity-cos", "azimuth-eccentricity-sin")):
        change[:, CONSTANTS.index(constant)] = MICRO * bell(time - noon, length) * local[:, axis]
    return Cause(Change(constants=change), "eccentricity", ("azimuth", "station", *CLOCK), ("azimuth",))


# Readings


def lamp_near_the_line_of_sight_draws_the_spot(h: Hall, rng: Draw) -> Cause:
    """A lamp in the field of the detector pulls the middle of the returned spot up or down, towards itself."""
    near = h.pointings.points[rng.choice(h.groups["gallery"])]
    lamp = near + rng.uniform([-0.6, -0.3, -0.6], [0.6, 0.0, 0.6]) - heads(h)
    height = np.arctan2(lamp[:, 2], np.hypot(lamp[:, 0], lamp[:, 1]))
    arm = h.pointings.arm
    beside = within_a_turn(np.arctan2(arm[:, 1], arm[:, 0]) - np.arctan2(lamp[:, 1], lamp[:, 0]))
    above, width = height - h.pointings.seen[:, 2], rng.uniform(0.15, 0.35)
    pull = above / width * bell(above, width) * bell(beside * np.cos(height), width)
    return Cause(reading(h, 2, pull), "elevation", ("elevation", "azimuth", "bearing", "target"), ("elevation",))


def head_nods_when_it_brakes_from_a_wide_swing(h: Hall, rng: Draw) -> Cause:
    """Braking about the standing axis rocks the yoke, and the elevation is read before it came to rest."""
    nod = (np.abs(swing(h)) / np.pi) ** rng.uniform(1.0, 2.0)
    return Cause(reading(h, 2, nod), "elevation", (*TURN, "azimuth"), ("elevation",))


def polished_floor_mirrors_a_second_ray(h: Hall, rng: Draw) -> Cause:
    """Light that comes back by way of the floor mixes with the straight ray, in step or not by its longer way."""
    over, arm = heads(h)[:, 2] + aims(h)[:, 2], h.pointings.arm
    longer = np.sqrt(arm[:, 0] ** 2 + arm[:, 1] ** 2 + over**2) - h.pointings.seen[:, 0]
    mixed = np.sin(2 * np.pi * (longer / rng.uniform(0.3, 0.7) + rng.random()))
    return Cause(reading(h, 0, mixed), "distance", ("distance", "range", "elevation", "height"), ("distance",))


# Stands


def levelling_of_an_air_sprung_stand_hunts(h: Hall, rng: Draw) -> Cause:
    """The valves of an isolated stand let air in and out in turn, and it rocks about its level by minutes."""
    name, here = one_station(h, rng)
    change = Change(turn=moved(here * wave(h, rng, 150.0, 420.0), level(rng)))
    return Cause(change, "station", CLOCK, stations=(name,), place=name)


def bridge_crane_presses_its_bay_of_the_floor_down(h: Hall, rng: Draw) -> Cause:
    """The columns of the crane's runway carry it into the floor: a stand sinks while the crane is beside it."""
    crane = SIZE[0] * (0.5 + 0.5 * wave(h, rng, 1200.0, 3000.0))
    away = (heads(h)[:, 0] - crane) / rng.uniform(1.0, 2.5)
    return Cause(Change(station=moved(-1.0 / (1.0 + away**2), UP)), "station", (*CLOCK, "station"))


def cover_of_a_pit_tips_under_who_carries_the_ball(h: Hall, rng: Draw) -> Cause:
    """One stand has a foot on the cover of a pit, which tips when its other half is stepped on to reach the nest."""
    name, here = one_station(h, rng)
    across = (h.pointings.points - h.pointings.points.mean(axis=0)) @ level(rng)
    beyond = (across > np.quantile(across, rng.uniform(0.35, 0.65)))[h.pointings.target]
    change = Change(turn=moved(here * beyond, level(rng)))
    return Cause(change, "station", ("azimuth", "bearing", "target"), stations=(name,), place=name)


# Targets


def wind_bellies_a_sheet_metal_wall_while_a_door_is_open(h: Hall, rng: Draw) -> Cause:
    """The wall stands out in its middle and is held at its rim, for as long as the door on the other side is open."""
    targets, inside = group(h, "wall")
    at = aims(h)
    shape = np.sin(np.pi * at[:, 1] / SIZE[1]) * np.sin(np.pi * at[:, 2] / SIZE[2])
    change = Change(target=moved(inside * shape * windows(h, rng), OUT))
    return Cause(change, "targets", CLOCK, targets=targets, place="wall")


def table_is_nudged_round_whenever_a_ball_is_set_on_it(h: Hall, rng: Draw) -> Cause:
    """A light table on smooth feet: everyone who sets the ball turns it a little, mostly the same way."""
    targets, inside = group(h, "table")
    angle = np.cumsum(inside * placings(h) * rng.normal(1.0, 1.0, len(inside)))
    arm = aims(h) - h.pointings.points[h.groups["table"]].mean(axis=0)
    change = Change(target=moved(inside * angle, np.cross(UP, arm)))
    return Cause(change, "targets", CLOCK, targets=targets, place="table")


def ground_water_tips_the_slab_beyond_the_joint(h: Hall, rng: Draw) -> Cause:
    """A pump under a part of the floor that no stand is on runs by turns; that slab hinges on its joint."""
    past = np.maximum(h.pointings.points[:, 0] - rng.uniform(3.0, 6.0), 0.0)
    past[np.setdiff1d(np.arange(len(past)), h.groups["floor"])] = 0.0
    rise = past[h.pointings.target] * wave(h, rng, 1500.0, 3600.0)
    targets = tuple(h.targets[t] for t in np.flatnonzero(past).tolist())
    return Cause(Change(target=moved(rise, UP)), "targets", CLOCK, targets=targets, place="floor")


# Air


def cold_air_from_the_gate_lies_on_the_floor(h: Hall, rng: Draw) -> Cause:
    """Some times a day the gate lets cold air in, as deep as a man's hips; it is denser, and warms up in a while."""
    time, depth = h.pointings.time, rng.uniform(0.7, 1.2)
    opened = np.sort(rng.uniform(0.0, time[-1], 4))
    since = time[:, None] - opened
    cold = np.where(since > 0, np.exp(-np.maximum(since, 0.0) / rng.uniform(600.0, 1500.0)), 0.0).sum(axis=1)
    foot, drop = aims(h)[:, 2], heads(h)[:, 2] - aims(h)[:, 2]
    below = np.where(foot < depth, (depth - foot) / np.where(foot < depth, drop, 1.0), 0.0)
    drivers = (*CLOCK, "elevation", "height", "distance", "range")
    return Cause(reading(h, 0, cold * below * h.pointings.seen[:, 0]), "distance", drivers, ("distance",))


def beams_bend_while_the_floor_lags_behind_the_warming_air(h: Hall, rng: Draw) -> Cause:
    """Air above follows the heating at once, air below the slow floor; thermometers on masts correct the ranges."""
    warmth, lag = h.columns[WARMTH], rng.uniform(1200.0, 3600.0)
    share = 1.0 - np.exp(-np.diff(h.pointings.time, prepend=-np.inf) / lag)
    distance, _, elevation = h.pointings.seen.T
    bend = distance * np.cos(elevation) * (warmth - decaying(h, share * warmth, lag))
    return Cause(reading(h, 2, bend), "elevation", (*WARM, "order", "distance", "range"), ("elevation",))


# Noise


def oil_mist_over_a_lathe_roughens_ranges(h: Hall, rng: Draw) -> Cause:
    """Droplets scatter the beam where it crosses the mist, and the ranges by that way are rough."""
    lathe, arm = rng.uniform([3.0, 2.0], [8.0, 5.0]), h.pointings.arm
    there = lathe - heads(h)[:, :2]
    along = np.clip((there * arm[:, :2]).sum(axis=1) / (arm[:, :2] ** 2).sum(axis=1), 0.0, 1.0)
    miss = np.hypot(*(there - along[:, None] * arm[:, :2]).T)
    height = heads(h)[:, 2] + along * arm[:, 2]
    mist = np.zeros(arm.shape)
    mist[:, 0] = bell(miss, rng.uniform(0.4, 0.9)) * bell(height - 1.4, 0.9)
    return Cause(Change(variance=mist), "noise", ("azimuth", "bearing", "elevation", "target"), ("distance",))


def servo_trembles_where_the_telescope_is_in_balance(h: Hall, rng: Draw) -> Cause:
    """Where no weight loads the gear it finds no flank to rest on, and the elevation trembles."""
    tremble = np.zeros((len(h.pointings), 3))
    tremble[:, 2] = bell(h.pointings.seen[:, 2] - rng.uniform(-0.2, 0.1), rng.uniform(0.08, 0.2))
    return Cause(Change(variance=tremble), "noise", ("elevation", "height"), ("elevation",))


def ranges_roughen_as_the_battery_runs_down(h: Hall, rng: Draw) -> Cause:
    """The laser dims with the voltage; a charged battery is put in before every second set-up."""
    time, station = h.pointings.time, h.pointings.station
    charged = np.array([time[station >= s - s % 2].min() for s in range(len(h.stations))])
    rough = np.zeros((len(time), 3))
    rough[:, 0] = ((time - charged[station]) / 3600.0) ** rng.uniform(2.0, 4.0)
    return Cause(Change(variance=rough), "noise", (*CLOCK, "station"), ("distance",))


# Bookkeeping, order and memory


def air_temperature_is_typed_in_once_an_hour(h: Hall, rng: Draw) -> Cause:
    """In between the ranges are corrected with what the thermometer showed last time."""
    time = h.pointings.time
    first = rng.uniform(-3600.0, 0.0)
    typed = np.interp(first + 3600.0 * np.floor((time - first) / 3600.0), time, h.columns[WARMTH])
    stale = h.pointings.seen[:, 0] * (h.columns[WARMTH] - typed)
    return Cause(reading(h, 0, stale), "distance", (*WARM, "order", "distance", "range"), ("distance",))


def dust_gathers_on_the_ball_until_it_is_wiped(h: Hall, rng: Draw) -> Cause:
    """Every nest leaves some grease and dust on the ball, which lies higher and higher until a cloth is due."""
    between = int(rng.integers(11, 24))
    layer = np.mod(np.cumsum(placings(h)), between) / between
    return Cause(Change(target=moved(layer, h.normals[h.pointings.target])), "targets", CLOCK)


def adaptor_constant_is_changed_one_row_late(h: Hall, rng: Draw) -> Cause:
    """Nests of each group have another adaptor, and the first reading of a group is corrected for the one before."""
    constant = np.zeros(len(h.targets))
    for members in h.groups.values():
        constant[members] = rng.standard_normal()
    late = -h.since_before(constant[h.pointings.target])
    return Cause(reading(h, 0, late), "distance", (*TURN, "order", "target"), ("distance",))


# Columns of the recording


def lens_is_pinched_by_its_cell_when_it_is_cool(h: Hall, rng: Draw) -> Cause:
    """Below a certain warmth the cell is tighter than the lens, and shifts it more with every tenth of a degree."""
    warmth = h.columns[WARMTH]
    pinch = np.maximum(np.quantile(warmth, rng.uniform(0.4, 0.7)) - warmth, 0.0)
    return Cause(vary(h, "beam-offset-vertical", pinch), "vertical-offset", WARM)


def tie_rod_of_the_press_pulls_at_the_wall(h: Hall, rng: Draw) -> Cause:
    """The frame of the press is tied to the wall, which gives way round the anchor."""
    load, anchor = h.load, h.pointings.points[rng.choice(h.groups["wall"])]
    targets, inside = group(h, "wall")
    gives = bell(np.hypot(*(aims(h) - anchor)[:, 1:].T), rng.uniform(0.8, 1.6))
    change = Change(target=moved(inside * load * gives, OUT))
    return Cause(change, "targets", (LOAD, "load", "time"), targets=targets, place="wall")


# One of two trackers


def receiver_of_one_tracker_switches_its_gain(h: Hall, rng: Draw) -> Cause:
    """Beyond a distance it takes the high gain, and keeps it until the target is a good deal nearer."""
    name, here = one_tracker(h, rng)
    distance = h.pointings.seen[:, 0]
    low, high = np.quantile(distance, [rng.uniform(0.25, 0.4), rng.uniform(0.55, 0.7)])
    change = reading(h, 0, here * latched(h, distance, float(low), float(high)))
    return Cause(change, "distance", ("distance", "range", *TURN), ("distance",), place=name)


def cooling_fan_in_one_tracker_unsettles_its_index(h: Hall, rng: Draw) -> Cause:
    """The fan starts by itself and blows on the holder of a read head until the box is cool."""
    name, here = one_tracker(h, rng)
    return Cause(vary(h, "vertical-index", here * windows(h, rng)), "vertical-index", CLOCK, place=name)


LAWS = named(
    telescope_warps_with_the_work_of_the_motors,
    trunnion_takes_another_seat_at_each_carrying,
    sun_from_a_skylight_pushes_the_circle_aside,
    lamp_near_the_line_of_sight_draws_the_spot,
    head_nods_when_it_brakes_from_a_wide_swing,
    polished_floor_mirrors_a_second_ray,
    levelling_of_an_air_sprung_stand_hunts,
    bridge_crane_presses_its_bay_of_the_floor_down,
    cover_of_a_pit_tips_under_who_carries_the_ball,
    wind_bellies_a_sheet_metal_wall_while_a_door_is_open,
    table_is_nudged_round_whenever_a_ball_is_set_on_it,
    ground_water_tips_the_slab_beyond_the_joint,
    cold_air_from_the_gate_lies_on_the_floor,
    beams_bend_while_the_floor_lags_behind_the_warming_air,
    oil_mist_over_a_lathe_roughens_ranges,
    servo_trembles_where_the_telescope_is_in_balance,
    ranges_roughen_as_the_battery_runs_down,
    air_temperature_is_typed_in_once_an_hour,
    dust_gathers_on_the_ball_until_it_is_wiped,
    adaptor_constant_is_changed_one_row_late,
    lens_is_pinched_by_its_cell_when_it_is_cool,
    tie_rod_of_the_press_pulls_at_the_wall,
    receiver_of_one_tracker_switches_its_gain,
    cooling_fan_in_one_tracker_unsettles_its_index,
)
