"""No recording that can be adjusted ends in a traceback, and little data names nothing with certainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ltsim.diagnosis.diagnose import diagnose
from ltsim.diagnosis.files import write_diagnosis
from ltsim.recordings.recording import Recording
from tests.networks import network


def few(rows: list[int] | np.ndarray) -> Recording:
    """Some pointings of the reference workshop, with what they name alone."""
    recording, _ = network(seed=4)
    rows = np.asarray(rows)
    stations, station = np.unique(recording.station[rows], return_inverse=True)
    targets, target = np.unique(recording.target[rows], return_inverse=True)
    setup = recording.setup.model_copy(update={"gauge": None})
    return replace(
        recording,
        setup=setup,
        stations=tuple(recording.stations[s] for s in stations),
        targets=tuple(recording.targets[t] for t in targets),
        station=station.astype(np.int64),
        target=target.astype(np.int64),
        face=recording.face[rows],
        repeat=recording.repeat[rows],
        time=recording.time[rows],
        readings=recording.readings[rows],
    )


FEW = {
    "one station, one face, once": np.arange(28),
    "two pointings": [0, 1],
    "one pointing": [0],
    "four pointings of four targets": [0, 1, 2, 3],
    "two stations": np.arange(56),
}


@pytest.mark.long
@pytest.mark.parametrize("rows", FEW.values(), ids=FEW)
def test_little_data_is_written_down_and_names_nothing(rows, tmp_path):
    diagnosis = diagnose(few(rows))
    content = write_diagnosis(diagnosis, tmp_path)
    assert content.verdict == "consistent"
    assert (tmp_path / "diagnosis.json").is_file()


@pytest.mark.long
def test_a_network_high_above_its_datum_without_a_clock_is_diagnosed():
    recording, truth = network(seed=5, stations=3)
    targets = {
        name: recording.target_setup(name).model_copy(
            update={"known_mm": tuple(1e3 * (truth.state.target_points[i] + [0.0, 0.0, 400.0])), "known_sigma_mm": 0.01}
        )
        for i, name in enumerate(recording.targets[:4])
    }
    setup = recording.setup.model_copy(update={"targets": {**recording.setup.targets, **targets}})
    readings = recording.readings.copy()
    readings[:, 1] += 9e-6 * np.sin(3 * readings[:, 1])
    diagnosis = diagnose(recording.replace(setup=setup, readings=readings, has_clock=False, time=np.arange(84.0)))
    assert diagnosis.final_adjustment.state.target_points[:, 2].min() > 390.0
    assert diagnosis.verdict == "mismatch"
    assert all(p.unit not in ("s", "min", "h") for f in diagnosis.findings for p in f.parameters)
