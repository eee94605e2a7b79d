"""Constants of instruments against what else is known: by the readings alone, by combinations that they tell."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.prior import prior_sigmas
from ltsim.calibration.evidence import (
    LOG_PRIOR_OF_EFFECT_SIZES,
    RELATIVE_EFFECT_SIZES,
    likelihood_information,
    log_sum_exp,
)
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.instruments import (
    ExpectedInstrumentConstants,
    InstrumentConstantChange,
    find_contradicting_instrument_constants,
    instrument_constants_contradicting_expectation,
)
from ltsim.diagnosis.prior import log_prior_of_each_explanation
from ltsim.physics.model.construction import misalignment_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Instrument, Station, Target
from tests.networks import network


def trackers(count: int, name: str, off: float, faces: int) -> Recording:
    """A workshop measured by several trackers in turn; one constant of the second is `off` [SI]."""
    recording, truth = network(faces=faces, repeats=2)
    names = "ABCD"[:count]
    setup = recording.setup.model_copy(
        update={
            "stations": {s: Station(instrument=names[i % count]) for i, s in enumerate(recording.stations)},
            "instruments": {n: Instrument() for n in names},
        }
    )
    recording, built = recording.replace(setup=setup), misalignment_construction()
    values = np.zeros((count, built.n_parameters))
    values[1, built.parameter_names.index(name)] = off
    state = NetworkState(
        truth.state.station_positions, truth.state.station_rotations, truth.state.target_points, values
    )
    exact = MeasurementModel(recording, built).predict(state)
    return recording.with_readings(
        exact + recording.reading_sigmas() * random_stream(8, "noise").standard_normal(exact.shape)
    )


def test_the_evidence_of_a_constant_is_that_of_the_readings_without_the_prior_of_the_adjustment():
    """Against densities of what the readings tell, N x + noise of covariance N, with and without a change."""
    adjustment = adjust(trackers(2, "beam-offset-lateral", 60e-6, 1), misalignment_construction())
    unit = prior_sigmas(adjustment.recording, adjustment.construction).ravel()
    information = likelihood_information(
        adjustment.state.instrument_parameters.ravel(), adjustment.covariance_of_all_instruments, unit, unit
    )
    expected = 0.04 * np.eye(32)
    changes = tuple(InstrumentConstantChange((1,), k, "nothing") for k in range(16))
    contradicting = instrument_constants_contradicting_expectation(
        adjustment, ExpectedInstrumentConstants(np.zeros(32), expected, changes)
    ).contradictions
    assert contradicting[0].instruments == ("B",)
    k = 16 + adjustment.construction.parameter_names.index(contradicting[0].parameter.name)
    eigenvalues = np.linalg.eigh(information.information_matrix)
    turn = eigenvalues[1][:, eigenvalues[0] > 1e-9 * eigenvalues[0].max()]

    def density(covariance):
        inner = (
            turn.T
            @ (
                information.information_matrix
                + information.information_matrix @ covariance @ information.information_matrix
            )
            @ turn
        )
        y = turn.T @ information.information_vector
        return -0.5 * (y @ np.linalg.solve(inner, y) + np.linalg.slogdet(inner)[1])

    change = np.zeros((32, 32))
    logs = []
    for t, weight in zip(RELATIVE_EFFECT_SIZES, LOG_PRIOR_OF_EFFECT_SIZES, strict=True):
        change[k, k] = t**2
        logs.append(weight + density(expected + change))
    log = float(log_sum_exp(np.array(logs))) - density(expected) + log_prior_of_each_explanation("constant", 16)
    assert contradicting[0].log_evidence == pytest.approx(log, rel=1e-3)


def test_an_index_that_a_single_face_shows_only_with_the_circle_is_reported_as_such():
    """Three trackers in one face: 10 urad of one are far within the prior, and far from what the others share."""
    contradicting = find_contradicting_instrument_constants(
        adjust(trackers(3, "vertical-index", 10e-6, 1), misalignment_construction())
    ).contradictions
    assert contradicting
    first = contradicting[0]
    assert first.instruments == ("B",)
    assert "vertical-index" in {p.name for p in first.evidence_share_by_constant}
    assert sum(first.evidence_share_by_constant.values()) == pytest.approx(1.0, abs=0.05)
    assert abs(first.difference_from_reference) / first.parameter.si_per_display_unit == pytest.approx(10.0, abs=5.0)


def test_a_scale_against_reference_points_is_reported_for_both_trackers():
    """Both are said to be corrected, both are off alike: neither could be without the other."""
    recording, truth = network(faces=2, repeats=2)
    setup = recording.setup.model_copy(
        update={
            "stations": {s: Station(instrument="AB"[i % 2]) for i, s in enumerate(recording.stations)},
            "instruments": {n: Instrument(corrected=True) for n in "AB"},
            "targets": {
                name: Target(known_mm=(1e3 * xyz).tolist(), known_sigma_mm=0.005)
                for name, xyz in list(zip(recording.targets, truth.state.target_points, strict=True))[:6]
            },
        }
    )
    recording, built = recording.replace(setup=setup), misalignment_construction()
    values = np.zeros((2, built.n_parameters))
    values[:, built.parameter_names.index("range-scale")] = 20e-6
    state = NetworkState(
        truth.state.station_positions, truth.state.station_rotations, truth.state.target_points, values
    )
    exact = MeasurementModel(recording, built).predict(state)
    recording = recording.with_readings(
        exact + recording.reading_sigmas() * random_stream(8, "noise").standard_normal(exact.shape)
    )
    contradicting = find_contradicting_instrument_constants(adjust(recording, built)).contradictions
    (both,) = contradicting
    assert (both.instruments, both.parameter.name) == (("A", "B"), "range-scale")
    assert abs(both.difference_from_reference - 20e-6) < 4 * both.sigma


def test_equal_trackers_contradict_nothing_and_p_values_are_bounded():
    assert (
        find_contradicting_instrument_constants(
            adjust(trackers(3, "vertical-index", 0.0, 1), misalignment_construction())
        ).contradictions
        == ()
    )
    contradicting = find_contradicting_instrument_constants(
        adjust(trackers(3, "vertical-index", 40e-6, 2), misalignment_construction())
    ).contradictions
    assert [(c.instruments, c.parameter.name) for c in contradicting] == [(("B",), "vertical-index")]
    assert 0.0 <= contradicting[0].p_value < 1e-6
