"""Many pointings of one station: the memory of a diagnosis follows them and not their square."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from ltsim.core.randomness import random_stream
from ltsim.diagnosis.diagnose import diagnose
from ltsim.geometry.polar import swap_front_and_raw
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Setup

TARGETS = 10


def single_station(repeats: int) -> Recording:
    """Targets all around, each in both faces again and again."""
    rng = random_stream(3, "one station", repeats)
    ranges = [rng.uniform(*limits, TARGETS) for limits in ((2.0, 8.0), (-3.0, 3.0), (-0.6, 0.6))]
    count = 2 * TARGETS * repeats
    target, face, repeat = (np.ravel(v) for v in np.mgrid[:TARGETS, 1:3, 1 : repeats + 1])
    recording = Recording(
        stations=("S1",),
        targets=tuple(f"T{i}" for i in range(TARGETS)),
        station=np.zeros(count, dtype=np.int64),
        target=target,
        face=face,
        repeat=repeat,
        time=np.arange(float(count)),
        readings=swap_front_and_raw(np.stack(ranges, axis=1)[target], face),
        setup=Setup(),
    )
    return recording.with_readings(recording.readings + recording.reading_sigmas() * rng.standard_normal((count, 3)))


def peak(repeats: int) -> int:
    """Most memory [bytes] at a time."""
    recording = single_station(repeats)
    tracemalloc.start()
    diagnosis = diagnose(recording)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert diagnosis.verdict == "consistent"
    return most


@pytest.mark.long
def test_memory_grows_with_the_pointings_of_a_station_and_not_with_their_square() -> None:
    few, many = peak(6), peak(24)
    assert many < 5 * few  # 4 times the pointings; their square is 16 times as much
