"""Noise and effects in one recording: neither absorbs the other, and each is placed."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.core.randomness import random_stream
from ltsim.core.units import MICROMETRE
from ltsim.diagnosis.diagnose import diagnose
from ltsim.diagnosis.schema import Finding
from ltsim.physics.effects.target_moved import TargetMoved
from ltsim.recordings.recording import Recording
from tests.networks import network

NOISE_FACTOR = 8.0
DISPLACEMENT = np.array([60.0, -60.0, 30.0]) * MICROMETRE


def with_noisy_and_moved_target(seed: int) -> Recording:
    """Readings of T01 with `NOISE_FACTOR` times their noise, and T06 displaced in the middle of the recording."""
    recording, _ = network(seed=seed, stations=5, faces=2)
    moved = TargetMoved((), ("T06",), time=float(np.median(recording.time)))
    readings = recording.readings + moved.reading_change(adjust(recording).sightings, DISPLACEMENT)
    is_noisy = recording.target == recording.targets.index("T01")
    added_sigma = np.sqrt(NOISE_FACTOR**2 - 1.0) * recording.reading_sigmas()[is_noisy]
    readings[is_noisy] += added_sigma * random_stream(seed, "noisy").standard_normal((int(is_noisy.sum()), 3))
    return recording.with_readings(readings)


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.long) for seed in (2, 3, 4))])
def test_a_moved_target_and_a_noisy_target_are_both_placed(seed: int) -> None:
    findings: tuple[Finding, ...] = diagnose(with_noisy_and_moved_target(seed)).findings
    assert {finding.where.targets for finding in findings} == {("T01",), ("T06",)}
    (moved,) = (finding for finding in findings if finding.effect == "target-moved")
    assert moved.where.targets == ("T06",)
    assert all(finding.evidence.probability > 0.9 for finding in findings)
