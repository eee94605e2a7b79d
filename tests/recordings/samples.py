"""Small recordings made on the spot, exact to rounding, for the tests of readers and writers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ltsim.core.errors import RecordError
from ltsim.geometry.polar import swap_front_and_raw, to_polar
from ltsim.geometry.rigid import rotation_about_z
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import GaugeDistance, LengthGauge, Setup

POINTS = np.array(
    [
        [0.0, 0.0, 0.1],
        [5.8, 0.4, 0.3],
        [5.5, 5.9, 2.4],
        [0.2, 6.1, 3.1],
        [2.9, 0.2, 4.4],
        [0.6, 3.3, 1.2],
    ]
)
POSITIONS = np.array([[2.2, 2.0, 1.5], [3.6, 4.1, 1.7]])
YAWS = (0.3, -2.1)


def workshop(*, faces: int = 2, turn: np.ndarray | None = None) -> Recording:
    """Two stations, six targets, noise-free raw readings on one or two faces."""
    rows = []
    for s, (position, yaw) in enumerate(zip(POSITIONS, YAWS, strict=True)):
        rotation = rotation_about_z(yaw) if turn is None else rotation_about_z(yaw) @ turn
        polar = to_polar((POINTS - position) @ rotation)
        for t in range(len(POINTS)):
            for face in range(1, faces + 1):
                raw = swap_front_and_raw(polar[t : t + 1], np.array([face]))[0]
                rows.append((s, t, face, *raw))
    table = np.array(rows)
    length = float(np.linalg.norm(POINTS[1] - POINTS[0])) * 1e3
    gauge = LengthGauge(distance=(GaugeDistance(from_="T1", to="T2", length_mm=length, sigma_mm=0.002),))
    count = len(table)
    return Recording(
        setup=Setup(title="workshop", gauge=gauge),
        stations=("S1", "S2"),
        targets=tuple(f"T{i + 1}" for i in range(len(POINTS))),
        station=table[:, 0].astype(np.int64),
        target=table[:, 1].astype(np.int64),
        face=table[:, 2].astype(np.int64),
        repeat=np.ones(count, dtype=np.int64),
        time=np.arange(count) * 11.5,
        readings=table[:, 3:],
    )


def same(first: Recording, other: Recording, tolerance: float = 1e-12) -> None:
    """Assert that two recordings say the same."""
    assert first.setup == other.setup
    assert [first.stations[i] for i in first.station] == [other.stations[i] for i in other.station]
    assert [first.targets[i] for i in first.target] == [other.targets[i] for i in other.target]
    for name in ("face", "repeat"):
        assert np.array_equal(getattr(first, name), getattr(other, name)), name
    assert first.has_clock == other.has_clock
    np.testing.assert_array_equal(first.time, other.time)
    np.testing.assert_allclose(first.readings, other.readings, rtol=tolerance, atol=tolerance)
    assert first.covariates.keys() == other.covariates.keys()
    for name, column in first.covariates.items():
        np.testing.assert_array_equal(column, other.covariates[name])
    assert dict(first.labels) == dict(other.labels)


def outcome(read: Callable[[], Recording]) -> Recording | str:
    """The recording that `read` gives, or the one sentence of its refusal."""
    try:
        return read()
    except RecordError as problem:
        message = str(problem)
        assert "\n" not in message, message
        assert len(message) < 700, message
        return message


def shared(*parts: str) -> Path:
    """A file of the real recordings kept beside the checkout."""
    return Path(__file__).parents[2].parent / "shared" / Path(*parts)
