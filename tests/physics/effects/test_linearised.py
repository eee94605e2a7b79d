"""Signatures that are not linear: the change at large values, and its derivatives, are those of one geometry."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ltsim.adjustment.identification.reading_shifts import ReadingShift
from ltsim.geometry.polar import wrap_angle
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.physics.effects.station_bump import StationBump
from ltsim.physics.effects.target_moved import TargetMoved
from ltsim.physics.model.measurement import sightings_at_state
from ltsim.scene.sightings import Sightings
from tests.networks import network

STEP = 1e-6


@cache
def sightings() -> Sightings:
    recording, truth = network(faces=2)
    return sightings_at_state(recording, truth.state)


CASES = [
    (TargetMoved((), ("T07",), time=0.0), np.array([0.2, -0.3, 0.1])),
    (StationBump(("S2",), (), time=0.0), np.array([0.05, -0.1, 0.02, 0.0, 0.0, 0.0])),
    (ReadingShift("distance", True, ("S3",)), np.array([2.28])),
]


@pytest.mark.parametrize(("effect", "values"), CASES)
def test_derivatives_at_large_values_are_those_of_the_change(effect: LinearEffect, values: np.ndarray) -> None:
    here = sightings()
    derivatives = effect.linearise(here, values)
    assert np.array_equal(derivatives.reading_change, effect.reading_change(here, values))
    for k, step in enumerate(np.eye(len(values)) * STEP):
        change = effect.reading_change(here, values + step) - effect.reading_change(here, values - step)
        change[:, 1:] = wrap_angle(change[:, 1:])
        assert np.abs(change / (2 * STEP) - derivatives.parameter_derivatives[:, :, k]).max() < 1e-6
    assert derivatives.geometry_derivatives is not None
    for axis in range(3):
        moved = [
            replace(here, target_points=here.target_points + sign * STEP * np.eye(3)[axis]) for sign in (1.0, -1.0)
        ]
        change = np.subtract(*(effect.reading_change(place, values) for place in moved))
        change[:, 1:] = wrap_angle(change[:, 1:])
        assert np.abs(change / (2 * STEP) - derivatives.geometry_derivatives[0][:, :, axis]).max() < 1e-5


def test_displaced_reflectors_are_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    whole = TargetMoved.displacement
    monkeypatch.setattr(TargetMoved, "displacement", lambda self, s: calls.append(1) or whole(self, s))
    effect, values = CASES[0]
    effect.linearise(sightings(), values)
    assert len(calls) == 1
