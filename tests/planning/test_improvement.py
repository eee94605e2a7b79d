"""Expected criteria against repeated simulated calibrations, and against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.evaluation.criteria import evaluate_criteria
from ltsim.core.errors import ModelError
from ltsim.core.randomness import random_stream
from ltsim.physics.effects.range_cyclic import RangeCyclic
from ltsim.physics.model.construction import misalignment_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.planning.expected_precision import DisagreementPredictor, ExpectedPrecision, expected_vector_length
from tests.planning.fixtures import survey

TRIALS = 60


def test_expected_length_of_a_normal_vector() -> None:
    """Half-normal on a line, Rayleigh in a plane, Maxwell in space."""
    variances = np.array([[4.0, 0, 0], [4.0, 4.0, 0], [4.0, 4.0, 4.0]])
    exact = 2.0 * np.sqrt([2 / np.pi, np.pi / 2, 8 / np.pi])
    assert expected_vector_length(variances) == pytest.approx(exact, rel=1e-6)


@pytest.mark.long
def test_expected_criteria_agree_with_simulated_calibrations() -> None:
    """Noise, known lengths, instrument and an effect that the calibration does not know are drawn anew each time."""
    made, construction = survey((1,)), misalignment_construction()
    effect = RangeCyclic(wavelength=0.9)
    information = ExpectedPrecision.from_survey(made)
    expected = DisagreementPredictor.from_expected_precision(information, [effect]).expected_disagreement(
        {"angle errors": 0.5, "range-cyclic": 0.5}
    )
    scale = np.array([0.5 if p.specified_quantity == "angle" else 1.0 for p in construction.parameters])
    clean = made.noise_free_recording(construction)
    size = 0.5 * np.array([p.prior_sigma for p in effect.parameters])
    errors = []
    for trial in range(TRIALS):
        rng = random_stream(11, "trial", trial)
        values = rng.normal(size=16) * information.prior_sigma * scale
        state = NetworkState(made.station_positions, made.station_rotations, made.target_points, values[None])
        readings = MeasurementModel(clean, construction).predict(state)
        readings = readings + effect.reading_change(information.adjustment.sightings, rng.normal(size=len(size)) * size)
        readings = readings + rng.normal(size=readings.shape) * clean.reading_sigmas()
        gauge = clean.gauge
        lengths = tuple(
            d.model_copy(update={"length_mm": d.length_mm + rng.normal() * d.sigma_mm}) for d in gauge.distance
        )
        setup = clean.setup.model_copy(update={"gauge": gauge.model_copy(update={"distance": lengths})})
        recording = clean.with_readings(readings).replace(setup=setup)
        criteria = evaluate_criteria(
            recording, construction, adjust(recording, construction).state.instrument_parameters[0]
        )
        after = criteria.distance.after, criteria.coordinate.after
        assert after[0] is not None
        assert after[1] is not None
        before = criteria.distance.before, criteria.coordinate.before
        sizes = before[0].mean_um, after[0].mean_um, before[1].mean_um, after[1].mean_um
        errors.append([1e-6 * size for size in sizes if size is not None])
    mean, error = np.mean(errors, axis=0), np.std(errors, axis=0) / np.sqrt(TRIALS)
    predicted = [
        expected.distance_disagreement_before[0],
        expected.distance_disagreement_after[0],
        expected.coordinate_disagreement_before[0],
        expected.coordinate_disagreement_after[0],
    ]
    assert np.all(np.abs(mean - predicted) < 3.5 * error + 0.005 * mean)
    assert error[1] < 0.03 * mean[1], "the comparison would not notice a wrong prediction"


def test_requests_are_answered_separately_and_groups_are_named() -> None:
    predictor = DisagreementPredictor.from_expected_precision(ExpectedPrecision.from_survey(survey((1,), 2)))
    many = predictor.expected_disagreement({"range noise": np.array([0.0, 1.0, 2.0])})
    assert np.all(np.diff(many.distance_disagreement_after) > 0)
    prediction = predictor.expected_disagreement({"range noise": 2.0})
    assert many.coordinate_disagreement_after[2] == pytest.approx(
        prediction.coordinate_disagreement_after[0], rel=1e-12
    )
    with pytest.raises(ModelError, match="range noise"):
        predictor.expected_disagreement({"range nose": 1.0})
