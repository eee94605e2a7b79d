"""24 laws more, told by somebody who knows halls and trackers but not the search that is examined by them.

Three or so of each kind: constants of the tracker that vary, readings that follow the geometry or the history of the
work, stands, groups of targets, air, noise, slips of software, and one of two trackers. Amounts are at size one.
"""

from __future__ import annotations

import numpy as np

from .cause import (
    CLOCK,
    MICRO,
    TURN,
    UP,
    WARM,
    Cause,
    Draw,
    aims,
    backwards,
    circle,
    decaying,
    gap,
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


def _footing(h: Hall) -> Array:
    """(n, 3) [m] Where the tracker stands, in the room."""
    return np.asarray(h.pointings.position[h.pointings.station])


def _bearing(h: Hall) -> Array:
    """(n,) [rad] Where the head is turned to in the room: away from the target on the back face."""
    arm = h.pointings.arm
    return within_a_turn(np.arctan2(arm[:, 1], arm[:, 0]) + backwards(h))


def _along(rows: Array, direction: Array) -> Array:
    """(n, 3) Amounts (n,) in one direction."""
    return np.asarray(MICRO * rows[:, None] * direction)


def _visits(h: Hall) -> Array:
    """(n,) How often the ball was put into this nest before; both faces are one visit."""
    p, found, seen = h.pointings, np.empty(len(h.pointings)), dict[int, set[tuple[int, int]]]()
    for i, (t, s, k) in enumerate(zip(p.target.tolist(), p.station.tolist(), p.repeat.tolist(), strict=True)):
        mine = seen.setdefault(t, set())
        mine.add((s, k))
        found[i] = len(mine) - 1
    return found


# --- constants of the tracker that vary ---------------------------------------------------------------------------


def a_supply_line_once_taut_drags_at_the_trunnions(h: Hall, rng: Draw) -> Cause:
    """The hose to the head hangs slack until the head has wound it up, and then pulls the transit axis over."""
    slack = rng.uniform(0.6, 1.6)
    amount = np.sign(h.wound) * np.clip(np.abs(h.wound) - slack, 0.0, None)
    drivers = ("wound", "winding", "turn", "turns", "azimuth")
    return Cause(vary(h, "transit-tilt", amount), "transit-tilt", drivers, ("azimuth",))


def one_cheek_of_the_head_toasts_before_a_furnace(h: Hall, rng: Draw) -> Cause:
    """The cheek of the head that is turned to the furnace door grows warm, minutes late, and tilts the beam aside."""
    door, delay = rng.uniform(-np.pi, np.pi), rng.uniform(120.0, 420.0)
    shone_on = lagging(h, np.sin(_bearing(h) - door), delay)
    drivers = ("azimuth", "direction", "bearing", "before", "time", "order")
    return Cause(vary(h, "beam-tilt", shone_on), "beam-tilt", drivers, ("azimuth",))


def a_lens_slides_in_its_barrel_when_the_head_nods(h: Hall, rng: Draw) -> Cause:
    """A loose lens runs down the barrel when the beam looks steeply up, and back only when it looks down again."""
    nod = np.sin(h.pointings.seen[:, 2])
    up = latched(h, nod, rng.uniform(-0.15, 0.0), rng.uniform(0.25, 0.4))
    drivers = ("elevation", "height", *TURN)
    return Cause(vary(h, "beam-offset-vertical", up), "vertical-offset", drivers, ("elevation",))


# --- readings that follow the geometry ----------------------------------------------------------------------------


def a_polished_pillar_answers_with_an_echo(h: Hall, rng: Draw) -> Cause:
    """Light that comes back over a steel pillar beats with the range signal, the more the shorter its detour is."""
    foot = rng.uniform([2.5, 1.5], [8.5, 5.5])
    start, end = _footing(h)[:, :2], aims(h)[:, :2]
    rise = aims(h)[:, 2] - _footing(h)[:, 2]
    bent = np.sqrt(((start - foot) ** 2).sum(axis=1)) + np.sqrt(((end - foot) ** 2).sum(axis=1))
    detour = np.sqrt(bent**2 + rise**2) - h.pointings.seen[:, 0]
    wave = np.cos(2 * np.pi * detour / rng.uniform(0.7, 1.6) + rng.uniform(-np.pi, np.pi))
    amount = wave * np.exp(-detour / rng.uniform(0.8, 1.8))
    drivers = ("echo", "detour", "path", "place", "position", "direction", "azimuth")
    return Cause(reading(h, 0, amount), "distance", drivers, ("distance",))


def a_fibre_is_stretched_across_the_trunnion(h: Hall, rng: Draw) -> Cause:
    """The fibre through the transit axis has slack about its pose of rest; tilted farther, its light goes longer."""
    rest, slack = rng.uniform(-0.4, 0.9), rng.uniform(0.1, 0.35)
    elevation = h.pointings.seen[:, 2]
    tilted = np.where(h.pointings.face == 2, np.pi - elevation, elevation) - rest
    amount = np.clip(np.abs(tilted) - slack, 0.0, None) ** 2
    return Cause(reading(h, 0, amount), "distance", ("elevation", "vertical", "face"), ("distance",))


# --- readings that follow the history of the work -----------------------------------------------------------------


def the_glass_disc_skids_on_its_hub(h: Hall, rng: Draw) -> Cause:
    """In every long swing the heavy disc stays behind a little, more in one sense of turning than in the other."""
    turned, ease = swing(h), rng.uniform(0.2, 0.7)
    beyond = np.clip(np.abs(turned) - rng.uniform(0.5, 1.3), 0.0, None)
    skid = np.cumsum(beyond * np.where(turned > 0, 1.0, -ease))
    drivers = (*CLOCK, *TURN, "swing", "wound", "turn", "azimuth")
    return Cause(reading(h, 1, skid - skid[h.starts]), "azimuth", drivers, ("azimuth",))


def the_firmware_mends_its_zero_at_fixed_minutes(h: Hall, rng: Draw) -> Cause:
    """An oil level resets the index every some minutes, whatever is being measured; in between it runs off."""
    cycle = rng.uniform(500.0, 1300.0)
    share = np.mod(h.pointings.time + rng.uniform(0.0, cycle), cycle) / cycle
    return Cause(vary(h, "vertical-index", share ** rng.uniform(0.6, 1.6)), "vertical-index", CLOCK, ("elevation",))


def a_dazzled_receiver_needs_a_minute(h: Hall, rng: Draw) -> Cause:
    """Bright returns of the near targets before leave charges in the detector, and the range is read too long."""
    bright = (3.0 / h.pointings.seen[:, 0]) ** rng.uniform(1.0, 1.6)
    left = decaying(h, bright, rng.uniform(15.0, 50.0)) - bright
    return Cause(reading(h, 0, left), "distance", ("distance", "time", *TURN), ("distance",))


def grease_settles_about_the_balls_where_the_head_waited(h: Hall, rng: Draw) -> Cause:
    """The head waits on its first target until a set-up begins; ridges there push it until they are rolled flat."""
    waited = circle(h)[h.starts]
    away = within_a_turn(circle(h) - waited) / rng.uniform(0.4, 0.9)
    fresh = np.exp(-h.turn_of_work / rng.uniform(15.0, 40.0))
    amount = away * np.exp(-0.5 * away**2) * fresh
    drivers = ("azimuth", "direction", "before", *CLOCK)
    return Cause(reading(h, 1, amount), "azimuth", drivers, ("azimuth",))


# --- stands -------------------------------------------------------------------------------------------------------


def one_foot_stands_on_a_cable_duct(h: Hall, rng: Draw) -> Cause:
    """The lid of a duct gives under one foot of the stand, but only while the weight of the head hangs over it."""
    name, here = one_station(h, rng)
    foot = rng.uniform(-np.pi, np.pi)
    weight = np.clip(np.cos(_bearing(h) - foot) - rng.uniform(0.0, 0.4), 0.0, None)
    axis = np.array([-np.sin(foot), np.cos(foot), 0.0])
    drivers = ("azimuth", "direction", "bearing", "face")
    return Cause(Change(turn=_along(here * weight, axis)), "station", drivers, stations=(name,))


def a_bridge_crane_dents_the_slab_as_it_shuttles(h: Hall, rng: Draw) -> Cause:
    """The slab hangs down under the crane that goes to and fro; stands near it sink and lean towards it."""
    phase = 2 * np.pi * (h.pointings.time / rng.uniform(1300.0, 3600.0) + rng.random())
    crane = 0.5 * SIZE[0] * (1.0 + rng.uniform(0.5, 0.9) * np.sin(phase))
    width = rng.uniform(1.5, 3.0)
    off = (_footing(h)[:, 0] - crane) / width
    dent = np.exp(-0.5 * off**2)
    lean = _along(-off / width * dent, np.array([0.0, 1.0, 0.0]))
    return Cause(Change(station=_along(-dent, UP), turn=lean), "station", (*CLOCK, "position", "place"))


def the_raised_floor_bows_under_who_carries_the_ball(h: Hall, rng: Draw) -> Cause:
    """The stand leans along the joists to who puts the ball in; whoever is on the gallery does not load the floor."""
    joists, reach = level(rng), rng.uniform(1.5, 3.5)
    arm = h.pointings.arm
    near = 1.0 / (1.0 + (arm[:, 0] ** 2 + arm[:, 1] ** 2) / reach**2)
    amount = (1.0 - group(h, "gallery")[1]) * near * (arm @ joists)
    drivers = ("target", "position", "place", "direction", "distance", "azimuth")
    return Cause(Change(turn=_along(amount, np.cross(UP, joists))), "station", drivers)


# --- groups of targets --------------------------------------------------------------------------------------------


def glued_nests_bed_in_with_every_ball(h: Hall, rng: Draw) -> Cause:
    """Each time a ball snaps on, its nest on wall or gallery is pressed into the soft glue, first ones the most."""
    names, inside = zip(*(group(h, name) for name in ("wall", "gallery")), strict=True)
    soft = np.exp(rng.normal(0.0, 0.5, len(h.targets)))
    pressed = 1.0 - np.exp(-_visits(h) / rng.uniform(1.2, 3.0))
    amount = (inside[0] + inside[1]) * soft[h.pointings.target] * pressed
    change = -MICRO * amount[:, None] * h.normals[h.pointings.target]
    drivers = (*CLOCK, "visit", "visits", "station", "repeat", "before")
    return Cause(Change(target=change), "targets", drivers, targets=names[0] + names[1])


def a_tool_cart_waits_elsewhere_on_the_gallery(h: Hall, rng: Draw) -> Cause:
    """For every set-up the cart is left at another place of the gallery, and the boards hang down there."""
    names, inside = group(h, "gallery")
    cart = rng.uniform(1.0, 10.0, len(h.stations))[h.pointings.station]
    sag = np.exp(-0.5 * ((aims(h)[:, 0] - cart) / rng.uniform(1.0, 2.2)) ** 2)
    drivers = (*CLOCK, "station", "set", "setup")
    return Cause(Change(target=_along(-inside * sag, UP)), "targets", drivers, targets=names)


def the_table_wrings_when_the_press_bites(h: Hall, rng: Draw) -> Cause:
    """Only when the press bites hard does it pull at two opposite corners of the table, and wrings its top."""
    names, inside = group(h, "table")
    middle = h.pointings.points[h.groups["table"]].mean(axis=0)
    arm = aims(h) - middle
    bite = np.clip(h.load - rng.uniform(0.1, 0.5), 0.0, None)
    amount = inside * bite * (arm[:, 0] * arm[:, 1] + rng.uniform(-0.2, 0.2) * arm[:, 0])
    return Cause(Change(target=_along(amount, UP)), "targets", (LOAD, "load", "press", "time"), targets=names)


# --- air ----------------------------------------------------------------------------------------------------------


def helium_of_a_leak_test_gathers_under_the_roof(h: Hall, rng: Draw) -> Cause:
    """For a part of the day a leak test fills the roof with helium that light crosses faster, and it seeps away."""
    ground, top = _footing(h)[:, 2], aims(h)[:, 2]
    roof = rng.uniform(2.2, 3.2)
    within = np.clip((top - roof) / np.maximum(top - ground, 0.1), 0.0, 1.0) * h.pointings.seen[:, 0]
    share = h.pointings.time / h.pointings.time[-1]
    begin = rng.uniform(0.05, 0.5)
    open_valve = ((share > begin) & (share < begin + rng.uniform(0.2, 0.4))).astype(np.float64)
    amount = -within * lagging(h, open_valve, rng.uniform(400.0, 1800.0))
    drivers = (*CLOCK, "height", "elevation")
    return Cause(reading(h, 0, amount), "distance", drivers, ("distance",), place="under the roof")


def still_air_lies_in_sheets_until_a_gate_stirs_it(h: Hall, rng: Draw) -> Cause:
    """Level beams bend the more the longer the gate was shut; whenever it opens, the air is mixed at once."""
    times = h.pointings.time
    opened = np.sort(rng.uniform(-2000.0, times[-1], int(rng.integers(4, 9))))
    opened = np.concatenate([[-3000.0], opened])
    since = times - opened[np.searchsorted(opened, times, side="right") - 1]
    sheets = 1.0 - np.exp(-since / rng.uniform(600.0, 1800.0))
    across = h.pointings.seen[:, 0] * np.cos(h.pointings.seen[:, 2])
    return Cause(reading(h, 2, across * sheets), "elevation", (*CLOCK, "distance"), ("elevation",))


# --- noise --------------------------------------------------------------------------------------------------------


def forklifts_pass_through_the_beams_of_one_aisle(h: Hall, rng: Draw) -> Cause:
    """While goods are brought, beams over the aisle shiver in the exhaust: the longer they are in it, the more."""
    edge, width = rng.uniform(2.0, 7.5), rng.uniform(1.0, 1.8)
    ends = np.stack([_footing(h)[:, 0], aims(h)[:, 0]])
    low, high = ends.min(axis=0), ends.max(axis=0)
    inside = np.clip(np.minimum(high, edge + width) - np.maximum(low, edge), 0.0, None) / (high - low + 0.1)
    amount = windows(h, rng) * inside * h.pointings.seen[:, 0]
    variance = amount[:, None] * np.array([0.0, 1.0, 1.0])
    drivers = (*CLOCK, "path", "position", "place", "direction", "azimuth")
    return Cause(Change(variance=variance), "noise", drivers, ("azimuth", "elevation"), place="an aisle")


def a_hasty_reading_catches_the_head_still_swaying(h: Hall, rng: Draw) -> Cause:
    """On a soft stand the head sways after a swing; who presses the button too soon reads any azimuth of the sway."""
    amount = np.abs(swing(h)) * np.exp(-(gap(h) - 9.0) / rng.uniform(2.5, 6.0))
    variance = amount[:, None] * np.array([0.0, 1.0, 0.0])
    drivers = (*TURN, "swing", "gap", "pause", "time")
    return Cause(Change(variance=variance), "noise", drivers, ("azimuth",))


def lint_gathers_in_the_ball_until_it_is_wiped(h: Hall, rng: Draw) -> Cause:
    """The ball is wiped when a set-up begins; lint from every nest dims it, and weak light from afar scatters most."""
    lint = 1.0 - np.exp(-h.turn_of_work / rng.uniform(25.0, 90.0))
    variance = (lint * h.pointings.seen[:, 0] ** 2)[:, None] * np.array([1.0, 0.0, 0.0])
    return Cause(Change(variance=variance), "noise", (*CLOCK, "distance"), ("distance",))


# --- slips of software --------------------------------------------------------------------------------------------


def the_weather_log_is_not_on_summer_time(h: Hall, rng: Draw) -> Cause:
    """Ranges are corrected for the warmth that the log tells for the same clock, which was an hour or two before."""
    times = h.pointings.time
    then = np.interp(times - 3600.0 * int(rng.integers(1, 3)), times, h.warmth)
    amount = (h.warmth - then) * h.pointings.seen[:, 0]
    return Cause(reading(h, 0, amount), "distance", (*WARM, "order"), ("distance",))


def the_map_of_the_circle_is_read_one_line_late(h: Hall, rng: Draw) -> Cause:
    """A new release corrects each azimuth by what the maker's map says for the azimuth of the line before."""
    sizes, phases = rng.uniform(0.5, 1.0, 2), rng.uniform(-np.pi, np.pi, 2)
    told = sizes[0] * np.cos(circle(h) + phases[0]) + sizes[1] * np.cos(2 * circle(h) + phases[1])
    late = np.concatenate([told[:1], told[:-1]])
    return Cause(reading(h, 1, late - told), "azimuth", (*TURN, "azimuth", "order"), ("azimuth",))


# --- one of two trackers ------------------------------------------------------------------------------------------


def a_crystal_without_oven_warms_only_at_work(h: Hall, rng: Draw) -> Cause:
    """The clock of one tracker's range warms while it measures, and cools while the other does or nobody."""
    place, mine = one_tracker(h, rng)
    warm = lagging(h, mine * (h.turn_of_work > 0), rng.uniform(300.0, 1500.0))
    amount = mine * warm * h.pointings.seen[:, 0]
    return Cause(reading(h, 0, amount), "distance", (*CLOCK, "distance"), ("distance",), place=place)


def a_shard_of_a_cracked_circle_has_shifted(h: Hall, rng: Draw) -> Cause:
    """A knock cracked the glass circle of one tracker: where it reads on the shard, its lines are off and turned."""
    place, mine = one_tracker(h, rng)
    half = rng.uniform(0.5, 1.1)
    along = within_a_turn(circle(h) - rng.uniform(-np.pi, np.pi)) / half
    amount = mine * (np.abs(along) < 1.0) * (1.0 + rng.uniform(-0.8, 0.8) * along)
    return Cause(reading(h, 1, amount), "azimuth", ("azimuth", "circle", "direction"), ("azimuth",), place=place)


LAWS = named(
    a_supply_line_once_taut_drags_at_the_trunnions,
    one_cheek_of_the_head_toasts_before_a_furnace,
    a_lens_slides_in_its_barrel_when_the_head_nods,
    a_polished_pillar_answers_with_an_echo,
    a_fibre_is_stretched_across_the_trunnion,
    the_glass_disc_skids_on_its_hub,
    the_firmware_mends_its_zero_at_fixed_minutes,
    a_dazzled_receiver_needs_a_minute,
    grease_settles_about_the_balls_where_the_head_waited,
    one_foot_stands_on_a_cable_duct,
    a_bridge_crane_dents_the_slab_as_it_shuttles,
    the_raised_floor_bows_under_who_carries_the_ball,
    glued_nests_bed_in_with_every_ball,
    a_tool_cart_waits_elsewhere_on_the_gallery,
    the_table_wrings_when_the_press_bites,
    helium_of_a_leak_test_gathers_under_the_roof,
    still_air_lies_in_sheets_until_a_gate_stirs_it,
    forklifts_pass_through_the_beams_of_one_aisle,
    a_hasty_reading_catches_the_head_still_swaying,
    lint_gathers_in_the_ball_until_it_is_wiped,
    the_weather_log_is_not_on_summer_time,
    the_map_of_the_circle_is_read_one_line_late,
    a_crystal_without_oven_warms_only_at_work,
    a_shard_of_a_cracked_circle_has_shifted,
)
"""Their names in words, each with the law that draws it."""
