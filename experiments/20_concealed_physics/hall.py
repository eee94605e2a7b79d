"""Random hall with targets, trackers and a sequence of pointings; this module does not depend on laws.

RULES.md lists the attributes that a law may use: time, order, distance etc. of each pointing, and random functions.
"""

from dataclasses import dataclass

import numpy as np

from .tracker import ARCSECOND, GUARANTEED, Array, Index, Pointings, sphere, turned, within_a_turn

WARMTH, LOAD = "hall_temperature_c", "press_load_kn"
REST = 0.02
"""Factor on the guaranteed instrument errors in recordings of two trackers, which are corrected: otherwise the
difference of the two trackers would be an obvious finding.
"""
LENGTH_SIGMA = 2e-6
"""[m] Standard deviation of each reference length."""
LOOK = {"wall": (1.0, 0.0, 0.0), "floor": (0.0, 0.0, 1.0), "gallery": (0.0, -1.0, 0.0), "table": (0.0, 0.0, 1.0)}
"""Direction in which the nests of each group open, in the frame of the hall; nests of reference lengths open upwards.
"""
Draw = np.random.Generator


@dataclass(frozen=True)
class Size:
    """Kind of a hall; lengths in metres."""

    room: tuple[float, float, float]
    targets: tuple[int, int, int, int]
    """Numbers of targets on wall, floor, gallery and table."""
    stations: tuple[int, int]
    """Smallest and largest number of stations."""
    reach: float
    """Largest distance [m] of a measured target, except that each target is measured from its three nearest stations.
    """


SIZES = {
    "hall": Size((11.0, 7.0, 5.0), (7, 7, 6, 5), (4, 6), 99.0),
    "large": Size((30.0, 18.0, 8.0), (36, 60, 34, 15), (12, 14), 14.0),
}


@dataclass
class Hall:
    """Hall with true values in the frame of the floor plan, and the values that a recording declares.

    The declared values are the yaw angles, groups, nest directions, columns, noise and reference lengths.
    """

    size: Size
    pointings: Pointings
    yaw: Array
    """(S,) [rad] Yaw angles in the floor plan."""
    groups: dict[str, Index]
    """Targets of each group."""
    normals: Array
    """(T, 3) Direction in which each nest opens."""
    columns: dict[str, Array]
    noise: Array
    """(3,) Standard deviations: constant part [m] and proportional part [1] of the range, angle across the beam [rad].
    """
    bars: Index
    """(g, 2) Targets at the ends of the reference lengths."""

    def __post_init__(self) -> None:
        """Compute the regressors that a law may use, one value per pointing, and the names."""
        p = self.pointings
        self.n, self.time = len(p), p.time  # [s]
        first = np.flatnonzero(np.diff(p.station, prepend=-1))
        self.starts: Index = np.repeat(first, np.diff(first, append=self.n))  # row of the first pointing of the set-up
        self.order = (np.arange(self.n) - self.starts).astype(np.float64)  # number of earlier pointings in the set-up
        self.since_setup = self.time - self.time[self.starts]  # [s] since the first pointing of the set-up
        self.gap = np.diff(self.time, prepend=self.time[0])  # [s] since the previous pointing, including breaks
        self.local_points = p.local_points  # (n, 3) in the tracker's frame, for both faces as on the front face:
        self.distance, self.azimuth, self.elevation = self.local_points.T  # [m], [rad], [rad]
        self.back = (p.face == 2).astype(np.float64)  # 1 on the back face, 0 on the front
        self.circle = within_a_turn(self.azimuth + np.pi * self.back)  # [rad] angle at which the circle is read
        self.aim, self.stand = p.points[p.target], p.position[p.station]  # (n, 3) [m] nest, tracker in the hall
        self.normal = self.normals[p.target]  # (n, 3) direction in which the nest opens
        beam = (self.stand - self.aim) / self.distance[:, None]
        self.incidence = np.arccos(np.clip((beam * self.normal).sum(axis=1), -1.0, 1.0))  # [rad] from beam to normal
        self.swing = within_a_turn(self.change(self.circle))  # [rad] rotation of the head since the previous pointing
        total = np.cumsum(self.swing)
        self.wound = total - total[self.starts]  # [rad] sum of all rotations of the head in the set-up
        self.stations = tuple(f"S{s + 1}" for s in range(len(p.position)))
        self.targets = tuple(f"P{t + 1:02d}" for t in range(len(p.points)))
        self.trackers = ("A", "B")[: len(p.constants)]  # one tracker, or two that alternate over the stations
        range_ = self.noise[0] + self.noise[1] * self.distance
        across = np.full(self.n, self.noise[2])
        self.sigma = np.stack([range_, across / np.cos(self.elevation), across], axis=1)  # (n, 3) declared
        self.lengths = np.sqrt((np.diff(p.points[self.bars], axis=1) ** 2).sum(axis=2))[:, 0]  # (g,) [m] true

    @property
    def warmth(self) -> Array:
        """(n,) [K] Temperature of the hall minus its mean; LookupError if the recording has no such column."""
        return np.asarray(self.columns[WARMTH] - self.columns[WARMTH].mean())

    @property
    def load(self) -> Array:
        """(n,) Load of the press, from 0 to about 1; LookupError if the recording has no such column."""
        return np.asarray(self.columns[LOAD] / 100.0)

    def change(self, values: Array) -> Array:
        """(n,) Value minus that of the previous pointing; 0 at the first pointing of a set-up."""
        return np.where(self.order > 0, np.diff(values, prepend=values[0]), 0.0)

    def fading(self, inputs: Array, memory: float) -> Array:
        """(n,) Sum of all inputs (n,) up to each pointing, with exponential decay of the time constant `memory` [s]."""
        fractions, sum_of_fading, remainder = np.exp(-self.gap / memory), 0.0, np.empty(self.n)
        added = np.asarray(inputs, float).tolist()
        for i, (fraction, increment) in enumerate(zip(fractions.tolist(), added, strict=True)):
            sum_of_fading = fraction * sum_of_fading + increment
            remainder[i] = sum_of_fading
        return remainder

    def lagging(self, values: Array, delay: float) -> Array:
        """(n,) Values (n,) after a first-order lag with the time constant `delay` [s]; no lag at the first pointing."""
        inputs = (1.0 - np.exp(-self.gap / delay)) * values
        inputs[0] = values[0]
        return self.fading(inputs, delay)

    def latched(self, values: Array, low: float, high: float) -> Array:
        """(n,) Hysteresis: 1 from the pointing at which values exceed `high` until they fall below `low`.

        Otherwise 0.

        The state is 0 at the beginning of each set-up.
        """
        is_outside_band = (values < low) | (values > high) | (self.order == 0)
        last = np.maximum.accumulate(np.where(is_outside_band, np.arange(self.n), 0))
        return np.asarray(values[last] > high, dtype=np.float64)

    def windows(self, rng: Draw) -> Array:
        """(n,) 1 while a machine runs, which is a random fraction of a random cycle; otherwise 0."""
        cycle, fraction = rng.uniform(900.0, 2400.0), rng.uniform(0.3, 0.6)
        return (np.mod(self.time + rng.uniform(0.0, cycle), cycle) < fraction * cycle).astype(np.float64)

    def walk(self, rng: Draw) -> Array:
        """(n,) Random walk over the pointings, with variance 1 at the end."""
        return np.cumsum(rng.standard_normal(self.n)) / np.sqrt(self.n)

    def random_station(self, rng: Draw) -> Array:
        """(n,) 1 for pointings from one random station, otherwise 0."""
        return (self.pointings.station == rng.integers(len(self.stations))).astype(np.float64)

    def random_tracker(self, rng: Draw) -> Array:
        """(n,) 1 for pointings of one of two trackers, otherwise 0; LookupError if there is only one tracker."""
        if len(self.trackers) < 2:
            raise LookupError("the hall has only one tracker")
        return (self.pointings.tracker == rng.integers(2)).astype(np.float64)

    def group(self, name: str) -> Array:
        """(n,) 1 for pointings to targets of the group `wall`, `floor`, `gallery` or `table`, otherwise 0."""
        return np.isin(self.pointings.target, self.groups[name]).astype(np.float64)


def draw_hall(rng: Draw, kind: str = "hall") -> Hall:
    """Random hall without a cause."""
    size = SIZES[kind]
    points, groups, normals = _targets(rng, size)
    position = _stations(rng, points, size)
    count = len(position)
    yaw = rng.uniform(-np.pi, np.pi, count)
    lean = np.column_stack([rng.normal(0.0, 8e-4, (count, 2)), np.zeros(count)])
    rotation = np.stack([_axes(yaw[s], lean[s]) for s in range(count)])
    trackers = 2 if rng.random() < 0.4 else 1
    station, target, face, repeat, time = _work(rng, _sights(points, position, size.reach), size is SIZES["hall"])
    range_, angle = 3e-3 * rng.uniform(0.7, 1.5), 0.37 * rng.uniform(0.7, 1.5)
    noise = np.array([round(range_, 5) * 1e-3, 0.3e-6, round(angle, 4) * ARCSECOND])
    constants = (REST if trackers > 1 else 1.0) * GUARANTEED * rng.standard_normal((trackers, len(GUARANTEED)))
    worker = (np.arange(count) % trackers)[station]
    pointings = Pointings(station, target, worker, face, repeat, time, position, rotation, points, constants)
    ends = len(points) - 4
    bars = np.array([[ends, ends + 1], [ends + 2, ends + 3]])
    return Hall(size, pointings, yaw, groups, normals, _columns(rng, time), noise, bars)


def _axes(yaw: float, lean: Array) -> Array:
    """(3, 3) Axes of a tracker in the frame of the hall, as columns."""
    c, s = np.cos(yaw), np.sin(yaw)
    upright = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(turned(upright, np.tile(lean, (3, 1))).T)


def _targets(rng: Draw, size: Size) -> tuple[Array, dict[str, Index], Array]:
    """Points (T, 3) [m], members of each group, and nest directions (T, 3); ends of reference lengths come last."""
    length, width, height = size.room
    walls, floors, galleries, tables = size.targets
    grid = np.array([[0.0, 0.0, 0.0], [1.8, 0.0, 0.0], [0.0, 1.4, 0.0], [1.8, 1.4, 0.0], [0.9, 0.7, 0.2]])
    corner = np.array([length - 2.4, 0.5, 0.9])
    further = np.arange(tables)[:, None] // 5 * np.array([-4.0, 0.0, 0.0])
    places = {
        "wall": np.column_stack([np.full(walls, 0.05), rng.uniform(0.4, width - 0.4, walls),
                                 np.linspace(0.3, height - 0.8, walls)]),
        "floor": np.column_stack([rng.uniform(0.5, length - 0.5, floors), rng.uniform(0.4, width - 0.4, floors),
                                  np.full(floors, 0.06)]),
        "gallery": np.column_stack([np.linspace(1.0, length - 1.0, galleries), np.full(galleries, width - 0.1),
                                    np.full(galleries, height - 0.7)]),
        "table": corner + grid[np.arange(tables) % 5] + further,
    }  # fmt: skip
    points = [group + rng.normal(0.0, [0.01, 0.1, 0.1] if name == "wall" else [0.1, 0.1, 0.02], group.shape)
              for name, group in places.items()]  # fmt: skip
    foot = rng.uniform([0.3 * length, 1.0, 0.3], [0.65 * length, width - 2.0, 0.5])
    along = rng.uniform(-np.pi, np.pi)
    bar = 1.2 * np.array([np.cos(along), np.sin(along), 0.0])
    upright = np.array([0.3 * np.sin(along), -0.3 * np.cos(along), 1.1])
    points.append(np.stack([foot, foot + bar, foot + 0.2 * bar, foot + 0.2 * bar + upright]))
    sizes = [len(p) for p in points]
    first = np.cumsum([0, *sizes])
    members = {name: np.arange(first[i], first[i + 1]) for i, name in enumerate(places)}
    return np.vstack(points), members, np.repeat(np.array([*LOOK.values(), (0.0, 0.0, 1.0)]), sizes, axis=0)


def _stations(rng: Draw, points: Array, size: Size) -> Array:
    """(S, 3) [m] Random stations with distance from each other and from targets, and without steep sights."""
    places: list[Array] = []
    count = int(rng.integers(size.stations[0], size.stations[1] + 1))
    while len(places) < count:
        place = rng.uniform([1.2, 1.2, 1.3], [size.room[0] - 1.2, size.room[1] - 1.2, 2.1])
        distance, _, steep = sphere(points - place).T
        level = distance * np.cos(steep)
        is_separate = all(((place - other) ** 2).sum() > 1.5 * size.room[0] / 11.0 for other in places)
        if is_separate and level.min() > 0.7 and steep.min() > np.radians(-54) and steep.max() < np.radians(72):
            places.append(place)
    return np.array(places)


def _sights(points: Array, position: Array, reach: float) -> list[Index]:
    """Targets that each station measures: those within `reach` [m], and each target from its three nearest stations."""
    gap = np.sqrt(((points - position[:, None]) ** 2).sum(axis=2))
    nearest = np.argsort(np.argsort(gap, axis=0), axis=0) < 3
    return [np.flatnonzero((gap[s] < reach) | nearest[s]) for s in range(len(position))]


def _work(rng: Draw, sights: list[Index], small: bool) -> tuple[Index, Index, Index, Index, Array]:
    """Station, target, face, repeat and time (n,) [s] of each pointing; a large hall is measured in one round."""
    faces, rounds = int(rng.choice([1, 2], p=[0.35, 0.65])), int(rng.integers(1, 3)) if small else 1
    rows, times, clock = [], [], 0.0
    for s, sighted in enumerate(sights):
        for k in range(rounds):
            for t in rng.permutation(sighted) if rng.random() < 0.7 else sighted:
                for face in (1, 2)[:faces]:
                    rows.append((s, int(t), face, k + 1))
                    times.append(round(clock, 1))
                    clock += rng.uniform(9.0, 20.0)
        clock += rng.uniform(700.0, 2700.0)
    is_measured = rng.random(len(rows)) >= rng.choice([0.0, 0.06])
    station, target, face, repeat = np.array(rows, dtype=np.int64)[is_measured].T
    return station, target, face, repeat, np.array(times)[is_measured]


def _columns(rng: Draw, time: Array) -> dict[str, Array]:
    """Optional columns: temperature of the hall, load of a press."""
    hours, columns = time / 3600.0, {}
    if rng.random() < 0.7:
        wave = 0.3 * np.sin(2 * np.pi * (hours / rng.uniform(1.0, 2.5) + rng.random()))
        columns[WARMTH] = np.round(rng.uniform(18.0, 24.0) + rng.uniform(-0.8, 0.8) * hours + wave, 2)
    if rng.random() < 0.6:
        phase = 2 * np.pi * (hours / rng.uniform(0.4, 1.1) + rng.random())
        columns[LOAD] = np.round(100.0 * np.clip(0.5 + 0.8 * np.sin(phase), 0.0, 1.0), 1)
    return columns
