"""An eighth set of 24 laws that are in no catalogue: what the tracker, its stand, the hall, the air and the crew do."""

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
    group,
    lagging,
    level,
    named,
    one_station,
    one_tracker,
    reading,
    vary,
    windows,
)
from .hall import LOAD, SIZE, Hall
from .tracker import Array, Change, within_a_turn

# What laws are made of


def _held(h: Hall, values: Array) -> Array:
    """(n,) What held until a pointing: the value at the one before, nothing while the tracker was carried."""
    return np.where(h.turn_of_work > 0, np.roll(values, 1), 0.0)


def _lagged_warmth(h: Hall, seconds: float) -> Array:
    """(n,) [K] Warmth of what is slower than the air."""
    return lagging(h, h.warmth - 0.5 * np.diff(h.warmth, prepend=h.warmth[0]), seconds)


def _stations_of(h: Hall, mine: Array) -> tuple[str, ...]:
    """Stations at which a tracker measured."""
    return tuple(h.stations[s] for s in np.unique(h.pointings.station[mine > 0]))


# Constants of the tracker


def collimator_warmed_by_steep_shots(h: Hall, rng: Draw) -> Cause:
    """Holding the head steeply heats the motor beside the collimator, and the beam leaves askew until it has cooled."""
    steep = _held(h, np.abs(h.pointings.seen[:, 2]))
    amount = lagging(h, steep, rng.uniform(100.0, 400.0))
    return Cause(vary(h, "beam-tilt", amount), "beam-tilt", ("elevation", "before", "order", "time"), ("azimuth",))


def prism_shifts_at_every_carry(h: Hall, rng: Draw) -> Cause:
    """A prism sits loosely: whenever the tracker is carried to a new stand, the beam comes out at another height."""
    amount = rng.standard_normal(len(h.stations))[h.pointings.station]
    drivers = ("station", "order", "time", "jumps")
    return Cause(vary(h, "beam-offset-vertical", amount), "vertical-offset", drivers, ("elevation",))


def disk_creeps_on_its_glue(h: Hall, rng: Draw) -> Cause:
    """The azimuth scale of one tracker was glued anew and still slides to one side, more slowly from hour to hour."""
    place, mine = one_tracker(h, rng)
    amount = mine * np.log1p(h.pointings.time / rng.uniform(600.0, 1800.0))
    angle = rng.uniform(-np.pi, np.pi)
    whole = np.zeros((len(amount), h.pointings.constants.shape[1]))
    for axis, share in (("cos", np.cos(angle)), ("sin", np.sin(angle))):
        part = vary(h, f"azimuth-eccentricity-{axis}", share * amount).constants
        whole += 0.0 if part is None else part
    return Cause(Change(constants=whole), "eccentricity", CLOCK, ("azimuth",), _stations_of(h, mine), place=place)


# Readings


def hum_folds_into_minutes(h: Hall, rng: Draw) -> Cause:
    """The elevation servo hums with the mains; a clock that samples nearly in step makes slow waves of it."""
    phase = 2 * np.pi * (h.pointings.time / rng.uniform(90.0, 240.0) + rng.random())
    return Cause(reading(h, 2, np.sin(phase)), "elevation", CLOCK, ("elevation",))


def fibre_loop_turns_the_polarisation(h: Hall, rng: Draw) -> Cause:
    """The fibre to the head is twisted with every turn, its light turns with it, and the phase meter minds that."""
    phase = rng.uniform(0.3, 0.8) * h.wound + rng.uniform(-np.pi, np.pi)
    drivers = ("wound", "turn", "azimuth", "approach", "order")
    return Cause(reading(h, 0, np.cos(phase)), "distance", drivers, ("distance",))


def sun_walks_round_the_hall(h: Hall, rng: Draw) -> Cause:
    """Sun through the roof lights warms the head's brow when it faces the sun, which goes round with the hours."""
    arm = h.pointings.arm
    sun = rng.uniform(-np.pi, np.pi) - np.radians(15.0) * h.pointings.time / 3600.0
    facing = np.maximum(0.0, np.cos(np.arctan2(arm[:, 1], arm[:, 0]) - sun))
    return Cause(vary(h, "vertical-index", facing), "vertical-index", ("azimuth", "time"), ("elevation",))


# Stands


def floor_panel_gives_under_the_crew(h: Hall, rng: Draw) -> Cause:
    """Who holds the reflector near the tripod bends the raised floor across its joists; on the gallery he does not."""
    arm = h.pointings.arm
    near = np.exp(-(arm[:, 0] ** 2 + arm[:, 1] ** 2) / rng.uniform(1.8, 2.8) ** 2)
    amount = near * (1.0 - group(h, "gallery")[1])
    return Cause(Change(turn=MICRO * amount[:, None] * level(rng)), "station", ("distance",))


def lift_platform_leaks_and_is_pumped(h: Hall, rng: Draw) -> Cause:
    """One stand is a lift that leaks: it sinks for some minutes until the pump lifts it to the mark again."""
    name, here = one_station(h, rng)
    sunk = np.mod(h.pointings.time / rng.uniform(240.0, 600.0) + rng.random(), 1.0)
    return Cause(Change(station=-MICRO * (here * sunk)[:, None] * UP), "station", CLOCK, (), (name,), place=name)


def crane_bends_the_slab(h: Hall, rng: Draw) -> Cause:
    """A loaded crane runs up and down the hall, and every stand leans towards it, most when it stands close by."""
    run = np.mod(h.pointings.time / rng.uniform(500.0, 1500.0) + rng.random(), 1.0)
    crane = 1.0 + (SIZE[0] - 2.0) * np.abs(2.0 * run - 1.0)
    off = (crane - h.pointings.position[h.pointings.station, 0]) / rng.uniform(1.5, 2.5)
    about = np.cross(UP, OUT)
    return Cause(Change(turn=MICRO * (off / (1.0 + off**2))[:, None] * about), "station", CLOCK)


def base_creeps_back_under_the_head(h: Hall, rng: Draw) -> Cause:
    """The base stands on a sticky mat: every swing of the head turns it backwards, and it comes home in minutes."""
    swing = within_a_turn(h.since_before(h.pointings.seen[:, 1]))
    gaps, seconds = h.since_before(h.pointings.time), rng.uniform(40.0, 200.0)
    left = np.zeros(len(swing))
    for row in np.flatnonzero(h.turn_of_work > 0):
        left[row] = left[row - 1] * np.exp(-gaps[row] / seconds) + swing[row]
    return Cause(Change(turn=-MICRO * left[:, None] * UP), "yaw", (*TURN, "turn", "wound"))


# Targets


def tank_on_the_gallery_fills(h: Hall, rng: Draw) -> Cause:
    """A cistern on the gallery fills slowly and empties at once, and the gallery hangs through below it."""
    names, inside = group(h, "gallery")
    full = np.mod(h.pointings.time / rng.uniform(1500.0, 4500.0) + rng.random(), 1.0)
    sag = np.maximum(0.0, 1.0 - np.abs(aims(h)[:, 0] - rng.uniform(3.0, 8.0)) / rng.uniform(3.0, 6.0))
    change = Change(target=-MICRO * (inside * full * sag)[:, None] * UP)
    return Cause(change, "targets", CLOCK, (), (), names, "the gallery")


def table_nudged_at_every_visit(h: Hall, rng: Draw) -> Cause:
    """Who sets a ball on the table leans against it; it turns about the one leg that is bolted, a little each time."""
    names, inside = group(h, "table")
    another = np.diff(h.pointings.target, prepend=-1) != 0
    visits = np.cumsum(inside * another)
    leg = h.pointings.points[rng.choice(h.groups["table"])]
    moved = np.cross(UP, aims(h) - leg) * (inside * visits / visits[-1])[:, None]
    return Cause(Change(target=MICRO * moved), "targets", CLOCK, (), (), names, "the table")


def wind_racks_the_hall(h: Hall, rng: Draw) -> Cause:
    """Wind pushes the frame of the hall over: wall and gallery give with their height, the floor does not."""
    (wall, on_wall), (gallery, on_gallery) = group(h, "wall"), group(h, "gallery")
    wind = np.zeros(len(h.pointings))
    for period in rng.uniform(900.0, 5000.0, 3):
        wind += np.sin(2 * np.pi * (h.pointings.time / period + rng.random()))
    amount = wind * (on_wall + on_gallery) * aims(h)[:, 2] / SIZE[2]
    change = Change(target=MICRO * amount[:, None] * level(rng))
    return Cause(change, "targets", CLOCK, (), (), (*wall, *gallery), "wall and gallery")


# Air


def argon_pools_on_the_floor(h: Hall, rng: Draw) -> Cause:
    """Shielding gas of a welder gathers on the floor while he works; it is thinner for light than air."""
    top = rng.uniform(0.5, 0.9)
    low = aims(h)[:, 2]
    high = h.pointings.position[h.pointings.station, 2]
    inside = h.pointings.seen[:, 0] * np.maximum(0.0, top - low) / (high - low)
    welding = _held(h, windows(h, rng))
    amount = -inside * lagging(h, welding, rng.uniform(200.0, 600.0))
    return Cause(reading(h, 0, amount), "distance", (*CLOCK, "elevation", "height", "z", "distance"), ("distance",))


def column_under_the_ceiling_fan(h: Hall, rng: Draw) -> Cause:
    """A fan blows a column of warm air down in mid-hall: beams that pass it on either side are bent away from it."""
    fan = rng.uniform([3.0, 2.0], [8.0, 5.0])
    arm = h.pointings.arm[:, :2]
    length = np.sqrt((arm**2).sum(axis=1))
    off = fan - h.pointings.position[h.pointings.station, :2]
    along = (off * arm).sum(axis=1) / length
    miss = (arm[:, 0] * off[:, 1] - arm[:, 1] * off[:, 0]) / length / rng.uniform(0.5, 0.9)
    passed = (along > 0.0) & (along < length)
    amount = passed * (1.0 - along / length) * miss * np.exp(0.5 - 0.5 * miss**2)
    return Cause(reading(h, 1, amount), "azimuth", ("azimuth", "distance"), ("azimuth",))


def weather_typed_in_once_a_set_up(h: Hall, rng: Draw) -> Cause:
    """The weather station is broken: the crew types the temperature in at each new stand, and the hall goes on."""
    grown = h.warmth - h.warmth[h.starts]
    return Cause(reading(h, 0, h.pointings.seen[:, 0] * grown), "distance", (*WARM, "distance"), ("distance",))


# Noise


def lathe_shakes_the_wall(h: Hall, rng: Draw) -> Cause:
    """A lathe is bolted to the other side of the wall; while it cuts, the wall's nests shake to and fro."""
    names, inside = group(h, "wall")
    on = inside * windows(h, rng)
    distance, _, elevation = h.pointings.seen.T
    x, y, _ = h.pointings.arm.T
    room = np.arctan2(y, x)
    across = np.stack([np.cos(elevation) * np.cos(room), -np.sin(room) / np.cos(elevation) / distance,
                       -np.sin(elevation) * np.cos(room) / distance], axis=1)  # fmt: skip
    variance = on[:, None] * (MICRO * across / h.sigma) ** 2
    return Cause(Change(variance=variance), "noise", CLOCK, (), (), names, "the wall")


def motor_cogs_shake_the_azimuth(h: Hall, rng: Draw) -> Cause:
    """The azimuth motor holds badly between its magnets, so the servo trembles at some places of the turn."""
    raw = h.pointings.readings()[:, 1]
    trembling = 0.5 + 0.5 * np.cos(int(rng.integers(2, 7)) * raw + rng.uniform(-np.pi, np.pi))
    variance = np.zeros((len(raw), 3))
    variance[:, 1] = trembling**2
    return Cause(Change(variance=variance), "noise", ("azimuth",), ("azimuth",))


def battery_of_one_tracker_runs_flat(h: Hall, rng: Draw) -> Cause:
    """One of two trackers is run on its battery; as that fades, so does its laser, and the ranges scatter more."""
    place, mine = one_tracker(h, rng)
    variance = np.zeros((len(mine), 3))
    variance[:, 0] = mine * (h.pointings.time / h.pointings.time[-1]) ** rng.uniform(2.0, 4.0)
    return Cause(Change(variance=variance), "noise", CLOCK, ("distance",), _stations_of(h, mine), place=place)


# Crew, firmware, and what was written down beside the readings


def second_shift_wipes_the_nests(h: Hall, rng: Draw) -> Cause:
    """The second shift wipes the oil off each nest before it sets the ball, the first does not: balls sink by it."""
    begin, end = h.pointings.time[[0, -1]]
    after = h.pointings.time > begin + rng.uniform(0.3, 0.7) * (end - begin)
    change = Change(target=-MICRO * after[:, None] * h.normals[h.pointings.target])
    return Cause(change, "targets", (*CLOCK, "jumps"))


def level_slops_after_a_swing(h: Hall, rng: Draw) -> Cause:
    """The firmware corrects elevations by a liquid level, which still slops a few seconds after the head has swung."""
    swing = within_a_turn(h.since_before(h.pointings.seen[:, 1]))
    amount = swing * np.exp(-h.since_before(h.pointings.time) / rng.uniform(5.0, 12.0))
    return Cause(reading(h, 2, amount), "elevation", (*TURN, "turn"), ("elevation",))


def yoke_bends_while_the_hall_warms(h: Hall, rng: Draw) -> Cause:
    """One cheek of the yoke is thin and follows the air at once, the other late: the transit axis tilts meanwhile."""
    amount = h.warmth - _lagged_warmth(h, rng.uniform(900.0, 3600.0))
    return Cause(vary(h, "transit-tilt", amount), "transit-tilt", WARM, ("azimuth",))


def floor_rises_in_a_dome(h: Hall, rng: Draw) -> Cause:
    """The slab takes the warmth of the hall late and arches up about one place, where it is thickest."""
    names, inside = group(h, "floor")
    off = aims(h)[:, :2] - rng.uniform([2.0, 1.5], [9.0, 5.5])
    dome = np.exp(-0.5 * (off**2).sum(axis=1) / rng.uniform(1.5, 2.5) ** 2)
    amount = inside * dome * _lagged_warmth(h, rng.uniform(600.0, 2400.0))
    return Cause(Change(target=MICRO * amount[:, None] * UP), "targets", WARM, (), (), names, "the floor")


def press_pump_dips_the_mains(h: Hall, rng: Draw) -> Cause:
    """While the press builds its load up, its pump pulls the mains down, and the range electronics feel it."""
    amount = np.maximum(0.0, np.gradient(h.load, h.pointings.time / 60.0))
    return Cause(reading(h, 0, amount), "distance", (LOAD, "load", "time"), ("distance",))


LAWS = named(
    collimator_warmed_by_steep_shots,
    prism_shifts_at_every_carry,
    disk_creeps_on_its_glue,
    hum_folds_into_minutes,
    fibre_loop_turns_the_polarisation,
    sun_walks_round_the_hall,
    floor_panel_gives_under_the_crew,
    lift_platform_leaks_and_is_pumped,
    crane_bends_the_slab,
    base_creeps_back_under_the_head,
    tank_on_the_gallery_fills,
    table_nudged_at_every_visit,
    wind_racks_the_hall,
    argon_pools_on_the_floor,
    column_under_the_ceiling_fan,
    weather_typed_in_once_a_set_up,
    lathe_shakes_the_wall,
    motor_cogs_shake_the_azimuth,
    battery_of_one_tracker_runs_flat,
    second_shift_wipes_the_nests,
    level_slops_after_a_swing,
    yoke_bends_while_the_hall_warms,
    floor_rises_in_a_dome,
    press_pump_dips_the_mains,
)
