"""A seventh set of 24 laws that are in no catalogue: readings, constants of the tracker, stations, targets, noise."""

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
    group,
    latched,
    level,
    named,
    one_station,
    one_tracker,
    reading,
    vary,
    windows,
)
from .hall import SIZE, Hall
from .tracker import Array, Change, within_a_turn


def laser_sweeps_its_modes(h: Hall, rng: Draw) -> Cause:
    """The tube warms up ever more slowly, its wavelength creeps and is caught again: lengths follow saw teeth."""
    minutes = h.pointings.time / 60.0
    phase = rng.uniform(2.0, 5.0) * np.log1p(minutes / rng.uniform(10.0, 30.0)) + rng.random()
    tooth = np.mod(phase, 1.0) - 0.5
    return Cause(reading(h, 0, h.pointings.seen[:, 0] / 2.0 * tooth), "distance", (*CLOCK, "distance"), ("distance",))


def receiver_changes_its_gain_late(h: Hall, rng: Draw) -> Cause:
    """The range receiver turns its gain up for a far reflector, and down again only for one that is much nearer."""
    middle, half = rng.uniform(3.0, 4.5), rng.uniform(0.4, 0.9)
    far = latched(h, h.pointings.seen[:, 0], middle - half, middle + half)
    return Cause(reading(h, 0, far), "distance", ("distance", *TURN), ("distance",))


def ghost_from_the_cover_glass(h: Hall, rng: Draw) -> Cause:
    """A reflex in the head beats with the return where the path fits the modulation: an error about one distance."""
    off = (h.pointings.seen[:, 0] - rng.uniform(2.5, 6.0)) / rng.uniform(0.2, 0.5)
    return Cause(reading(h, 0, 2.0 * off / (1.0 + off**2)), "distance", ("distance",), ("distance",))


def fingerprint_on_the_circle(h: Hall, rng: Draw) -> Cause:
    """Grease on the azimuth's circle pulls the reading first one way and then the other as its head passes by."""
    raw = h.pointings.seen[:, 1] + np.pi * (h.pointings.face == 2)
    off = within_a_turn(raw - rng.uniform(-np.pi, np.pi)) / rng.uniform(0.15, 0.35)
    return Cause(reading(h, 1, off * np.exp((1.0 - off**2) / 2.0)), "azimuth", ("azimuth",), ("azimuth",))


def long_swing_twists_the_mount(h: Hall, rng: Draw) -> Cause:
    """A swing longer than some angle is made at full speed and leaves the mount twisted until the head turns over."""
    turn = within_a_turn(h.since_before(h.pointings.seen[:, 1]))
    beyond = np.maximum(np.abs(turn) - rng.uniform(1.3, 1.9), 0.0) / rng.uniform(0.3, 0.8)
    return Cause(reading(h, 1, np.sign(turn) * np.tanh(beyond)), "azimuth", TURN, ("azimuth",))


def hose_rubs_on_the_back_face(h: Hall, rng: Draw) -> Cause:
    """With the head turned over a hose lies on the cover and drags, over a part of the circle."""
    if h.pointings.face.max() < 2:
        raise LookupError("one face only")
    drag = np.maximum(np.cos(h.pointings.seen[:, 1] - rng.uniform(-np.pi, np.pi)) - rng.uniform(-0.2, 0.4), 0.0)
    return Cause(reading(h, 1, drag * (h.pointings.face == 2)), "azimuth", ("azimuth", "face"), ("azimuth",))


def lamps_shine_into_the_camera(h: Hall, rng: Draw) -> Cause:
    """The lamps under the roof, while they are lit, draw the spot aside of a camera that looks up at them."""
    steep = np.clip((h.pointings.seen[:, 2] - rng.uniform(0.0, 0.3)) / rng.uniform(0.1, 0.4), 0.0, 1.0)
    drivers = ("elevation", "height", "z", *CLOCK)
    return Cause(reading(h, 2, steep * windows(h, rng)), "elevation", drivers, ("elevation",))


def counterweight_tips_over(h: Hall, rng: Draw) -> Cause:
    """A loose counterweight tips over when the tube has risen, and tips back only when it has come well down."""
    tipped = latched(h, h.pointings.seen[:, 2], rng.uniform(-0.25, 0.0), rng.uniform(0.2, 0.5))
    return Cause(reading(h, 2, tipped), "elevation", ("elevation", *TURN), ("elevation",))


def cold_air_from_the_gate(h: Hall, rng: Draw) -> Cause:
    """Whenever the gate opens cold air runs over the floor and warms up again: beams to low targets are bent."""
    p = h.pointings
    since = p.time[:, None] - rng.choice(p.time, 4, replace=False)
    cold = (np.exp(-np.maximum(since, 0.0) / rng.uniform(300.0, 900.0)) * (since >= 0.0)).sum(axis=1)
    low = np.clip(1.4 - p.points[p.target, 2], 0.0, 1.0)
    drivers = (*CLOCK, "height", "z", "place", "distance")
    return Cause(reading(h, 2, cold * low * p.seen[:, 0] / 4.0), "elevation", drivers, ("elevation",))


def loose_contact_in_the_tube(h: Hall, rng: Draw) -> Cause:
    """A contact of one tracker's elevation circle opens and closes at random: the reading has two states."""
    place, here = one_tracker(h, rng)
    flips = rng.random(len(h.pointings)) < rng.uniform(0.03, 0.1)
    state = np.mod(np.cumsum(flips), 2)
    return Cause(reading(h, 2, here * state), "elevation", CLOCK, ("elevation",), place=place)


def head_lags_behind_the_hall(h: Hall, rng: Draw) -> Cause:
    """The head takes up the hall's warmth slowly and bends the beam's seat by what it lags behind."""
    inside, wait = np.zeros(len(h.pointings)), 60.0 * rng.uniform(15.0, 50.0)
    inside[0] = h.warmth[0]
    for i, step in enumerate(np.diff(h.pointings.time)):
        inside[i + 1] = h.warmth[i + 1] + (inside[i] - h.warmth[i + 1]) * np.exp(-step / wait)
    lag = h.warmth - inside
    return Cause(vary(h, "beam-tilt", lag / np.abs(lag).max()), "beam-tilt", WARM, ("azimuth",))


def clamped_circle_shifts_with_warmth(h: Hall, rng: Draw) -> Cause:
    """The circle's centre wanders from the axis as the head warms up, until its clamp stops it on either side."""
    shift = np.tanh(h.warmth / rng.uniform(0.15, 0.4))
    name = str(rng.choice(["azimuth-eccentricity-cos", "azimuth-eccentricity-sin"]))
    return Cause(vary(h, name, shift), "eccentricity", (*WARM, "azimuth"), ("azimuth",))


def carried_on_its_side(h: Hall, rng: Draw) -> Cause:
    """One of the trackers travels on its side, and in every set-up its collimator creeps back to where it was."""
    place, here = one_tracker(h, rng)
    since = h.pointings.time - h.pointings.time[h.starts]
    creep = here * np.exp(-since / rng.uniform(120.0, 400.0))
    return Cause(vary(h, "beam-offset-vertical", creep), "vertical-offset", CLOCK, ("elevation",), place=place)


def level_sensor_moves_in_stairs(h: Hall, rng: Draw) -> Cause:
    """Readings are turned to the level by a sensor that sticks: with the hall's warmth it moves a stair at a time."""
    p = h.pointings
    stair = np.floor(h.warmth / rng.uniform(0.12, 0.3) + rng.random())
    return Cause(Change(turn=MICRO * stair[:, None] * (p.rotation[p.station] @ level(rng))), "station", WARM)


def loose_floor_plate(h: Hall, rng: Draw) -> Cause:
    """A tracker stands on a plate that rocks over a joist, by the weight of whoever holds a reflector near to it."""
    name, here = one_station(h, rng)
    arm, joist = h.pointings.arm, level(rng)
    near = np.exp(-(arm[:, 0] ** 2 + arm[:, 1] ** 2) / (2.0 * rng.uniform(1.5, 2.5) ** 2)) * (arm[:, 2] < 1.2)
    rock = here * near * (arm @ np.cross(joist, UP))
    drivers = ("place", "x", "y", "azimuth", "distance", "target")
    return Cause(Change(turn=MICRO * rock[:, None] * joist), "station", drivers, stations=(name,))


def vacuum_foot_is_pumped_up(h: Hall, rng: Draw) -> Cause:
    """A stand on a vacuum foot sinks as the foot leaks, until the pump starts and lifts it within a moment."""
    name, here = one_station(h, rng)
    phase = np.mod(h.pointings.time / rng.uniform(120.0, 400.0) + rng.random(), 1.0)
    sunk = here * (1.0 - np.exp(-rng.uniform(2.0, 5.0) * phase))
    return Cause(Change(station=-MICRO * sunk[:, None] * UP), "station", CLOCK, stations=(name,))


def press_bends_the_floor(h: Hall, rng: Draw) -> Cause:
    """Beyond a load the press sits down on the floor, and stands lean towards it, the near ones the most."""
    p = h.pointings
    excess = np.maximum(h.load - rng.uniform(0.3, 0.6), 0.0)
    way = (rng.choice([0.0, 1.0], 3) * SIZE - p.position[p.station]) * (1.0 - UP)
    lean = np.cross(UP, way) / (way**2).sum(axis=1, keepdims=True)
    return Cause(Change(turn=6.0 * MICRO * excess[:, None] * lean), "station", ("press_load_kn", "load", "time"))


def visitors_on_the_gallery(h: Hall, rng: Draw) -> Cause:
    """The gallery sags between its ends while a class of visitors stands on it."""
    names, inside = group(h, "gallery")
    along = h.pointings.points[h.pointings.target, 0] / SIZE[0]
    sag = inside * np.sin(np.pi * along) * windows(h, rng)
    return Cause(Change(target=-MICRO * sag[:, None] * UP), "targets", CLOCK, targets=names)


def leg_of_the_table_sinks(h: Hall, rng: Draw) -> Cause:
    """From some moment a leg of the table sinks into the floor, ever more slowly: the table turns about a diagonal."""
    names, inside = group(h, "table")
    corners = h.pointings.points[h.groups["table"][:4]]
    centre, pair = corners.mean(axis=0), [(1, 2), (0, 3)][int(rng.integers(2))]
    axis = (corners[pair[1]] - corners[pair[0]]) * rng.choice([-1.0, 1.0])
    moved = np.cross(axis / np.sqrt(axis @ axis), h.pointings.points[h.pointings.target] - centre)
    minutes = (h.pointings.time - rng.uniform(0.0, 0.5) * h.pointings.time[-1]) / 60.0
    turn = inside * np.sqrt(np.maximum(minutes, 0.0) / 60.0)
    return Cause(Change(target=MICRO * turn[:, None] * moved), "targets", CLOCK, targets=names)


def joint_of_the_slab_opens(h: Hall, rng: Draw) -> Cause:
    """The slab is cast in two; when it gets cold enough the joint opens, and the far part's targets slide away."""
    part = h.groups["floor"]
    x = h.pointings.points[:, 0]
    far = part[x[part] > np.quantile(x[part], rng.uniform(0.3, 0.6))]
    gap = np.maximum(np.quantile(h.warmth, rng.uniform(0.5, 0.8)) - h.warmth, 0.0) * np.isin(h.pointings.target, far)
    names = tuple(h.targets[t] for t in sorted(far))
    return Cause(Change(target=2.0 * MICRO * gap[:, None] * OUT), "targets", WARM, targets=names)


def two_reflectors_in_turn(h: Hall, rng: Draw) -> Cause:
    """Two operators set their reflectors by turns, and one of the balls is larger: its centre stands off further."""
    target, start = h.pointings.target, h.turn_of_work == 0
    visit = np.cumsum((np.diff(target, prepend=-1) != 0) | start)
    odd = np.mod(visit - visit[h.starts] + rng.integers(2), 2)
    return Cause(Change(target=MICRO * odd[:, None] * h.normals[target]), "targets", ("parity", "order"))


def servo_hunts_about_a_balance(h: Hall, rng: Draw) -> Cause:
    """Where the tube is nearly balanced its motor hunts: elevations scatter about one elevation as at a resonance."""
    off = (h.pointings.seen[:, 2] - rng.uniform(-0.2, 0.4)) / rng.uniform(0.08, 0.2)
    return _scatter(2, 4.0 / (1.0 + off**2), ("elevation",), ("elevation",))


def read_before_it_stands_still(h: Hall, rng: Draw) -> Cause:
    """After a wide swing and a short wait the head still swings when it is read: azimuths scatter."""
    swing = np.abs(within_a_turn(h.since_before(h.pointings.seen[:, 1])))
    wait = h.since_before(h.pointings.time)
    return _scatter(1, 4.0 * swing * np.exp(-wait / rng.uniform(6.0, 15.0)), (*TURN, "time"), ("azimuth",))


def weak_return_of_one_tracker(h: Hall, rng: Draw) -> Cause:
    """One tracker's beam is too wide: from a far reflector that looks aside little light returns, ranges scatter."""
    place, here = one_tracker(h, rng)
    p = h.pointings
    facing = -(h.normals[p.target] * p.arm).sum(axis=1) / p.seen[:, 0]
    loss = here * (1.0 - facing) * (p.seen[:, 0] / 4.0) ** 2
    return _scatter(0, 3.0 * loss, ("incidence", "distance"), ("distance",), place)


def _scatter(
    column: int, amount: Array, drivers: tuple[str, ...], observables: tuple[str, ...], place: str = "everywhere"
) -> Cause:
    """More variance (n,) of one reading, in units of what is stated."""
    variance = np.zeros((len(amount), 3))
    variance[:, column] = amount
    return Cause(Change(variance=variance), "noise", drivers, observables, place=place)


LAWS = named(
    laser_sweeps_its_modes,
    receiver_changes_its_gain_late,
    ghost_from_the_cover_glass,
    fingerprint_on_the_circle,
    long_swing_twists_the_mount,
    hose_rubs_on_the_back_face,
    lamps_shine_into_the_camera,
    counterweight_tips_over,
    cold_air_from_the_gate,
    loose_contact_in_the_tube,
    head_lags_behind_the_hall,
    clamped_circle_shifts_with_warmth,
    carried_on_its_side,
    level_sensor_moves_in_stairs,
    loose_floor_plate,
    vacuum_foot_is_pumped_up,
    press_bends_the_floor,
    visitors_on_the_gallery,
    leg_of_the_table_sinks,
    joint_of_the_slab_opens,
    two_reflectors_in_turn,
    servo_hunts_about_a_balance,
    read_before_it_stands_still,
    weak_return_of_one_tracker,
)
