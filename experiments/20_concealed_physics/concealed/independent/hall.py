"""A hall, its targets, one or two trackers and the order of the work, drawn at random; nothing here knows of causes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ltsim.recording import Recording
from ltsim.recording.setup import Gauge, GaugeDistance, Instrument, Noise, Setup, Station, Target

from .tracker import ARCSECOND, GUARANTEED, Array, Index, Pointings, turned, within_a_turn

WARMTH, LOAD = "hall_temperature_c", "press_load_kn"
SIZE = np.array([11.0, 7.0, 5.0])
"""[m]"""
REST = 0.02
"""Share of the guarantee that errors keep where two trackers work: both were corrected, or their difference is told."""
LENGTH_SIGMA = 2e-6
"""[m] Of each known length."""
GROUPS = {"wall": (1.0, 0.0, 0.0), "floor": (0.0, 0.0, 1.0), "gallery": (0.0, -1.0, 0.0), "table": (0.0, 0.0, 1.0)}
"""Where the nests of each group look, in the room."""
BARS = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Hall:
    """Pointings with the truth they are made at, in the frame of the floor plan, and what a person knows of them."""

    pointings: Pointings
    setup: Setup
    stations: tuple[str, ...]
    targets: tuple[str, ...]
    trackers: tuple[str, ...]
    groups: dict[str, Index]
    """Targets of each group."""
    normals: Array
    """(T, 3) Where the nests look."""
    columns: dict[str, Array]
    noise: Array
    """(3,) Range [m], range [1], angle across the beam [rad]."""
    bars: Index
    """(g, 2) Ends of the known lengths."""

    @property
    def warmth(self) -> Array:
        """(n,) [K] Above the mean."""
        return np.asarray(self.columns[WARMTH] - self.columns[WARMTH].mean())

    @property
    def load(self) -> Array:
        """(n,) Of the press, 0 to about 1."""
        return np.asarray(self.columns[LOAD] / 100.0)

    @cached_property
    def starts(self) -> Array:
        """(n,) Row at which the set-up of each row began."""
        first = np.flatnonzero(np.diff(self.pointings.station, prepend=-1))
        return np.repeat(first, np.diff(first, append=len(self.pointings)))

    @property
    def turn_of_work(self) -> Array:
        """(n,) Pointings made before in this set-up."""
        return np.asarray(np.arange(len(self.pointings)) - self.starts, dtype=np.float64)

    def since_before(self, values: Array) -> Array:
        """(n,) Value less that of the pointing before; nothing at the first of a set-up."""
        return np.where(self.turn_of_work > 0, np.diff(values, prepend=values[0]), 0.0)

    @property
    def wound(self) -> Array:
        """(n,) [rad] Sum of all turns of the head since the set-up, each the short way round."""
        total = np.cumsum(within_a_turn(self.since_before(self.pointings.seen[:, 1])))
        return np.asarray(total - total[self.starts])

    @cached_property
    def sigma(self) -> Array:
        """(n, 3) [m, rad, rad] Stated standard deviations."""
        distance, _, elevation = self.pointings.seen.T
        range_ = self.noise[0] + self.noise[1] * distance
        return np.stack([range_, self.noise[2] / np.cos(elevation), np.full(len(distance), self.noise[2])], axis=1)

    @property
    def lengths(self) -> Array:
        """(g,) [m] True lengths of the bars."""
        ends = self.pointings.points[self.bars]
        return np.sqrt(((ends[:, 1] - ends[:, 0]) ** 2).sum(axis=1))

    def recording(self, readings: Array, lengths: Array) -> Recording:
        """The recording of raw readings (n, 3), with lengths (g,) [m] as a certificate states them."""
        certificate = [
            {"from": self.targets[a], "to": self.targets[b], "length_mm": round(1e3 * x, 5), "sigma_mm": 0.002}
            for (a, b), x in zip(self.bars.tolist(), lengths.tolist(), strict=True)
        ]
        gauge = Gauge(distance=tuple(GaugeDistance.model_validate(line) for line in certificate))
        p = self.pointings
        return Recording(
            setup=self.setup.model_copy(update={"gauge": gauge}),
            stations=self.stations,
            targets=self.targets,
            station=p.station,
            target=p.target,
            face=p.face,
            repeat=p.repeat,
            time=p.time,
            readings=readings,
            covariates=dict(self.columns),
        )


def draw_hall(rng: np.random.Generator) -> Hall:
    """Everything but what is wrong."""
    points, members, look = _targets(rng)
    position = _stations(rng, points)
    count = len(position)
    yaw = rng.uniform(-np.pi, np.pi, count)
    lean = np.column_stack([rng.normal(0.0, 8e-4, (count, 2)), np.zeros(count)])
    rotation = np.stack([_axes(yaw[s], lean[s]) for s in range(count)])
    trackers = ("A", "B") if rng.random() < 0.4 else ("A",)
    several = len(trackers) > 1
    of_station = np.arange(count) % len(trackers)
    station, target, face, repeat, time = _work(rng, count, len(points))
    noise = np.array([3e-6 * rng.uniform(0.7, 1.5), 0.3e-6, 0.37 * ARCSECOND * rng.uniform(0.7, 1.5)])
    noise = np.array([round(1e3 * noise[0], 5) / 1e3, noise[1], round(noise[2] / ARCSECOND, 4) * ARCSECOND])
    stations = tuple(f"S{s + 1}" for s in range(count))
    targets = tuple(f"P{t + 1:02d}" for t in range(len(points)))
    pointings = Pointings(
        station,
        target,
        of_station[station],
        face,
        repeat,
        time,
        position,
        rotation,
        points,
        (REST if several else 1.0) * GUARANTEED * rng.standard_normal((len(trackers), len(GUARANTEED))),
    )
    known = Instrument(
        corrected=several,
        noise=Noise(
            distance_mm=1e3 * noise[0],
            distance_ppm=1e6 * noise[1],
            azimuth_arcsec=noise[2] / ARCSECOND,
            elevation_arcsec=noise[2] / ARCSECOND,
        ),
    )
    setup = Setup(
        instrument=known,
        instruments=dict.fromkeys(trackers, known) if several else {},
        stations={
            name: Station(
                position_mm=tuple(np.round(1e3 * position[s], -1).tolist()),
                yaw_deg=round(float(np.degrees(yaw[s])), 0),
                instrument=trackers[of_station[s]] if several else None,
            )
            for s, name in enumerate(stations)
        },
        targets={name: Target(nest_normal=tuple(look[t].tolist())) for t, name in enumerate(targets)},
    )
    ends = len(points) - 4
    bars = np.array([[ends, ends + 1], [ends + 2, ends + 3]])
    columns = _columns(rng, time)
    return Hall(pointings, setup, stations, targets, trackers, members, look, columns, noise, bars)


def _axes(yaw: float, lean: Array) -> Array:
    """(3, 3) Axes of a tracker in the room, as columns."""
    c, s = np.cos(yaw), np.sin(yaw)
    upright = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(turned(upright, np.tile(lean, (3, 1))).T)


def _targets(rng: np.random.Generator) -> tuple[Array, dict[str, Index], Array]:
    """Points (T, 3) [m] in the room, members of each group, and where the nests look (T, 3); the bars come last."""
    length, width, height = SIZE
    places = {
        "wall": np.column_stack([np.full(7, 0.05), rng.uniform(0.4, 6.6, 7), np.linspace(0.3, 4.2, 7)]),
        "floor": np.column_stack([rng.uniform(0.5, length - 0.5, 7), rng.uniform(0.4, 6.6, 7), np.full(7, 0.06)]),
        "gallery": np.column_stack([np.linspace(1.0, 10.0, 6), np.full(6, width - 0.1), np.full(6, height - 0.7)]),
        "table": np.array([[8.6, 0.5, 0.9], [10.4, 0.5, 0.9], [8.6, 1.9, 0.9], [10.4, 1.9, 0.9], [9.5, 1.2, 1.1]]),
    }
    points = [group + rng.normal(0.0, [0.01, 0.1, 0.1] if name == "wall" else [0.1, 0.1, 0.02], group.shape)
              for name, group in places.items()]  # fmt: skip
    corner = rng.uniform([3.0, 1.0, 0.3], [7.0, 5.0, 0.5])
    along = rng.uniform(-np.pi, np.pi)
    bar = 1.2 * np.array([np.cos(along), np.sin(along), 0.0])
    upright = np.array([0.3 * np.sin(along), -0.3 * np.cos(along), 1.1])
    points.append(np.stack([corner, corner + bar, corner + 0.2 * bar, corner + 0.2 * bar + upright]))
    sizes = [len(p) for p in points]
    first = np.cumsum([0, *sizes])
    members = {name: np.arange(first[i], first[i + 1]) for i, name in enumerate(places)}
    look = np.repeat(np.array([*GROUPS.values(), BARS]), sizes, axis=0)
    return np.vstack(points), members, look


def _stations(rng: np.random.Generator, points: Array) -> Array:
    """(S, 3) [m] in the room: apart from each other and from the targets, none of which is too steep."""
    found: list[Array] = []
    count = int(rng.integers(4, 7))
    while len(found) < count:
        place = rng.uniform([1.2, 1.2, 1.3], [SIZE[0] - 1.2, SIZE[1] - 1.2, 2.1])
        arm = points - place
        level = np.sqrt((arm[:, :2] ** 2).sum(axis=1))
        steep = np.arctan2(arm[:, 2], level)
        apart = all(((place - other) ** 2).sum() > 1.5 for other in found)
        if apart and level.min() > 0.7 and steep.min() > np.radians(-54) and steep.max() < np.radians(72):
            found.append(place)
    return np.array(found)


def _work(rng: np.random.Generator, stations: int, targets: int) -> tuple[Index, Index, Index, Index, Array]:
    """Station, target, face, repeat and time (n,) [s] of each pointing."""
    faces, rounds = int(rng.choice([1, 2], p=[0.35, 0.65])), int(rng.integers(1, 3))
    rows, times, clock = [], [], 0.0
    for s in range(stations):
        for k in range(rounds):
            order = rng.permutation(targets) if rng.random() < 0.7 else np.arange(targets)
            for t in order:
                for face in (1, 2)[:faces]:
                    rows.append((s, int(t), face, k + 1))
                    times.append(round(clock, 1))
                    clock += rng.uniform(9.0, 20.0)
        clock += rng.uniform(700.0, 2700.0)
    kept = rng.random(len(rows)) >= rng.choice([0.0, 0.06])
    station, target, face, repeat = np.array(rows, dtype=np.int64)[kept].T
    return station, target, face, repeat, np.array(times)[kept]


def _columns(rng: np.random.Generator, time: Array) -> dict[str, Array]:
    """Warmth of the hall and load of a press, where somebody wrote them down."""
    hours, columns = time / 3600.0, {}
    if rng.random() < 0.7:
        wave = 0.3 * np.sin(2 * np.pi * (hours / rng.uniform(1.0, 2.5) + rng.random()))
        columns[WARMTH] = np.round(rng.uniform(18.0, 24.0) + rng.uniform(-0.8, 0.8) * hours + wave, 2)
    if rng.random() < 0.6:
        phase = 2 * np.pi * (hours / rng.uniform(0.4, 1.1) + rng.random())
        columns[LOAD] = np.round(100.0 * np.clip(0.5 + 0.8 * np.sin(phase), 0.0, 1.0), 1)
    return columns
