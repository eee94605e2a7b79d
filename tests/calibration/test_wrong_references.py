"""A wrong control point is excluded alike with the instrument's constants estimated or still in the readings."""

from __future__ import annotations

import numpy as np
import pytest

import ltsim as lt
from ltsim.core.randomness import random_stream
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings.recording import Recording
from tests.families import family
from tests.networks import drawn, mesh, network

BUILT = misalignment_construction()
CONTROL = ("T01", "T06", "T12", "T16", "T20", "T25")
SIGMA_MM = 0.005


def recording_with_control(seed: int, wrong: str, error_mm: float) -> Recording:
    recording, _ = network(faces=2, seed=seed, values=drawn(BUILT, seed), stations=4)
    rng, targets = random_stream(seed, "control"), dict(recording.setup.targets)
    for name in CONTROL:
        point = 1e3 * mesh()[recording.targets.index(name)] + SIGMA_MM * rng.standard_normal(3)
        point[0] += error_mm * (name == wrong)
        reference = {"known_mm": tuple(point.tolist()), "known_sigma_mm": SIGMA_MM}
        targets[name] = targets[name].model_copy(update=reference)
    return recording.replace(setup=recording.setup.model_copy(update={"targets": targets, "gauge": None}))


@pytest.mark.parametrize(
    ("seed", "wrong", "error_mm"), family([(5, "T12", 0.08), (6, "T20", 0.08), (7, "T06", 0.0)], 3)
)
def test_adjust_and_calibrate_exclude_the_same_control_point(seed: int, wrong: str, error_mm: float) -> None:
    recording = recording_with_control(seed, wrong, error_mm)
    adjusted, calibrated = lt.adjust(recording), lt.calibrate(recording)
    excluded = [{e.name for e in result.reference_values if e.excluded} for result in (adjusted, calibrated)]
    assert excluded[0] == excluded[1] == ({wrong} if error_mm else set())
    assert adjusted.fit.sigma0 > 1.2  # the constants are still in the readings
    errors = [[e.error for e in r.reference_values if e.name == wrong] for r in (adjusted, calibrated)]
    assert np.abs(np.subtract(*errors)).max() < 0.04
