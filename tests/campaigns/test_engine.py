"""The batch against the full solver, the judge against the evaluation of single recordings, draws by key."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.evaluation.criteria import evaluate_criteria
from ltsim.campaigns.trial_calibrators import (
    FULL_SOLVER,
    TRIAL_STATUSES,
    WITHOUT_RESULT,
    BatchCalibrator,
    recording_of_trial,
)
from ltsim.campaigns.trial_evaluation import TrialEvaluator
from ltsim.campaigns.true_network import TRIALS_PER_STREAM, TrueNetwork
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.physics.effects.gauge_scale import GaugeScale
from ltsim.physics.model.construction import dh_construction, misalignment_construction
from ltsim.scene.sightings import Sightings
from ltsim.simulation.draws import EffectDistribution
from tests.networks import share_removed, target_error


@dataclass(frozen=True)
class Drift(Effect):
    """Range and azimuth creep with time: enough to test effects of any kind."""

    name = "drift-of-the-tests"
    number = 32
    light_path_stage = LightPathStage.RANGE
    parameters = (
        Parameter("creep", "um/h", "range", 5e-6 / 3600),
        Parameter("turn", "urad/h", "azimuth", 5e-6 / 3600),
    )

    def design(self, sightings: Sightings) -> np.ndarray:
        time = sightings.time
        return np.stack(
            [
                design_from_front_face_corrections(sightings, distance=time),
                design_from_front_face_corrections(sightings, azimuth=time),
            ],
            axis=2,
        )


@dataclass(frozen=True)
class Bent(Drift):
    """The same, but not linear in its values."""

    name = "bent-of-the-tests"

    def reading_change(self, sightings: Sightings, values: np.ndarray) -> np.ndarray:
        linear: np.ndarray = self.design(sightings) @ values
        return linear + linear**2 / 1e-6


@pytest.mark.parametrize("faces", [1, 2])
def test_batch_equals_full_solver(faces: int, make_truth: Callable[..., TrueNetwork]) -> None:
    engine = BatchCalibrator(make_truth(faces=faces), misalignment_construction())
    block = engine.true_network.draw_batch(11, 2)
    calibrated = engine.calibrate(block)
    assert np.all(calibrated.status_indices == 0)
    differences = [engine.largest_solver_difference(block, k, calibrated) for k in range(0, TRIALS_PER_STREAM, 64)]
    assert max(differences) < 2e-4


def test_batch_equals_full_solver_with_errors_ten_times_as_large(make_truth: Callable[..., TrueNetwork]) -> None:
    engine = BatchCalibrator(make_truth(scale=10.0), misalignment_construction())
    block = engine.true_network.draw_batch(11, 0)
    calibrated = engine.calibrate(block)
    assert max(engine.largest_solver_difference(block, k, calibrated) for k in range(0, TRIALS_PER_STREAM, 64)) < 1e-3


def test_batch_equals_full_solver_for_the_paper_chain(make_truth: Callable[..., TrueNetwork]) -> None:
    engine = BatchCalibrator(make_truth(), dh_construction())
    block = engine.true_network.draw_batch(12, 0)
    calibrated = engine.calibrate(block)
    assert max(engine.largest_solver_difference(block, k, calibrated) for k in (0, 100)) < 1e-3


def test_fitted_effects_equal_full_solver(make_truth: Callable[..., TrueNetwork]) -> None:
    sigma = np.array([10e-6, 10e-6]) / 3600
    truth = make_truth(effects=(EffectDistribution(Drift(), np.zeros(2), sigma),))
    engine = BatchCalibrator(truth, misalignment_construction(), (Drift(),))
    block = truth.draw_batch(13, 0)
    fit = engine.batch_network.fit_trials(block.reading_deviations, block.length_errors)
    calibrated = engine.calibrate(block)
    assert max(engine.largest_solver_difference(block, k, calibrated) for k in (0, 100)) < 2e-4
    adjusted = adjust(recording_of_trial(truth, block, 5), misalignment_construction(), effects=(Drift(),))
    spread = np.sqrt(np.diag(adjusted.effect_covariance))
    assert np.all(np.abs(adjusted.state.extra_parameters - fit.effect_values[:, 5]) < 2e-4 * spread)
    assert np.all(np.abs(fit.effect_values[:, 5] - block.effect_values[0][:, 5]) < 5 * spread)


def test_fitted_effect_on_the_reference_lengths_equals_full_solver(make_truth: Callable[..., TrueNetwork]) -> None:
    truth = make_truth()
    engine = BatchCalibrator(truth, misalignment_construction(), (GaugeScale(),))
    block = truth.draw_batch(20, 0)
    block.length_errors[:] += 1e-4 * np.array([d.length_mm * 1e-3 for d in truth.recording.gauge.distance])[:, None]
    calibrated = engine.calibrate(block)
    assert max(engine.largest_solver_difference(block, k, calibrated) for k in (0, 100)) < 2e-4
    scale = engine.batch_network.fit_trials(block.reading_deviations, block.length_errors).effect_values[0]
    assert scale.mean() == pytest.approx(-1e-4, rel=0.02)


def test_chi2_and_z_scores_are_what_the_covariance_says(engine: BatchCalibrator) -> None:
    blocks = [engine.true_network.draw_batch(14, k) for k in range(4)]
    batches = [engine.calibrate(block) for block in blocks]
    chi2 = np.concatenate([f.chi2 for f in batches])
    dof = engine.batch_network.problem.dof
    assert abs(chi2.mean() - dof) < 4 * np.sqrt(2 * dof / len(chi2))
    gap = np.concatenate(
        [f.instrument_values[0] - b.instrument_values[0] for f, b in zip(batches, blocks, strict=True)], axis=1
    )
    z = gap / batches[0].instrument_sigmas[0][:, None]
    assert np.all(np.abs(z.mean(axis=1)) < 4.5 / np.sqrt(len(chi2)))
    assert np.all(np.abs(z.var(axis=1) - 1) < 4.5 * np.sqrt(2 / len(chi2)))


def test_gross_error_goes_to_the_full_solver_and_is_screened(engine: BatchCalibrator) -> None:
    block = engine.true_network.draw_batch(15, 0)
    block.reading_deviations[17, 0, 3] += 5e-3
    calibrated = engine.calibrate(block)
    assert [TRIAL_STATUSES[s] for s in calibrated.status_indices[[2, 3]]] == ["converged", FULL_SOLVER]
    assert np.isfinite(calibrated.instrument_values).all()
    single, _, _ = engine.serial_calibrator.adjust_recording(recording_of_trial(engine.true_network, block, 3))
    assert single is not None and single.is_gross_pointing[17]
    assert np.array_equal(calibrated.instrument_values[:, :, 3], single.state.instrument_parameters)


def test_trial_that_nothing_solves_is_a_failed_row(engine: BatchCalibrator) -> None:
    block = engine.true_network.draw_batch(15, 1)
    block.reading_deviations[:, :, 9] = np.nan
    calibrated = engine.calibrate(block)
    assert TRIAL_STATUSES[calibrated.status_indices[9]] == WITHOUT_RESULT
    assert np.isnan(calibrated.instrument_values[0, :, 9]).all() and np.isnan(calibrated.chi2[9])
    assert np.isfinite(np.delete(calibrated.instrument_values, 9, axis=2)).all()


def test_judge_equals_evaluation_of_single_recordings(engine: BatchCalibrator) -> None:
    truth = engine.true_network
    block = truth.draw_batch(16, 0)
    calibrated, judge = engine.calibrate(block), TrialEvaluator(truth)
    shared = judge.method_independent_columns(block)
    columns = shared | judge.method_columns(block, calibrated, engine.construction)
    for k in (0, 77, 255):
        recording = recording_of_trial(truth, block, k)
        criteria = evaluate_criteria(recording, engine.construction, calibrated.instrument_values[0, :, k]).model_dump()
        for kind in ("distance", "coordinate"):
            for when in ("before", "after"):
                for which in ("mean", "max"):
                    single = criteria[kind][when][f"{which}_um"]
                    assert columns[f"{kind}_{when}_{which}_um"][k] == pytest.approx(single, rel=1e-7)
        shares = share_removed(
            recording,
            truth.state.target_points,
            engine.construction,
            calibrated=calibrated.instrument_values[0, :, k],
            true_parameters=block.instrument_values[0, :, k],
        )
        assert columns["error_raw_um"][k] == pytest.approx(1e6 * shares.raw_rms, rel=1e-7)
        assert columns["error_calibrated_um"][k] == pytest.approx(1e6 * shares.calibrated_rms, rel=1e-7)
        points = truth.state.target_points + calibrated.target_errors[:, :, k]
        assert columns["target_error_um"][k] == pytest.approx(
            1e6 * target_error(points, truth.state.target_points), rel=1e-7
        )


def test_a_draw_depends_on_its_key_alone(make_truth: Callable[..., TrueNetwork]) -> None:
    plain, drifting = make_truth(), make_truth(effects=(EffectDistribution(Drift(), np.zeros(2), np.full(2, 1e-9)),))
    first, other = plain.draw_batch(17, 5), drifting.draw_batch(17, 5)
    assert np.array_equal(first.instrument_values, other.instrument_values)
    assert np.array_equal(first.length_errors, other.length_errors)
    assert not np.array_equal(first.reading_deviations, other.reading_deviations)
    assert not np.array_equal(first.instrument_values, plain.draw_batch(17, 6).instrument_values)
    assert not np.array_equal(first.instrument_values, plain.draw_batch(18, 5).instrument_values)


def test_drawn_readings_are_exact_readings_plus_shift_plus_noise(make_truth: Callable[..., TrueNetwork]) -> None:
    for effect in (Drift(), Bent()):
        truth = make_truth(effects=(EffectDistribution(effect, np.full(2, 2e-9), np.full(2, 1e-9)),))
        silent = replace(
            truth,
            distributions=replace(truth.distributions, noise_sigmas=np.full((*truth.recording.readings.shape,), 1e-15)),
            resolution=np.zeros((1, 3)),
        )
        block = silent.draw_batch(18, 0)
        for k in (0, 200):
            exact = truth.construction.readings_from_points(
                truth.sightings.local_points, truth.recording.face, block.instrument_values[0, :, k]
            )
            exact = exact + effect.reading_change(truth.sightings, block.effect_values[0][:, k])
            gap = silent.trial_readings(block, k) - exact
            gap[:, 1:] = np.arctan2(np.sin(gap[:, 1:]), np.cos(gap[:, 1:]))
            assert np.abs(gap).max() < 5e-12
    noisy = truth.draw_batch(18, 0)
    steps = noisy.reading_deviations[:, 0] + truth.recording.readings[:, 0, None]
    assert np.abs(steps / 1e-7 - np.round(steps / 1e-7)).max() < 1e-6


def test_declared_lengths_carry_their_error_to_every_calibrator(engine: BatchCalibrator) -> None:
    block = engine.true_network.draw_batch(19, 0)
    recording = recording_of_trial(engine.true_network, block, 4)
    before, after = engine.true_network.recording.gauge.distance, recording.gauge.distance
    error = [1e-3 * (b.length_mm - a.length_mm) for a, b in zip(before, after, strict=True)]
    assert error == pytest.approx(block.length_errors[:, 4], abs=1e-15)
    assert np.std(block.length_errors) == pytest.approx(2.5e-6, rel=0.1)
