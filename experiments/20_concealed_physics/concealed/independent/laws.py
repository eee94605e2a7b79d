"""The sixth set of laws that are in no catalogue: 24 causes, what each turns or moves, what that follows, and where."""

from __future__ import annotations

import numpy as np

from .cause import MICRO, OUT, UP, Cause, Draw, group, level, named, one_station, reading, vary, walk, windows
from .hall import LOAD, WARMTH, Hall
from .tracker import Change, within_a_turn

# Range


def detector_memory(h: Hall, rng: Draw) -> Cause:
    """The detector's gain is slow: after a far target the light of a near one is too bright for a while."""
    amount = h.since_before(np.log(h.pointings.seen[:, 0]))
    return Cause(reading(h, 0, amount), "distance", ("move", "before", "approach", "distance"), ("distance",))


def compressor(h: Hall, rng: Draw) -> Cause:
    """A compressor runs for a part of every half hour, and its motor's field offsets the phase meter."""
    return Cause(reading(h, 0, windows(h, rng)), "distance", ("time",), ("distance",))


def faint_light(h: Hall, rng: Draw) -> Cause:
    """The phase meter reads strong light longer than weak light: the error falls with the light, by 1/d2."""
    return Cause(reading(h, 0, (h.pointings.seen[:, 0] / 3.0) ** -2.0), "distance", ("distance",), ("distance",))


def bent_meter_of_one(h: Hall, rng: Draw) -> Cause:
    """The meter of the second tracker is bent: its ranges err with the square of their distance from 5 m."""
    mine = h.pointings.tracker == 1
    amount = mine * (h.pointings.seen[:, 0] - 5.0) ** 2
    at = tuple(np.array(h.stations)[np.unique(h.pointings.station[mine])])
    return Cause(
        reading(h, 0, amount), "distance", ("distance",), ("distance",), at, place=f"instrument {h.trackers[1]}"
    )


def mode_hops(h: Hall, rng: Draw) -> Cause:
    """The laser hops between two modes at times nobody knows, and the zero of the ranges with it."""
    hops = np.sort(rng.uniform(h.pointings.time[0], h.pointings.time[-1], int(rng.integers(5, 12))))
    high = np.searchsorted(hops, h.pointings.time) % 2
    return Cause(reading(h, 0, high.astype(np.float64)), "distance", ("time", "jumps"), ("distance",))


# Azimuth


def cable_wind_up(h: Hall, rng: Draw) -> Cause:
    """The head winds its cable round the column: its pull grows with the turns made since the set-up."""
    amount = np.tanh(h.wound / rng.uniform(4.0, 9.0))
    return Cause(reading(h, 1, amount), "azimuth", ("order", "wound", "turn", "approach", "azimuth"), ("azimuth",))


def stiff_grease(h: Hall, rng: Draw) -> Cause:
    """The bearing's grease is stiff after the move to a new set-up and turns soft with use, pointing by pointing."""
    amount = 1.0 / (1.0 + h.turn_of_work / rng.uniform(2.0, 8.0))
    return Cause(reading(h, 1, amount), "azimuth", ("order", "time"), ("azimuth",))


def scratched_circle(h: Hall, rng: Draw) -> Cause:
    """The circle has a scratch: along a sector the error climbs, and at its end it falls back at once."""
    width, start = rng.uniform(0.4, 1.2), rng.uniform(-np.pi, np.pi)
    along = np.mod(h.pointings.readings()[:, 1] - start, 2 * np.pi) / width
    return Cause(reading(h, 1, np.where(along < 1, along, 0.0)), "azimuth", ("azimuth",), ("azimuth",))


# Elevation


def hose_at_its_stop(h: Hall, rng: Draw) -> Cause:
    """A hose reaches its stop when the scope looks up, and pulls the harder the farther up it looks."""
    limit = np.quantile(h.pointings.seen[:, 2], rng.uniform(0.4, 0.7))
    amount = np.maximum(h.pointings.seen[:, 2] - limit, 0.0) ** 1.5
    return Cause(reading(h, 2, amount), "elevation", ("elevation",), ("elevation",))


def thermostat(h: Hall, rng: Draw) -> Cause:
    """The cabinet's heater goes on and off by its thermostat, and the scope bends to and fro with a lag."""
    period, late = rng.uniform(500.0, 1500.0), rng.uniform(0.1, 0.3)
    phase = np.mod(h.pointings.time / period + rng.random(), 1.0)
    up, down = 1 - np.exp(-phase / late), np.exp(-(phase - 0.5) / late)
    return Cause(reading(h, 2, np.where(phase < 0.5, up, down)), "elevation", ("time",), ("elevation",))


def loose_clamp(h: Hall, rng: Draw) -> Cause:
    """The clamp of the elevation circle's head is loose: with every move it slips a little, this way or that."""
    return Cause(reading(h, 2, walk(h, rng)), "elevation", ("time", "order", "walk"), ("elevation",))


def index_of_one_with_warmth(h: Hall, rng: Draw) -> Cause:
    """The second tracker has no compensation: its vertical index follows the warmth of the hall."""
    mine = h.pointings.tracker == 1
    at = tuple(np.array(h.stations)[np.unique(h.pointings.station[mine])])
    change = vary(h, "vertical-index", mine * h.warmth)
    return Cause(
        change,
        "vertical-index",
        (WARMTH, "temperature", "time"),
        ("elevation",),
        at,
        place=f"instrument {h.trackers[1]}",
    )


# Constants of the tracker


def laser_tires(h: Hall, rng: Draw) -> Cause:
    """The glue of a prism creeps under its spring: the beam's tilt runs off with the logarithm of the time."""
    since = h.pointings.time - h.pointings.time[0]
    amount = np.log1p(since / rng.uniform(300.0, 1200.0))
    return Cause(vary(h, "beam-tilt", amount), "beam-tilt", ("time",), ("azimuth",))


def trunnion_with_warmth(h: Hall, rng: Draw) -> Cause:
    """One of the two uprights is nearer to the motor: the transit axis tips as the hall gets warmer."""
    return Cause(vary(h, "transit-tilt", h.warmth), "transit-tilt", (WARMTH, "temperature", "time"), ("azimuth",))


# Poses


def floor_under_a_press(h: Hall, rng: Draw) -> Cause:
    """A press stands on the slab of one station; as its load comes and goes, the slab and the station lean."""
    name, here = one_station(h, rng)
    turn = MICRO * (here * h.load)[:, None] * level(rng)
    return Cause(Change(turn=turn), "station", (LOAD, "load", "time"), stations=(name,), place=name)


def sun_on_a_tripod(h: Hall, rng: Draw) -> Cause:
    """The sun comes through a window for part of a set-up and turns the tripod, which cools down afterwards."""
    name, here = one_station(h, rng)
    times = h.pointings.time[here > 0]
    start, width = rng.uniform(times[0], times[-1]), rng.uniform(0.2, 0.5) * np.ptp(times)
    amount = here * np.exp(-(((h.pointings.time - start) / width) ** 2))
    return Cause(
        Change(turn=MICRO * amount[:, None] * UP), "yaw", ("time",), ("azimuth",), stations=(name,), place=name
    )


def sinking_slab(h: Hall, rng: Draw) -> Cause:
    """A crane passes a few times, and each time whatever stands on the slab at that moment sinks by a step."""
    passes = np.sort(rng.uniform(h.pointings.time[0], h.pointings.time[-1], 6))
    steps = np.zeros(len(h.pointings))
    for s in range(len(h.stations)):
        here = h.pointings.station == s
        steps[here] = np.searchsorted(passes, h.pointings.time[here])
        steps[here] -= steps[here].min()
    return Cause(Change(station=-MICRO * steps[:, None] * UP), "station", ("time", "jumps"))


def weak_leg(h: Hall, rng: Draw) -> Cause:
    """One stand is weak in one direction: the head, out of balance, pushes it there and back as it turns."""
    name, here = one_station(h, rng)
    weak = level(rng)
    beam = h.pointings.arm / np.sqrt((h.pointings.arm**2).sum(axis=1))[:, None]
    shift = MICRO * (here * (beam @ weak))[:, None] * weak
    return Cause(Change(station=shift), "station", ("azimuth",), stations=(name,), place=name)


# Targets


def wall_as_a_door(h: Hall, rng: Draw) -> Cause:
    """A light wall leans about its foot as the hall gets warmer: its reflectors move by their height."""
    names, here = group(h, "wall")
    height = h.pointings.points[h.pointings.target, 2]
    moved = MICRO * (here * height * h.warmth)[:, None] * OUT
    return Cause(Change(target=moved), "targets", (WARMTH, "temperature", "time"), targets=names, place="wall")


def table_tips(h: Hall, rng: Draw) -> Cause:
    """The table of a machine tips under its load: the reflectors on it sink by their distance from its edge."""
    names, here = group(h, "table")
    across = h.pointings.points[h.pointings.target, 0] - h.pointings.points[h.groups["table"], 0].min()
    moved = -MICRO * (here * across * h.load**2)[:, None] * UP
    return Cause(Change(target=moved), "targets", (LOAD, "load", "time"), targets=names, place="table")


def lorry(h: Hall, rng: Draw) -> Cause:
    """A lorry stands in the hall for a while: the floor round it goes down in a bowl, and the reflectors with it."""
    names, here = group(h, "floor")
    start, stop = np.sort(rng.uniform(h.pointings.time[0], h.pointings.time[-1], 2))
    centre = h.pointings.points[rng.choice(h.groups["floor"])]
    gap = np.sqrt(((h.pointings.points - centre)[:, :2] ** 2).sum(axis=1))[h.pointings.target]
    stands = (h.pointings.time > start) & (h.pointings.time < stop)
    moved = -MICRO * (here * stands / (1 + (gap / 2.0) ** 2) ** 1.5)[:, None] * UP
    return Cause(Change(target=moved), "targets", ("time",), targets=names, place="floor")


def two_operators(h: Hall, rng: Draw) -> Cause:
    """Two operators take turns, set-up by set-up; one presses the ball into its nest, the other lets it hang."""
    second = (h.pointings.station % 2).astype(np.float64)
    moved = MICRO * second[:, None] * h.normals[h.pointings.target]
    return Cause(Change(target=moved), "targets", ("parity", "place", "order", "station"))


# Noise


def ringing_head(h: Hall, rng: Draw) -> Cause:
    """The head still rings when it reads: after a long turn the azimuth scatters more than after a short one."""
    share = np.abs(within_a_turn(h.since_before(h.pointings.seen[:, 1]))) / np.pi
    variance = np.zeros((len(h.pointings), 3))
    variance[:, 1] = share**2
    return Cause(Change(variance=variance), "noise", ("move", "before", "approach"), ("azimuth",))


def shaking_gallery(h: Hall, rng: Draw) -> Cause:
    """A gallery shakes while people walk on it, for part of every cycle: what hangs from it is never where it was."""
    names, here = group(h, "gallery")
    variance = np.repeat((here * windows(h, rng))[:, None], 3, axis=1)
    return Cause(Change(variance=variance), "noise", ("place", "time"), targets=names, place="gallery")


LAWS = named(
    detector_memory,
    compressor,
    faint_light,
    bent_meter_of_one,
    mode_hops,
    cable_wind_up,
    stiff_grease,
    scratched_circle,
    hose_at_its_stop,
    thermostat,
    loose_clamp,
    index_of_one_with_warmth,
    laser_tires,
    trunnion_with_warmth,
    floor_under_a_press,
    sun_on_a_tripod,
    sinking_slab,
    weak_leg,
    wall_as_a_door,
    table_tips,
    lorry,
    two_operators,
    ringing_head,
    shaking_gallery,
)
