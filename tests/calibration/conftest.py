"""A small workshop, drawn exactly: corner walls, a gauge, four stations; made without the simulator's room."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ltsim.core.randomness import random_stream
from ltsim.geometry.rigid import rotation_about_z
from ltsim.physics.model.construction import GeometricErrorModel, misalignment_construction
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import GaugeDistance, LengthGauge, Setup

STATIONS = np.array([[3.0, 3.0, 1.9], [4.6, 1.9, 2.0], [1.9, 4.6, 2.1], [5.2, 4.6, 1.8]])
YAW = (0.4, 2.1, -1.9, -0.6)
HEIGHTS = (0.2, 1.6, 2.2, 5.6)
WALL = [[a, 0.02, z] for z in HEIGHTS for a in (1.0, 3.0, 5.0)] + [
    [0.02, a, z] for z in HEIGHTS for a in (0.8, 2.7, 4.9)
]
GAUGE = [[0.8, 0.7, 0.3], [1.1, 0.7, 0.35], [0.8, 1.05, 0.4], [1.15, 1.0, 0.5]]
POINTS = np.array(WALL + GAUGE)
GAUGE_SIGMA = 2e-6

Make = Callable[..., Recording]


def draw(construction: GeometricErrorModel, seed: int, trial: int, share: float = 1.0) -> np.ndarray:
    """Parameters from the prior."""
    sigma = np.array([p.prior_sigma for p in construction.parameters])
    return share * sigma * random_stream(seed, "parameters", trial).standard_normal(construction.n_parameters)


@pytest.fixture(scope="session")
def points() -> np.ndarray:
    """(T, 3) [m] true targets."""
    return POINTS


@pytest.fixture(scope="session")
def poses() -> tuple[np.ndarray, np.ndarray]:
    """True positions (S, 3) and rotations (S, 3, 3)."""
    return STATIONS, np.stack([rotation_about_z(yaw) for yaw in YAW])


@pytest.fixture(scope="session")
def make() -> Make:
    """A function that measures the workshop: parameters, faces, trial number, construction, noise switch."""

    def measured(
        values: np.ndarray,
        *,
        faces: tuple[int, ...] = (1,),
        trial: int = 0,
        construction: GeometricErrorModel | None = None,
        noise: float = 1.0,
    ) -> Recording:
        built = construction or misalignment_construction()
        count = len(POINTS)
        grid = np.array([(s, t, f) for s in range(len(STATIONS)) for f in faces for t in range(count)])
        station, target, face = grid.T
        turn = np.stack([rotation_about_z(yaw) for yaw in YAW])
        local = np.einsum("nji,nj->ni", turn[station], POINTS[target] - STATIONS[station])
        rng = random_stream(5, "noise", trial)
        names = tuple(f"T{t + 1:02d}" for t in range(count))
        lengths = []
        for i in range(count - 4, count):
            for j in range(i + 1, count):
                true = float(np.linalg.norm(POINTS[i] - POINTS[j]))
                reference_lengths = true + noise * GAUGE_SIGMA * rng.standard_normal()
                ends = {"from": names[i], "to": names[j]}
                lengths.append(GaugeDistance(**ends, length_mm=1e3 * reference_lengths, sigma_mm=1e3 * GAUGE_SIGMA))
        readings = built.readings_from_points(local, face, values)
        recording = Recording(
            setup=Setup(gauge=LengthGauge(distance=tuple(lengths))),
            stations=tuple(f"S{s + 1}" for s in range(len(STATIONS))),
            targets=names,
            station=station,
            target=target,
            face=face,
            repeat=np.ones(len(grid), dtype=np.int64),
            time=np.arange(len(grid), dtype=np.float64),
            readings=readings,
        )
        return recording.with_readings(
            readings + noise * recording.reading_sigmas() * rng.standard_normal(readings.shape)
        )

    return measured


@pytest.fixture(scope="session")
def drawn() -> Callable[..., np.ndarray]:
    """`draw`: parameters from the prior."""
    return draw
