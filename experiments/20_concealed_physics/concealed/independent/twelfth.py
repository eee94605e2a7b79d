"""A twelfth set of laws in no catalogue, written by one who had not seen how causes are looked for.

Things loosen, stick, are dragged or driven over, get cold, slip by a line, or were not there yet when they were wanted.
"""

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
    circle,
    decaying,
    group,
    lagging,
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
from .hall import LOAD, SIZE, Hall
from .tracker import Array, Change, within_a_turn

PRESSED = (LOAD, "load", "time")
"""Words for what follows the press."""
PLUNGE = 3.0
"""[rad] A head that turned by more was turned round for the other face."""
SECTORS = 24


def stuck(values: Array, most: float, loose: Array) -> Array:
    """(n,) Values as a thing has them that holds fast until it is off by the most, then jumps; set where loose."""
    found, at = np.empty(len(values)), float(values[0])
    for i, (value, free) in enumerate(zip(values.tolist(), loose.tolist(), strict=True)):
        at = value if free or abs(value - at) > most else at
        found[i] = at
    return found


def visits(h: Hall) -> Array:
    """(n,) Rounds that were made before, of this set-up and of those before it."""
    return np.asarray(h.pointings.station * h.pointings.repeat.max() + h.pointings.repeat - 1, dtype=np.float64)


def heights(h: Hall) -> tuple[Array, Array]:
    """(n,) [m] Above the floor, of the tracker and of the target."""
    return h.pointings.position[h.pointings.station, 2], aims(h)[:, 2]


# Constants of the tracker that do not stay.


def a_lens_cell_holds_fast_in_its_tube_and_jumps(h: Hall, rng: Draw) -> Cause:
    """Tilting drags the cell along the tube; friction keeps it where it is until the tube has tilted enough."""
    most = rng.uniform(0.25, 0.5)
    cell = stuck(h.pointings.seen[:, 2], most, h.turn_of_work == 0)
    drivers = ("elevation", "height", *TURN)
    return Cause(vary(h, "beam-offset-vertical", cell), "vertical-offset", drivers, ("elevation",))


def the_motor_of_the_head_warms_one_side_of_its_circle(h: Hall, rng: Draw) -> Cause:
    """Every turn of the head leaves heat beside the hub, and the disk runs off its middle until that has gone."""
    heat = decaying(h, np.abs(swing(h)), rng.uniform(150.0, 600.0))
    side = str(rng.choice(["azimuth-eccentricity-cos", "azimuth-eccentricity-sin"]))
    return Cause(vary(h, side, heat), "eccentricity", (*TURN, *CLOCK, "azimuth"), ("azimuth",))


def the_oscillator_loses_its_lock_when_the_press_pulls_the_mains_down(h: Hall, rng: Draw) -> Cause:
    """The clock of the ranger runs free once the mains sag, and locks again only when they have come up well."""
    free = latched(h, h.load, rng.uniform(0.15, 0.35), rng.uniform(0.6, 0.85))
    return Cause(vary(h, "range-scale", free), "distance", (*PRESSED, "distance", "range"), ("distance",))


# Errors that follow where the head looks.


def the_skirt_of_the_head_rides_over_a_bolt_when_it_stoops(h: Hall, rng: Draw) -> Cause:
    """Somewhere round the base a bolt stands proud; the fork, nodding down, rests on it and is held aside."""
    off = within_a_turn(circle(h) - rng.uniform(-np.pi, np.pi)) / rng.uniform(0.4, 0.8)
    stoop = 1.0 / (1.0 + np.exp((h.pointings.seen[:, 2] - rng.uniform(-0.1, 0.25)) / 0.06))
    return Cause(reading(h, 1, np.exp(-(off**2)) * stoop), "azimuth", ("azimuth", "elevation"), ("azimuth",))


def a_polished_floor_gives_the_beam_a_second_way(h: Hall, rng: Draw) -> Cause:
    """Light that went by the floor comes late and mixes in, the more the flatter it struck."""
    here, there = heights(h)
    arm = h.pointings.arm
    away = np.hypot(arm[:, 0], arm[:, 1])
    detour = np.hypot(away, here + there) - h.pointings.seen[:, 0]
    flat = np.exp(-np.arctan2(here + there, away) / rng.uniform(0.3, 0.7))
    wave = np.cos(2 * np.pi * (detour / rng.uniform(0.8, 2.0) + rng.random()))
    drivers = ("height", "elevation", "distance", "range", "floor")
    return Cause(reading(h, 0, flat * wave), "distance", drivers, ("distance",))


# Air.


def cold_air_from_the_gate_fills_the_hall_from_the_floor(h: Hall, rng: Draw) -> Cause:
    """The gate was open for a while: a cold lake rose over the floor, and drained; beams are counted in it too long."""
    time, whole = h.pointings.time, h.pointings.time[-1]
    opened, open_for = rng.uniform(0.15, 0.5) * whole, rng.uniform(0.15, 0.35) * whole
    filled = 1.0 - np.exp(-np.clip(time - opened, 0.0, open_for) / (0.4 * open_for))
    drained = np.exp(-np.maximum(time - opened - open_for, 0.0) / (rng.uniform(0.05, 0.2) * whole))
    lake = rng.uniform(1.6, 3.2) * filled * drained
    ends = np.stack(heights(h))
    low, high = ends.min(axis=0), ends.max(axis=0)
    under = np.clip((lake - low) / np.maximum(high - low, 1e-3), 0.0, 1.0)
    drivers = (*CLOCK, "height", "elevation", "distance", "range")
    return Cause(reading(h, 0, h.pointings.seen[:, 0] * under), "distance", drivers, ("distance",))


def the_thermometer_of_the_air_shows_coarse_steps_alone(h: Hall, rng: Draw) -> Cause:
    """The index of the air is reckoned from a warmth that is rounded, and long ways are off by what was rounded off."""
    step, first = rng.uniform(0.35, 0.7), rng.random()
    shown = step * (np.round(h.warmth / step + first) - first)
    amount = h.pointings.seen[:, 0] * (shown - h.warmth)
    return Cause(reading(h, 0, amount), "distance", (*WARM, "distance", "range"), ("distance",))


# What was measured before.


def the_amplifier_is_late_when_the_next_target_is_much_farther(h: Hall, rng: Draw) -> Cause:
    """From near to far the gain has to be turned up, and the first range is read before it has been; never back."""
    farther = h.since_before(np.log(h.pointings.seen[:, 0]))
    amount = np.maximum(farther - rng.uniform(0.0, 0.15), 0.0) ** rng.uniform(0.7, 1.3)
    return Cause(reading(h, 0, amount), "distance", (*TURN, "distance", "range"), ("distance",))


def the_track_is_stiff_where_no_roller_has_run_since_the_break(h: Hall, rng: Draw) -> Cause:
    """Grease sets in the breaks: the head stops short in each sector that it comes to for the first time."""
    sector = np.floor((circle(h) / (2 * np.pi) + rng.random()) * SECTORS).astype(np.int64) % SECTORS
    fresh, run = np.zeros(len(sector)), set[int]()
    for i, (place, first) in enumerate(zip(sector.tolist(), (h.turn_of_work == 0).tolist(), strict=True)):
        run = set() if first else run
        fresh[i] = place not in run
        run.add(place)
    turn = swing(h)
    short = -np.sign(turn) * (np.abs(turn) < PLUNGE) * fresh
    return Cause(reading(h, 1, short), "azimuth", (*TURN, *CLOCK, "azimuth"), ("azimuth",))


def the_encoder_hands_out_a_share_of_its_last_value_now_and_then(h: Hall, rng: Draw) -> Cause:
    """A buffer that overflows at every so many readings still holds some of the elevation before."""
    count = int(rng.choice([3, 5, 7]))
    held = np.arange(len(h.pointings)) % count == rng.integers(count)
    stale = -h.since_before(h.pointings.seen[:, 2]) * held
    return Cause(reading(h, 2, stale), "elevation", (*TURN, "order", "elevation"), ("elevation",))


# Stands.


def the_stand_gives_way_under_an_arm_that_rests_on_it_for_low_targets(h: Hall, rng: Draw) -> Cause:
    """Whoever looks for a low target stoops and leans on the stand, from the side where there is room."""
    axes = np.stack([level(rng) for _ in h.stations])
    stoops = np.maximum(rng.uniform(-0.15, 0.0) - h.pointings.seen[:, 2], 0.0) ** rng.uniform(0.3, 1.0)
    turn = MICRO * stoops[:, None] * axes[h.pointings.station]
    return Cause(Change(turn=turn), "station", ("elevation", "height", "floor"))


def the_floor_bends_under_a_crane_that_drives_to_and_fro(h: Hall, rng: Draw) -> Cause:
    """A crane goes up and down the hall, and every stand leans towards where it is, most when it is not quite near."""
    trip = rng.uniform(1100.0, 2800.0)
    crane = SIZE[0] * np.abs(1.0 - 2.0 * np.mod(h.pointings.time / trip + rng.random(), 1.0))
    off = (h.pointings.position[h.pointings.station, 0] - crane) / rng.uniform(2.0, 4.0)
    dip = np.exp(-(off**2))
    lean = np.column_stack([rng.uniform(0.3, 0.8) * dip, -2.0 * off * dip, np.zeros(len(dip))])
    return Cause(Change(turn=MICRO * lean), "station", CLOCK)


def one_foot_of_the_stand_is_hammered_into_the_floor(h: Hall, rng: Draw) -> Cause:
    """While the press works hard one foot goes down, and it stays down until the stand is set up again."""
    hard = np.maximum(h.load - rng.uniform(0.3, 0.6), 0.0) * np.diff(h.pointings.time, prepend=0.0)
    gone = np.cumsum(np.where(h.turn_of_work > 0, hard, 0.0))
    gone = (gone - gone[h.starts])[:, None] / 100.0
    axes = np.stack([level(rng) for _ in h.stations])[h.pointings.station]
    arm = rng.uniform(0.4, 0.7)
    return Cause(
        Change(station=-MICRO * gone / 3.0 * UP, turn=MICRO * gone / arm * axes), "station", (*PRESSED, "order")
    )


def the_plate_under_one_tracker_has_play_and_a_hard_turn_kicks_it(h: Hall, rng: Draw) -> Cause:
    """A plate that was not clamped well jumps by its play against a long turn of the head; short ones leave it."""
    name, here = one_station(h, rng)
    turn, hard = swing(h), rng.uniform(0.8, 1.4)
    kicked = latched(h, np.where(np.abs(turn) < PLUNGE, turn, 0.0), -hard, hard)
    return Cause(Change(turn=MICRO * (here * kicked)[:, None] * UP), "yaw", TURN, (), (name,))


# Targets that move together.


def wall_nests_are_ground_by_every_seating(h: Hall, rng: Draw) -> Cause:
    """The magnets of the wall pull the ball in hard: each visit grinds its seat, the first ones most."""
    names, there = group(h, "wall")
    soft = rng.uniform(0.3, 1.7, len(h.targets))[h.pointings.target]
    sunk = there * soft * (1.0 - np.exp(-visits(h) / rng.uniform(1.5, 5.0)))
    move = -MICRO * sunk[:, None] * h.normals[h.pointings.target]
    return Cause(Change(target=move), "targets", (*CLOCK, "repeat", "station", "visit"), (), (), names)


def the_wall_buckles_in_an_s_while_the_fan_sucks(h: Hall, rng: Draw) -> Cause:
    """An exhaust fan draws the lower panels in and lets the upper ones out; the hall takes minutes to fill again."""
    names, there = group(h, "wall")
    sucked = lagging(h, windows(h, rng), rng.uniform(100.0, 400.0))
    shape = np.sin(2 * np.pi * (aims(h)[:, 2] / rng.uniform(4.2, 5.0) + rng.uniform(-0.08, 0.08)))
    move = MICRO * (there * sucked * shape)[:, None] * OUT
    return Cause(Change(target=move), "targets", CLOCK, (), (), names)


def the_gallery_sticks_on_its_bearings_and_lets_go(h: Hall, rng: Draw) -> Cause:
    """It would grow with the warmth, but friction holds its far end until the strain is too much, and it jumps."""
    names, there = group(h, "gallery")
    grown = stuck(h.warmth, rng.uniform(0.25, 0.5), np.arange(len(h.pointings)) == 0)
    fixed = rng.choice([0.0, SIZE[0]])
    along = (aims(h)[:, 0] - fixed) / SIZE[0]
    move = MICRO * (there * grown * along)[:, None] * OUT
    return Cause(Change(target=move), "targets", (*WARM, "order"), (), (), names)


def the_table_has_two_pallets_that_take_turns(h: Hall, rng: Draw) -> Cause:
    """After each round the pallets change places, and the other one lies turned and tipped by what its pins allow."""
    names, there = group(h, "table")
    other = there * np.mod(visits(h), 2.0)
    arm = aims(h) - h.pointings.points[h.groups["table"]].mean(axis=0)
    about = rng.choice([-1.0, 1.0]) * UP + rng.uniform(0.3, 0.9) * level(rng)
    move = MICRO * other[:, None] * np.cross(about, arm)
    return Cause(Change(target=move), "targets", (*CLOCK, "repeat", "station", "visit"), (), (), names)


# Scatter.


def beams_flicker_that_pass_over_a_kettle(h: Hall, rng: Draw) -> Cause:
    """Somewhere in the hall steam goes up, and directions scatter the more the nearer a beam comes to it."""
    kettle = rng.uniform([3.0, 2.0], [8.0, 5.0])
    start = h.pointings.position[h.pointings.station, :2]
    way = h.pointings.arm[:, :2]
    along = np.clip(((kettle - start) * way).sum(axis=1) / (way**2).sum(axis=1), 0.0, 1.0)
    miss = np.hypot(*(start + along[:, None] * way - kettle).T) / rng.uniform(0.6, 1.3)
    more = np.exp(-(miss**2))[:, None] * np.array([0.0, 1.0, 1.0])
    drivers = ("azimuth", "station", "target", "place", "path")
    return Cause(Change(variance=more), "noise", drivers, ("azimuth", "elevation"))


def the_press_shakes_the_hall_while_it_opens(h: Hall, rng: Draw) -> Cause:
    """The valve that lets the oil back rattles: directions scatter while the load falls, and only then."""
    falls = np.maximum(-h.since_before(h.load), 0.0) > rng.uniform(0.002, 0.01)
    more = falls[:, None] * np.array([0.0, 1.0, rng.uniform(0.5, 1.5)])
    return Cause(Change(variance=more), "noise", PRESSED, ("azimuth", "elevation"))


# One of two trackers.


def one_laser_hops_between_modes_until_it_has_run_a_while(h: Hall, rng: Draw) -> Cause:
    """It is switched off in the breaks, and its ranges scatter at the beginning of every set-up."""
    name, here = one_tracker(h, rng)
    run = h.pointings.time - h.pointings.time[h.starts]
    more = here * np.exp(-run / rng.uniform(250.0, 700.0))
    change = Change(variance=more[:, None] * np.array([1.0, 0.0, 0.0]))
    return Cause(change, "noise", CLOCK, ("distance",), (), (), name)


def the_glass_of_one_elevation_circle_is_cracked(h: Hall, rng: Draw) -> Cause:
    """Past the crack its lines lie too far on, and closer again farther up; the back face uses the sound half."""
    name, here = one_tracker(h, rng)
    past = h.pointings.seen[:, 2] - rng.uniform(-0.15, 0.15)
    amount = here * (h.pointings.face == 1) * (past > 0.0) * np.exp(-np.maximum(past, 0.0) / rng.uniform(0.2, 0.6))
    return Cause(reading(h, 2, amount), "elevation", ("elevation", "face"), ("elevation",), (), (), name)


# Books and programs.


def the_list_of_balls_slipped_by_a_line_at_one_station(h: Hall, rng: Draw) -> Cause:
    """Balls of three makes lie in the nests, and at one set-up each was taken for the make of the next line."""
    name, here = one_station(h, rng)
    radii, make = rng.permutation([-1.0, 0.2, 0.8]) + rng.normal(0.0, 0.1, 3), h.pointings.target % 3
    move = MICRO * (here * (radii[(make + 1) % 3] - radii[make]))[:, None] * h.normals[h.pointings.target]
    return Cause(Change(target=move), "targets", ("station", "target", "list"), (), (name,))


def the_program_straightens_beams_of_the_back_face_the_wrong_way(h: Hall, rng: Draw) -> Cause:
    """What beams sag on long ways is taken off, but the sign was forgotten where the tracker looks over its back."""
    back = h.pointings.face == 2
    if not back.any():
        raise LookupError("one face only")
    away = h.pointings.seen[:, 0] * np.cos(h.pointings.seen[:, 2])
    amount = back * away ** rng.uniform(1.0, 2.0)
    return Cause(reading(h, 2, amount), "elevation", ("distance", "range", "face"), ("elevation",))


LAWS = named(
    a_lens_cell_holds_fast_in_its_tube_and_jumps,
    the_motor_of_the_head_warms_one_side_of_its_circle,
    the_oscillator_loses_its_lock_when_the_press_pulls_the_mains_down,
    the_skirt_of_the_head_rides_over_a_bolt_when_it_stoops,
    a_polished_floor_gives_the_beam_a_second_way,
    cold_air_from_the_gate_fills_the_hall_from_the_floor,
    the_thermometer_of_the_air_shows_coarse_steps_alone,
    the_amplifier_is_late_when_the_next_target_is_much_farther,
    the_track_is_stiff_where_no_roller_has_run_since_the_break,
    the_encoder_hands_out_a_share_of_its_last_value_now_and_then,
    the_stand_gives_way_under_an_arm_that_rests_on_it_for_low_targets,
    the_floor_bends_under_a_crane_that_drives_to_and_fro,
    one_foot_of_the_stand_is_hammered_into_the_floor,
    the_plate_under_one_tracker_has_play_and_a_hard_turn_kicks_it,
    wall_nests_are_ground_by_every_seating,
    the_wall_buckles_in_an_s_while_the_fan_sucks,
    the_gallery_sticks_on_its_bearings_and_lets_go,
    the_table_has_two_pallets_that_take_turns,
    beams_flicker_that_pass_over_a_kettle,
    the_press_shakes_the_hall_while_it_opens,
    one_laser_hops_between_modes_until_it_has_run_a_while,
    the_glass_of_one_elevation_circle_is_cracked,
    the_list_of_balls_slipped_by_a_line_at_one_station,
    the_program_straightens_beams_of_the_back_face_the_wrong_way,
)
