"""Diagnosis of recordings of other sizes than a workshop's: one station for hours, a ring of levelled set-ups."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.adjust_size import network as ring_of
from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.diagnose import diagnose
from ltsim.geometry.rigid import rotation_about_z
from ltsim.physics.effects import find_effect
from ltsim.physics.model.construction import misalignment_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState, sightings_at_state
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Instrument, Setup, Station
from ltsim.solve.projection import FactorResidualProjector
from tests.networks import drawn

REFLECTORS = np.array([[8.0, 1.0, 0.5], [2.0, 9.0, 1.0], [-7.0, 3.0, 2.5], [-4.0, -8.0, 0.2], [6.0, -5.0, 3.0]])


def monitoring(epochs: int, rate: float) -> Recording:
    """One station that reads five reflectors again and again, a minute an epoch, while its index drifts [rad/s]."""
    count = len(REFLECTORS)
    rows = epochs * count
    recording = Recording(
        setup=Setup(),
        stations=("S1",),
        targets=tuple(f"T{i + 1}" for i in range(count)),
        station=np.zeros(rows, dtype=np.int64),
        target=np.tile(np.arange(count), epochs),
        face=np.ones(rows, dtype=np.int64),
        repeat=np.repeat(np.arange(1, epochs + 1), count),
        time=60.0 / count * np.arange(rows),
        readings=np.zeros((rows, 3)),
    )
    values = drawn(misalignment_construction(), 2)[None]
    state = NetworkState(np.array([[0.0, 0.0, 1.6]]), rotation_about_z(0.3)[None], REFLECTORS, values)
    exact = MeasurementModel(recording, misalignment_construction()).predict(state)
    recording = recording.with_readings(exact)
    exact = exact + find_effect("index-drift")(law="linear").reading_change(
        sightings_at_state(recording, state), np.array([rate])
    )
    noise = random_stream(6, "monitoring").standard_normal(exact.shape)
    return recording.with_readings(exact + recording.reading_sigmas() * noise)


def ring(stations: int, instruments: int = 4) -> Recording:
    """Levelled set-ups of several instruments round a ring, each of which sees the targets nearest to it."""
    bare = ring_of("ring", stations, stations * 370 // 210, 16 * stations)
    names = [f"I{k + 1}" for k in range(instruments)]
    setup = Setup(
        instruments={name: Instrument() for name in names},
        stations={s: Station(levelled=True, instrument=names[i % instruments]) for i, s in enumerate(bare.stations)},
    )
    return bare.replace(setup=setup, time=20.0 * np.arange(len(bare)) + 600.0 * bare.station)


def knocked(stations: int) -> tuple[Recording, str]:
    """A ring with a target that is knocked half-way through its visits, and its name."""
    recording = ring(stations)
    state = adjust(recording).state
    target = len(recording.targets) // 3
    times = np.sort(recording.time[recording.target == target])
    moved = find_effect("target-moved")((), (recording.targets[target],), time=float(np.mean(times[3:5])))
    change = moved.reading_change(sightings_at_state(recording, state), np.array([150e-6, -120e-6, 90e-6]))
    return recording.with_readings(recording.readings + change), recording.targets[target]


@pytest.mark.long
def test_a_drift_of_the_index_is_named_among_hundreds_of_epochs() -> None:
    rate = 8e-6 / 3600.0
    diagnosis = diagnose(monitoring(100, rate), seed=1, held_out=True)
    first = diagnosis.findings[0]
    assert first.effect == "index-drift"
    assert len(diagnosis.findings) == 1
    (size,) = (e for e in first.parameters if e.unit == "urad/h")
    assert abs(size.value - 8.0) < 4 * size.sigma
    assert diagnosis.fit.after.held_out_rms == pytest.approx(1.0, abs=0.05)
    assert diagnosis.fit.before.held_out_rms > 1.1


@pytest.mark.long
def test_a_knocked_target_is_detected_in_a_levelled_ring_the_sparse_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ltsim.solve.projection.MAX_DESIGN_ENTRIES_FOR_BASIS", 0)
    monkeypatch.setattr("ltsim.diagnosis.null_ensemble.MAX_DENSE_UNKNOWNS", 0)
    recording, target = knocked(26)
    diagnosis = diagnose(recording, seed=1)
    assert isinstance(ResidualSpace.from_adjustment(diagnosis.baseline_adjustment).projector, FactorResidualProjector)
    assert [(f.effect, f.where.targets) for f in diagnosis.findings] == [("target-moved", (target,))]
    assert diagnosis.global_test.search_p_value == pytest.approx(1 / 100)
    assert diagnosis.fit.before.held_out_rms is None  # five more searches of a large network are for who asks for them
