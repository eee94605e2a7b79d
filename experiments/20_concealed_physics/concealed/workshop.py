"""A workshop, its stations and the order of the work, all drawn at random; nothing here knows of effects.

Two walls with 24 reflectors on three levels, a gauge of 4 on the floor, 4 to 6 stations. The truth stands in the frame
of the floor plan, as an adjustment of the recording does: a vector that is told can be held against the true one.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.geometry.rotations import about_z, from_rotation_vector
from ltsim.model.construction import misalignment
from ltsim.model.measurement import State
from ltsim.recording.recording import Recording
from ltsim.recording.setup import Gauge, GaugeDistance, Instrument, Noise, Setup, Station, Target
from ltsim.scene.visibility import aimed_normals
from ltsim.units import DEGREE, MILLIMETRE

ALONG = (0.5, 2.2, 3.9, 5.6)
LEVELS = (5.9, 2.0, 0.15)
FRAME = np.array([[0.0, 0.0, 0.0], [0.3576, 0.0, 0.0], [0.2315, 0.3114, 0.0], [0.1254, 0.2408, 0.3632]])
"""A gauge [m] about as large as the paper's."""
EXPANSION = 23.2e-6
GAUGE_SIGMA = 0.0018
FACTORS = {"noise": (0.7, 1.5), "missing": 0.08, "load": 0.15, "fixed": 0.5, "air": 0.7, "unsteady": 0.4}


@dataclass(frozen=True)
class Scene:
    """Pointings without readings, the truth they are made at, and the true gauge lengths.

    Attributes
    ----------
    recording : Recording
        Readings NaN, no gauge yet.
    state : State
        True poses, points and instrument parameters; frame of the floor plan.
    first, second : (g,) int
        Targets of the gauge's lengths.
    lengths : (g,) float, [m]
        At the temperature of the workshop.
    measured_at : float, [degree C]
    """

    recording: Recording
    state: State
    first: Ints
    second: Ints
    lengths: Floats
    measured_at: float

    def gauge(self, lengths: Floats) -> Gauge:
        """The certificate that states `lengths` (g,) [m], brought back to 20 degrees."""
        grown, names = 1.0 + EXPANSION * (self.measured_at - 20.0), self.recording.targets
        lines = [
            {"from": names[a], "to": names[b], "length_mm": round(x / grown / MILLIMETRE, 5), "sigma_mm": GAUGE_SIGMA}
            for a, b, x in zip(self.first, self.second, lengths.tolist(), strict=True)
        ]
        return Gauge(
            calibrated_at_c=20.0,
            measured_at_c=self.measured_at,
            expansion_per_k=EXPANSION,
            distance=tuple(GaugeDistance.model_validate(line) for line in lines),
        )


def draw_scene(rng: np.random.Generator) -> Scene:
    """Everything but what is wrong: places, order, clock, missing pointings, an ordinary imperfect tracker."""
    points = _targets(rng)
    position = _stations(rng, points)
    yaw = rng.uniform(-np.pi, np.pi, len(position))
    lean = [from_rotation_vector(np.array([*(8e-4 * rng.standard_normal(2)), 0.0])) for _ in yaw]
    rotation = np.stack([tip @ about_z(float(a)) for tip, a in zip(lean, yaw, strict=True)])
    rows, times = _work(rng, len(position), len(points))
    seen = list(dict.fromkeys(rows[:, 1].tolist()))
    setup = _setup(rng, points, position, yaw, seen)
    recording = Recording(
        setup=setup,
        stations=tuple(setup.stations),
        targets=tuple(f"T{t + 1:02d}" for t in seen),
        station=rows[:, 0],
        target=np.array([seen.index(t) for t in rows[:, 1]]),
        face=rows[:, 2],
        repeat=rows[:, 3],
        time=times,
        readings=np.full((len(rows), 3), np.nan),
        covariates=_columns(rng, times),
    )
    construction = misalignment()
    sizes = np.array([p.sigma_from(setup.instrument.prior) for p in construction.parameters])
    placed = points[seen]
    state = State(position, rotation, placed, (sizes * rng.standard_normal(len(sizes)))[None])
    gauge = [seen.index(t) for t in range(24, 28)]
    first, second = np.array(list(combinations(gauge, 2))).T
    measured_at = round(float(rng.uniform(18.0, 27.0)), 1)
    return Scene(recording, state, first, second, np.linalg.norm(placed[first] - placed[second], axis=1), measured_at)


def _targets(rng: np.random.Generator) -> Floats:
    """(28, 3) [m] in the frame of the room."""
    walls = [[0.05, a, z] for z in LEVELS for a in ALONG], [[a, 0.05, z] for z in LEVELS for a in ALONG]
    mesh = np.array(walls[0] + walls[1]) + rng.normal(0.0, 0.1, (24, 3)) * [1.0, 1.0, 0.5]
    turn = from_rotation_vector(rng.uniform(-0.4, 0.4, 3)) @ about_z(float(rng.uniform(-np.pi, np.pi)))
    body = (FRAME - FRAME.mean(axis=0)) @ turn.T
    return np.vstack([np.maximum(mesh, 0.02), body + [0.8, 0.8, 0.45] + rng.normal(0.0, 0.08, 3)])


def _stations(rng: np.random.Generator, points: Floats) -> Floats:
    """(S, 3) [m]: apart from each other, all reflectors within the travel of the elevation axis."""
    found: list[Floats] = []
    count = int(rng.integers(4, 7))
    while len(found) < count:
        place = np.array([*rng.uniform(1.7, 5.6, 2), rng.uniform(1.45, 2.15)])
        arm = points - place
        elevation = np.arctan2(arm[:, 2], np.hypot(arm[:, 0], arm[:, 1])) / DEGREE
        apart = all(np.linalg.norm(place - other) > 0.9 for other in found)
        if apart and elevation.min() > -55.0 and elevation.max() < 77.0:
            found.append(place)
    return np.array(found)


def _work(rng: np.random.Generator, stations: int, targets: int) -> tuple[Ints, Floats]:
    """(n, 4) station, target, face, repeat and times (n,) [s]: each round of a station in a new random order."""
    faces = int(rng.integers(1, 3))
    repeats = int(rng.integers(1, 3)) if faces == 2 else int(rng.integers(1, 4))
    rows, times, clock = [], [], 0.0
    for s in range(stations):
        for repeat in range(1, repeats + 1):
            for target in rng.permutation(targets):
                for face in range(1, faces + 1):
                    rows.append((s, int(target), face, repeat))
                    times.append(round(clock, 1))
                    clock += rng.uniform(10.0, 18.0)
        clock += rng.uniform(900.0, 2400.0)
    share = rng.choice([0.0, rng.uniform(0.0, FACTORS["missing"])])
    kept = rng.random(len(rows)) >= share
    return np.array(rows, dtype=np.int64)[kept], np.array(times)[kept]


def _setup(rng: np.random.Generator, points: Floats, position: Floats, yaw: Floats, seen: list[int]) -> Setup:
    """What a person knows: a floor plan in centimetres, nests, the maker's figures."""
    fixed = bool(rng.random() < FACTORS["fixed"])
    wall = [[1.0, 0.0, 0.0]] * 12 + [[0.0, 1.0, 0.0]] * 12 + [[0.7, 0.7, 0.14]] * 4
    normal = aimed_normals(position, points)[0] if fixed else np.array(wall)
    noise = rng.uniform(*FACTORS["noise"], 2)
    angle = round(0.37 * float(noise[1]), 4)
    plan = [
        Station(position_mm=tuple(np.round(p / MILLIMETRE, -1).tolist()), yaw_deg=round(float(a) / DEGREE, 0))
        for p, a in zip(position, yaw, strict=True)
    ]
    return Setup(
        instrument=Instrument(
            noise=Noise(distance_mm=round(0.003 * float(noise[0]), 5), azimuth_arcsec=angle, elevation_arcsec=angle)
        ),
        stations={f"S{i + 1}": station for i, station in enumerate(plan)},
        targets={
            f"T{t + 1:02d}": Target(nest_normal=tuple(np.round(normal[t], 4).tolist()), reaimed=not fixed)
            for t in sorted(seen)
        },
    )


def _columns(rng: np.random.Generator, times: Floats) -> dict[str, Floats]:
    """Further columns: the air of the weather sensor, sometimes the load on a table."""
    columns: dict[str, Floats] = {}
    hours = times / 3600.0
    if rng.random() < FACTORS["air"]:
        unsteady = rng.random() < FACTORS["unsteady"]
        sway = rng.uniform(-0.6, 0.6) * hours + 0.2 * np.sin(hours * rng.uniform(1.0, 4.0)) if unsteady else 0.0
        columns["air_temperature_c"] = np.round(rng.uniform(18.0, 27.0) + sway + 0.0 * hours, 1)
        columns["air_pressure_hpa"] = np.full(len(times), round(float(rng.uniform(960.0, 1030.0)), 1))
        columns["relative_humidity_pct"] = np.full(len(times), round(float(rng.uniform(30.0, 60.0)), 0))
    if rng.random() < FACTORS["load"]:
        columns["table_load_kg"] = np.round(
            40.0 + 30.0 * np.sin(2 * np.pi * times / rng.uniform(1200, 5000) + rng.uniform(0.0, 6.0)), 1
        )
    return columns
