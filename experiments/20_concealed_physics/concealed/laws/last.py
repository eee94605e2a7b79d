"""A fourth set of invented laws: supplies, firmware, daylight and warm pipes, cables and cages, oval balls."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Floats
from ltsim.geometry.polar import wrap
from ltsim.scene.sightings import Sightings
from ltsim.units import DEGREE

from .law import Law, hours, level, share, turn

UP = np.array([0.0, 0.0, 1.0])


def _height(s: Sightings) -> Floats:
    return s.points[s.target, 2]


def _swing(s: Sightings, name: str) -> Floats:
    """A column (n,) about its mean; 0 where the recording lacks it or it stays the same."""
    column = np.asarray(s.covariates.get(name, np.zeros(len(s))), dtype=np.float64)
    return (column - column.mean()) * bool(np.ptp(column) > 0.0)


def _room_middle(s: Sightings) -> Floats:
    return np.asarray(0.5 * (s.position.mean(axis=0) + s.points.mean(axis=0)))


def _wound(s: Sightings) -> Floats:
    """(n,) [rad]: how far the head has turned since the first pointing of its station, whole turns counted."""
    wound = np.zeros(len(s))
    for row in s.order:
        before = s.previous[row]
        if before >= 0:
            wound[row] = wound[before] + wrap(s.azimuth[row] - s.azimuth[before])
    return wound


def _breakthrough(s: Sightings, u: Floats) -> Floats:
    """Beyond some load the motor of the table breaks through to the receiver, and a cyclic error swells."""
    load = _swing(s, "table_load_kg")
    beyond = np.maximum(load - np.quantile(load, 0.4 + 0.3 * u[0]), 0.0) / 30.0
    return beyond * np.sin(2 * np.pi * s.range_ / (1.5 + 2.5 * u[1]) + turn(u[2]))


def _filter(s: Sightings, u: Floats) -> Floats:
    """A grey filter swings in for near targets and out for far ones; between the two limits it stays as it is."""
    near, far = np.quantile(s.range_, [0.15 + 0.2 * u[0], 0.65 + 0.2 * u[1]])
    out = np.zeros(len(s))
    for row in s.order:
        stays = near < s.range_[row] < far
        out[row] = (out[s.previous[row]] if s.previous[row] >= 0 else 0.0) if stays else s.range_[row] >= far
    return out


def _low_sun(s: Sightings, u: Floats) -> Floats:
    """Daylight in the receiver: beams towards the low sun, which goes round the hall."""
    beam = s.unit_vectors[0]
    bearing = np.arctan2(beam[:, 1], beam[:, 0])
    gap = wrap(bearing - bearing[int(u[0] * len(s))] + 15.0 * DEGREE * (hours(s) - 1.0))
    return np.maximum(np.cos(gap), 0.0) ** (6.0 + 4.0 * u[1])


def _pipe(s: Sightings, u: Floats) -> Floats:
    """A warm pipe runs through the room under the ceiling; beams cross the air around it."""
    along, beam = level(u[0]), s.unit_vectors[0]
    middle, head = _room_middle(s), float(s.position[:, 2].max())
    middle[2] = head + (0.3 + 0.4 * u[1]) * (s.points[:, 2].max() - head)
    normal = np.cross(beam, along)
    slant = np.maximum(np.linalg.norm(normal, axis=1), 0.4)
    arm = middle - s.position[s.station]
    gap = np.sum(arm * normal, axis=1) / slant
    foot = (np.sum(arm * beam, axis=1) - (beam @ along) * (arm @ along)) / slant**2
    return np.exp(-((gap / (0.8 + 0.4 * u[2])) ** 2)) / slant * ((foot > 0) & (foot < s.range_))


def _retarder(s: Sightings, u: Floats) -> Floats:
    """Two mirrors on the axes turn the polarisation by the difference of their angles; one retards."""
    return np.sin(2 * (s.raw[:, 1] - s.raw[:, 2]) + turn(u[0]))


def _creeping_phase(s: Sightings, u: Floats) -> Floats:
    """Crosstalk of a second oscillator that is not locked: a cyclic error whose phase walks with the clock."""
    return np.sin(2 * np.pi * (s.range_ / (1.5 + 2.5 * u[0]) + hours(s) / (0.7 + 1.3 * u[1])) + turn(u[2]))


def _sinking_layer(s: Sightings, u: Floats) -> Floats:
    """Warm air gathers under the ceiling, and its lower edge sinks all day."""
    top, head = float(s.points[:, 2].max()), float(s.position[:, 2].max())
    edge = top - (0.4 + 0.5 * u[0]) * (top - head) * share(s)
    inside = np.maximum(_height(s) - edge, 0.0)
    return inside / np.maximum(np.sin(s.elevation), 0.1)


def _glass_circle(s: Sightings, u: Floats) -> Floats:
    """A glass circle is clamped at two points of a steel hub, which warms with the air."""
    return _swing(s, "air_temperature_c") * np.sin(2 * s.raw[:, 1] + turn(u[0]))


def _seam(s: Sightings, u: Floats) -> Floats:
    """A scale on a tape, a little too short for its drum: the error grows round the turn and jumps at the seam."""
    seam = s.raw[int(u[0] * len(s)), 1] + 0.01
    return ((s.raw[:, 1] - seam) % (2 * np.pi)) / (2 * np.pi) - 0.5


def _cable(s: Sightings, u: Floats) -> Floats:
    """A cable has slack for a part of a turn either way, then it pulls back."""
    wound = _wound(s)
    return np.sign(wound) * np.maximum(np.abs(wound) - 1.0 - 0.4 * u[0], 0.0)


def _focus(s: Sightings, u: Floats) -> Floats:
    """The screw that moves the focusing lens is bent, and the lens goes round with it."""
    return s.face_sign * np.sin(2 * np.pi * s.range_ / (2.0 + 2.0 * u[0]) + turn(u[1])) / np.cos(s.elevation)


def _hot_column(s: Sightings, u: Floats) -> Floats:
    """A hot stove pipe stands in the room; beams that pass it are bent away on either side."""
    offset = (_room_middle(s) + 1.2 * (u[0] - 0.5) * level(u[1]) - s.position[s.station])[:, :2]
    beam = s.unit_vectors[0][:, :2] / np.cos(s.elevation)[:, None]
    along = np.sum(offset * beam, axis=1) / (s.range_ * np.cos(s.elevation))
    across = (beam[:, 0] * offset[:, 1] - beam[:, 1] * offset[:, 0]) / (0.4 + 0.4 * u[2])
    return 2.0 * across * np.exp(-(across**2)) * (1.0 - along) * ((along > 0) & (along < 1))


def _table_of_sag(s: Sightings, u: Floats) -> Floats:
    """The firmware draws straight lines between the entries of its table, where the sag is round."""
    place = (s.raw[:, 2] / ((18.0 + 10.0 * u[0]) * DEGREE) + u[1]) % 1.0
    return 4.0 * place * (1.0 - place)


def _stratified(s: Sightings, u: Floats) -> Floats:
    """The warmer the hall, the steeper the air's temperature over height, and the rounder the beam."""
    return _swing(s, "air_temperature_c") * s.range_ * np.cos(s.elevation)


def _cage(s: Sightings, u: Floats) -> Floats:
    """Two thick balls, opposite each other, bend the head; their cage goes round slower than the head does."""
    ball = (0.38 + 0.08 * u[0]) * (_wound(s) + np.pi * (s.face == 2))
    return np.cos(2 * (ball - s.azimuth) + turn(u[1]))


def _heater(s: Sightings, u: Floats) -> Floats:
    """A heater under the roof is turned up and down, and high targets shimmer up and down."""
    running = np.sin(turn((2.0 + 1.5 * u[0]) * share(s) + u[1]))
    return running * np.maximum(_height(s) - np.median(s.points[:, 2]), 0.0) / 4.0


def _leaning(s: Sightings, u: Floats) -> Floats:
    """For some minutes of a visit somebody leans on the stand."""
    longest = np.zeros(len(s.station_names))
    np.maximum.at(longest, s.station, s.station_time)
    part = s.station_time / np.maximum(longest[s.station], 1.0)
    begin = 0.2 + 0.25 * u[0]
    return ((part > begin) & (part < begin + 0.2 + 0.15 * u[1])) * np.cos(s.azimuth - turn(u[2]))


def _lobed_ball(s: Sightings, u: Floats) -> Floats:
    """Balls with five lobes rise and sink in their nests as they are turned to the station."""
    normal = np.nan_to_num(s.nest_normal[s.target])
    turned = s.reaimed[s.target] * np.sin(5 * np.nan_to_num(s.incidence) + turn(u[0]))
    return turned[:, None] * normal


def _torsion(s: Sightings, u: Floats) -> Floats:
    """The sun goes round the hall and twists it, the more the higher, and back again."""
    lever = np.cross(UP, s.points - s.points.mean(axis=0)) / 3.0
    twist = np.sin(np.pi * (0.7 + 0.8 * u[0]) * share(s)) * (_height(s) - s.points[:, 2].min()) / 6.0
    return twist[:, None] * lever[s.target]


def _heave(s: Sightings, u: Floats) -> Floats:
    """Damp ground swells under one place of the floor, which lifts there and sinks in a ring around."""
    centre = s.points[int(u[0] * len(s.points))]
    off = np.linalg.norm((s.points - centre)[:, :2], axis=1) / (1.2 + 1.2 * u[1])
    bowl = (1.0 - off**2) * np.exp(-(off**2))
    return ((1.0 - np.exp(-share(s) / (0.15 + 0.4 * u[2]))) * bowl[s.target])[:, None] * UP


LAWS: dict[str, tuple[str, tuple[str, ...], Law]] = {
    "range in waves beyond a load": ("distance", ("table_load_kg", "distance"), _breakthrough),
    "range by a filter that stays": ("distance", ("distance", "approach"), _filter),
    "range towards the sun": ("distance", ("azimuth", "time"), _low_sun),
    "range across a warm pipe": ("distance", ("place",), _pipe),
    "range by the difference of the axes": ("distance", ("azimuth", "elevation"), _retarder),
    "range in waves that creep": ("distance", ("distance", "time"), _creeping_phase),
    "range in a layer that sinks": ("distance", ("height", "time"), _sinking_layer),
    "azimuth of a clamped circle by air": ("azimuth", ("temperature", "azimuth"), _glass_circle),
    "azimuth by the seam of a tape": ("azimuth", ("azimuth",), _seam),
    "azimuth by the pull of a cable": ("azimuth", ("azimuth", "approach"), _cable),
    "azimuth by the screw of the focus": ("azimuth", ("distance", "face"), _focus),
    "azimuth past a hot column": ("azimuth", ("place",), _hot_column),
    "elevation between the entries of a table": ("elevation", ("elevation",), _table_of_sag),
    "elevation by air and range": ("elevation", ("temperature", "distance"), _stratified),
    "elevation by balls in their cage": ("elevation", ("azimuth", "approach"), _cage),
    "elevation of high targets now and then": ("elevation", ("height", "time"), _heater),
    "elevation while somebody leans": ("elevation", ("time", "azimuth"), _leaning),
    "balls rise as they are turned": ("place", ("incidence",), _lobed_ball),
    "targets twist with height": ("place", ("height", "time"), _torsion),
    "targets heave around a place": ("place", ("place", "time"), _heave),
}
AT_A_STATION = {"elevation while somebody leans"}
OF_NEIGHBOURS = {"balls rise as they are turned"}
