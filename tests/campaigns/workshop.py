"""A workshop of the paper's size as a fixture: 24 mesh and 4 gauge reflectors, five stations, exact nominal state."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from ltsim.geometry.polar import swap_front_and_raw, to_polar
from ltsim.geometry.rigid import rotation_about_z
from ltsim.physics.model.measurement import NetworkState
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import GaugeDistance, Instrument, LengthGauge, Setup

MESH = 24
GAUGE_SIGMA_MM = 0.0025


def _points() -> np.ndarray:
    spread = np.linspace(0.7, 5.6, 4)
    mesh = []
    for height in (5.9, 2.0, 0.15):
        for k, along in enumerate(spread):
            mesh += [(along, 0.05, height + 0.03 * k), (0.05, along + 0.1, height - 0.02 * k)]
    gauge = [(0.75, 0.62, 0.2), (1.1, 0.65, 0.2), (0.78, 1.0, 0.2), (1.12, 1.08, 0.25)]
    return np.array(mesh + gauge)


def workshop(*, faces: int = 1, gauge: bool = True) -> tuple[Recording, NetworkState]:
    """A recording whose readings are those of an ideal tracker, and its state in the first station's frame."""
    places = np.array([[3, 3, 1.9], [4.6, 1.9, 2.0], [1.9, 4.6, 2.05], [5.3, 4.4, 1.95], [3.9, 5.5, 2.1]])
    turns = np.array([rotation_about_z(np.deg2rad(a)) for a in (200.0, 150.0, -20.0, 75.0, 310.0)])
    rotation = turns[0].T @ turns
    position = (places - places[0]) @ turns[0]
    points = (_points() - places[0]) @ turns[0]
    names = tuple(f"T{k + 1:02d}" for k in range(MESH)) + tuple(f"G{k + 1}" for k in range(4))
    station, face, target = (
        a.ravel() for a in np.meshgrid(np.arange(5), np.arange(1, faces + 1), np.arange(len(names)), indexing="ij")
    )
    local = np.einsum("nji,nj->ni", rotation[station], points[target] - position[station])
    distances = tuple(
        GaugeDistance.model_validate(
            {
                "from": names[MESH + a],
                "to": names[MESH + b],
                "length_mm": 1e3 * float(np.linalg.norm(points[MESH + a] - points[MESH + b])),
                "sigma_mm": GAUGE_SIGMA_MM,
            }
        )
        for a, b in combinations(range(4), 2)
    )
    setup = Setup(
        title="workshop of the tests",
        instrument=Instrument(),
        gauge=LengthGauge(distance=distances) if gauge else None,
    )
    recording = Recording(
        setup=setup,
        stations=tuple(f"S{k + 1}" for k in range(5)),
        targets=names,
        station=station.astype(np.int64),
        target=target.astype(np.int64),
        face=face.astype(np.int64),
        repeat=np.ones(len(station), dtype=np.int64),
        time=30.0 * np.arange(len(station)),
        readings=swap_front_and_raw(to_polar(local), face),
    )
    return recording, NetworkState(position, rotation, points, np.zeros((1, 16)))
