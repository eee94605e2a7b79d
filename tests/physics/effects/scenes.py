"""A small network made by hand: 5 stations, 28 targets, two faces, a clock, a thermometer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.core.randomness import random_stream
from ltsim.physics.effects.effect import Blunder, Effect
from ltsim.scene.sightings import Sightings
from tests.networks import STATIONS, YAWS, mesh, normals

TILT = 0.02
SAMPLES = 9


def rotation(yaw: float, lean: float) -> Floats:
    """A station turned by `yaw` that leans by `lean` [rad]."""
    c, s, cl, sl = np.cos(yaw), np.sin(yaw), np.cos(lean), np.sin(lean)
    upright = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    leaning = np.array([[1.0, 0.0, 0.0], [0.0, cl, -sl], [0.0, sl, cl]])
    turned: Floats = leaning @ upright
    return turned


def scene(*, lean: float = TILT) -> Sightings:
    """Sightings of the workshop: random order, both faces one after the other, 15 s a pointing."""
    points = mesh()
    rows = [
        (s, t, f)
        for s in range(len(STATIONS))
        for t in random_stream(7, "order", s).permutation(len(points))
        for f in (1, 2)
    ]
    station, target, face = np.array(rows, dtype=np.int64).T
    time = 15.0 * np.arange(len(rows)) + 900.0 * station
    normal = normals()
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    normal[-1] = np.nan
    reaimed = np.arange(len(points)) % 2 == 0
    return Sightings(
        station=station,
        target=target,
        instrument=np.zeros(len(rows), dtype=np.int64),
        face=face,
        repeat=np.ones(len(rows), dtype=np.int64),
        time=time,
        station_positions=STATIONS,
        station_rotations=np.stack([rotation(float(y), lean * i) for i, y in enumerate(YAWS)]),
        target_points=points,
        nest_normals=normal,
        is_reaimed=reaimed,
        station_names=tuple(f"S{i + 1}" for i in range(len(STATIONS))),
        target_names=tuple(f"T{i + 1:02d}" for i in range(len(points))),
        covariates={"air_temperature_c": 20.0 + time / 3600.0, "distance_mode": (np.arange(len(rows)) // 3) % 2.0},
    )


def chosen(sightings: Sightings, rows: Bools | list[int]) -> Sightings:
    """Some rows of a scene."""
    names = ("station", "target", "instrument", "face", "repeat", "time")
    columns = {name: getattr(sightings, name)[rows] for name in names}
    covariates = {name: column[rows] for name, column in sightings.covariates.items()}
    return replace(sightings, **columns, covariates=covariates)


def on_face(sightings: Sightings, face: int) -> Sightings:
    """The same pointings, all on one face."""
    return replace(sightings, face=np.full(len(sightings), face))


def corrections(effect: Effect, sightings: Sightings) -> Floats:
    """Corrections (n, 3, p) of front-face coordinates per unit: minus the design, elevation turned on face 2."""
    design = -effect.design(sightings)
    design[:, 2] *= sightings.face_sign[:, None]
    return design


def all_candidates(kind: type[Effect], sightings: Sightings) -> list[Effect]:
    """What a diagnosis tries, and what it mends beforehand."""
    if issubclass(kind, Blunder):
        return list(kind.possible_blunders(sightings))
    return list(kind.candidates(sightings))


def samples(kind: type[Effect], sightings: Sightings) -> Iterator[Effect]:
    """Some instances, spread over all."""
    candidates = all_candidates(kind, sightings)
    for i in np.unique(np.linspace(0, len(candidates) - 1, SAMPLES).round().astype(int)):
        yield candidates[i]


def network_basis(sightings: Sightings, *, scale: bool = False) -> Floats:
    """Orthonormal basis (3n, u) of what poses, targets and one range scale absorb, in lengths across the beam."""
    n, s, t = len(sightings), len(sightings.station_names), len(sightings.target_names)
    design = np.zeros((n, 3, 6 * s + 3 * t + 1))
    pose, point = sightings.pose_derivatives, sightings.target_derivatives
    for i in range(n):
        at = 6 * sightings.station[i]
        design[i, :, at : at + 6] = pose[i]
        at = 6 * s + 3 * sightings.target[i]
        design[i, :, at : at + 3] = point[i]
    if scale:
        design[:, 0, -1] = sightings.range_
    range_basis, size, _ = np.linalg.svd(lengths(sightings, design).reshape(3 * n, -1), full_matrices=False)
    basis: Floats = range_basis[:, size > 1e-10 * size[0]]
    return basis


def lengths(sightings: Sightings, change: Floats) -> Floats:
    """Changes (n, 3, ...) of readings as lengths along, across and above the beam [m]."""
    arm = np.stack([np.ones(len(sightings)), sightings.range_ * np.cos(sightings.elevation), sightings.range_], axis=1)
    scaled: Floats = change * arm.reshape(*arm.shape, *([1] * (change.ndim - 2)))
    return scaled


def remaining_signature(sightings: Sightings, change: Floats, *, scale: bool = False) -> Floats:
    """What poses and targets leave (3n,) of a change (n, 3) of the readings, in lengths."""
    whole = lengths(sightings, change).ravel()
    basis = network_basis(sightings, scale=scale)
    rest: Floats = whole - basis @ (basis.T @ whole)
    return rest
