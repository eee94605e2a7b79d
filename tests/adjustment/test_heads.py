"""Heads that stand at other heights over their marks at each occupation: observations of the network."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.core.randomness import random_stream
from ltsim.core.units import EARTH_RADIUS
from ltsim.physics.model.measurement import with_spherical_earth_plumb_lines
from ltsim.recordings.native import read_recording, write_recording
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import EXACT_LEVELLING_SIGMA_ARCSEC, Station
from tests.networks import mesh, network


def set_up_anew(seed: int, sigma_mm: float = 1.0) -> tuple[Recording, np.ndarray]:
    """Levelled stations that see reflectors set up anew for each of them, and the heights (S, T) [m] of these."""
    recording, _ = network(seed=seed, stations=4)
    stations = {
        name: Station(levelled=True, levelling_sigma_arcsec=EXACT_LEVELLING_SIGMA_ARCSEC) for name in recording.stations
    }
    declared = {"stations": stations, "height_above_mark_sigma_mm": sigma_mm}
    higher = 1e-3 * sigma_mm * random_stream(seed, "heads").standard_normal((4, len(mesh())))
    change = higher[recording.station, recording.target, None] * [0.0, 0.0, 1.0]
    by_target = adjust(recording).problem.model.linearise(adjust(recording).state).target_derivatives
    readings = recording.readings + np.einsum("nij,nj->ni", by_target, change)
    labels = {"target_setup": tuple(recording.stations[s] for s in recording.station)}
    setup = recording.setup.model_copy(update=declared)
    return recording.replace(setup=setup, readings=readings, labels=labels), higher


def test_heights_that_differ_by_set_up_are_estimated_and_the_network_agrees() -> None:
    recording, higher = set_up_anew(3)
    adjustment = adjust(recording)
    blind = adjust(recording.replace(setup=recording.setup.model_copy(update={"height_above_mark_sigma_mm": None})))
    assert adjustment.dof == blind.dof
    assert blind.sigma0 > 5.0
    assert adjustment.sigma0 == pytest.approx(1.0, abs=0.15)
    pairs = list(dict.fromkeys(zip(recording.target.tolist(), recording.station.tolist(), strict=True)))
    value = np.zeros(higher.shape)
    for (target, station), height in zip(pairs, adjustment.state.extra_parameters, strict=True):
        value[station, target] = height
    gap = value - higher  # what all heights of a mark share is its coordinate, what those of a station do is its own
    gap = gap - gap.mean(axis=0) - gap.mean(axis=1, keepdims=True) + gap.mean()
    assert np.sqrt(np.mean(gap**2)) < 0.1e-3


def test_heads_are_stored_in_a_file(tmp_path) -> None:  # type: ignore[no-untyped-def]
    recording, _ = set_up_anew(4)
    write_recording(recording, tmp_path)
    again = read_recording(tmp_path)
    assert again.setup.height_above_mark_sigma_mm == 1.0
    assert adjust(again).chi2 == pytest.approx(adjust(recording).chi2, rel=1e-6)


def test_plumb_lines_lean_outwards_on_a_sphere() -> None:
    recording, _ = set_up_anew(5)
    curved = recording.replace(setup=recording.setup.model_copy(update={"curved": True}))
    place = np.array([[-300.0, 0.0, 1.0], [300.0, 0.0, 2.0], [0.0, 200.0, 0.0], [0.0, -200.0, 0.0]])
    leaning = [
        with_spherical_earth_plumb_lines(curved, place).station_setup(name).vertical for name in recording.stations
    ]
    np.testing.assert_allclose(np.array(leaning)[:, :2] * EARTH_RADIUS, place[:, :2], atol=1e-6)
    assert with_spherical_earth_plumb_lines(recording, place) is recording
