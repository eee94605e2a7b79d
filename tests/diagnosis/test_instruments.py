"""Instruments as places: constants that contradict each other or a correction, and combinations that are determined."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.core.notation import with_sigma
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.diagnose import diagnose
from ltsim.diagnosis.instruments import find_contradicting_instrument_constants, instrument_entries
from ltsim.diagnosis.sentences import significant_instrument_constant_texts
from ltsim.physics.model.construction import misalignment_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Instrument, Station
from tests.networks import drawn, network


def trackers(off: float, *, corrected: bool = False) -> Recording:
    """A workshop measured by two trackers in turn; the lateral beam offset of the second is `off` [m]."""
    recording, truth = network(faces=2, repeats=2)
    names = ("A", "B")
    stations = {s: Station(instrument=names[i % 2]) for i, s in enumerate(recording.stations)}
    instruments = {name: Instrument(corrected=corrected) for name in names}
    setup = recording.setup.model_copy(update={"stations": stations, "instruments": instruments})
    recording = recording.replace(setup=setup)
    built = misalignment_construction()
    common = np.zeros(built.n_parameters) if corrected else drawn(built, 3)
    values = np.stack([common, common])
    values[1, built.parameter_names.index("beam-offset-lateral")] += off
    state = NetworkState(
        truth.state.station_positions, truth.state.station_rotations, truth.state.target_points, values
    )
    exact = MeasurementModel(recording, built).predict(state)
    return recording.with_readings(
        exact + recording.reading_sigmas() * random_stream(8, "noise").standard_normal(exact.shape)
    )


@pytest.mark.long
def test_a_tracker_that_is_off_is_reported_with_its_constant_and_size():
    diagnosis = diagnose(trackers(60e-6))
    first = diagnosis.findings[0]
    assert diagnosis.verdict == "mismatch"
    assert (first.effect, first.where.instruments) == ("beam-offset", ("B",))
    (offset,) = first.parameters
    assert offset.name == "beam-offset-lateral"
    assert abs(offset.value - 60.0) < 3 * offset.sigma
    assert "of B differs by" in first.sentence


def test_equal_trackers_contradict_nothing():
    assert (
        find_contradicting_instrument_constants(adjust(trackers(0.0), misalignment_construction())).contradictions == ()
    )


def test_a_corrected_tracker_is_held_to_its_word():
    contradicting = find_contradicting_instrument_constants(
        adjust(trackers(60e-6, corrected=True), misalignment_construction())
    ).contradictions
    assert [(c.instruments, c.parameter.name) for c in contradicting] == [(("B",), "beam-offset-lateral")]
    assert "correction" in contradicting[0].reference_text


def test_combinations_are_determined_where_single_constants_are_not():
    """In one face the vertical index and cosines of the elevation are one: their sum is determined."""
    recording, _ = network(values=drawn(misalignment_construction(), 2), seed=3)
    adjustment = adjust(recording, misalignment_construction())
    (entry,) = instrument_entries(adjustment)
    sigma = {p.name: p.sigma for p in entry.parameters}
    combinations = [c for c in entry.determined if {"vertical-index"} <= set(c.combination)]
    assert combinations
    assert combinations[0].sigma < 0.3 * sigma["vertical-index"]
    weights = np.zeros(len(adjustment.construction.parameter_names))
    for name, weight in combinations[0].combination.items():
        weights[adjustment.construction.parameter_names.index(name)] = weight
    direct = float(np.sqrt(weights @ adjustment.first_instrument_covariance @ weights)) / 1e-6
    assert direct == pytest.approx(combinations[0].sigma, rel=0.5)


@pytest.mark.long
def test_scatter_of_a_tracker_with_the_range_is_a_single_finding():
    recording = trackers(0.0)
    far = recording.readings[:, 0] / recording.readings[:, 0].max()
    scatter = 3.0 * (recording.instrument == 1) * far**2 * recording.reading_sigmas()[:, 0]
    readings = recording.readings.copy()
    readings[:, 0] += scatter * random_stream(9, "scatter").standard_normal(len(recording))
    diagnosis = diagnose(recording.with_readings(readings))
    (first,) = diagnosis.findings
    assert (first.carrier, first.where.observables) == ("noise", ("distance",))
    assert first.where.instruments == ("B",)
    assert "of instrument B" in first.sentence


@pytest.mark.long
def test_separate_curves_of_the_trackers_are_a_single_finding():
    """Two trackers aim off by another function of the distance each, beyond their constants."""
    recording = trackers(0.0)
    way = recording.readings[:, 0] / recording.readings[:, 0].max()
    curve = np.where(recording.instrument == 0, np.sin(5.0 * way), -np.cos(7.0 * way))
    readings = recording.readings.copy()
    readings[:, 1] += 3.0 * recording.reading_sigmas()[:, 1] * curve
    first = diagnose(recording.with_readings(readings)).findings[0]
    assert first.carrier == "azimuth"
    assert first.formula == "azimuth correction follows a smooth function of distance, separately for each instrument"
    assert set(first.where.covariates) == {"distance", "instrument"}


def test_constants_that_are_clear_are_named_as_a_person_would():
    """What one face shows of the index is as large as the index and the circle are first_order_shift."""
    built = misalignment_construction()
    values = drawn(built, 2)
    values[built.parameter_names.index("vertical-index")] = 60e-6
    entries = instrument_entries(adjust(network(values=values, seed=3)[0], built))
    named = significant_instrument_constant_texts(entries)
    assert 0 < len(named) <= 5
    (index,) = (words for words in named if words.startswith("vertical index"))
    assert index.startswith("vertical index, with the constants that the readings do not separate from it, of ")
    combination = next(c for c in entries[0].determined if next(iter(c.combination)) == "vertical-index")
    weight = combination.combination["vertical-index"]
    assert index.endswith(f"{with_sigma(combination.value / weight, combination.sigma / weight)} urad")
