"""Tests of single readings and of the whole, robust adjustment, variance components, precision."""

import numpy as np
import pytest
from scipy import stats

from ltsim.adjustment import adjust
from ltsim.adjustment.reliability import critical_normalised_residual, noncentrality, p_value_of_tau
from ltsim.adjustment.significance import FAMILY_WISE_LEVEL
from ltsim.adjustment.verdict import FitWithConstants, VerdictCase, verdict_on
from ltsim.core.randomness import random_stream
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Instrument, Setup, Station
from tests.networks import drawn, network

TRACKER = misalignment_construction()


def noisy(seed: int, scale=(1.0, 1.0, 1.0), **options):
    """A network whose noise is the stated one times `scale` by observable."""
    recording, _ = network(values=drawn(TRACKER, seed), **options)
    noise = random_stream(seed, "noise").standard_normal(recording.readings.shape)
    return recording.with_readings(recording.readings + recording.reading_sigmas() * noise * np.array(scale))


def spoiled(recording, where, sizes):
    readings = recording.readings.copy()
    for (i, j), size in zip(where, sizes, strict=True):
        readings[i, j] += size * recording.reading_sigmas()[i, j]
    return recording.with_readings(readings)


# --- tests of single readings -------------------------------------------------------------------------------------


def test_tau_limit_is_that_of_pope():
    # t(9, 2.5 %) = 2.2622: tau = sqrt(10) t / sqrt(9 + t^2).
    tau, dof = np.array([1.90391, stats.norm.isf(0.025)]), np.array([10.0, 100_000.0])
    assert p_value_of_tau(tau, dof, 1) == pytest.approx([0.05, 0.05], rel=1e-4)


def test_the_chance_at_a_limit_is_its_level():
    limit = np.full(2, critical_normalised_residual(50))
    by_data, by_statement = p_value_of_tau(limit, np.array([20.0, np.inf]), 50)
    assert by_statement == pytest.approx(0.01, rel=1e-6)
    assert by_data < by_statement
    assert p_value_of_tau(np.array([3.0]), np.array([1.0]), 50) == 1.0


def test_each_unstable_target_is_tested_with_its_noise():
    rng, times = random_stream(4, "noisy_targets"), 40
    target = np.repeat(np.arange(4), times)
    scatter = np.array([1.0, 1.0, 8.0, 40.0])[target][:, None] * rng.standard_normal((len(target), 3))
    place = np.array([[3.0, 0.0, 0.1], [3.0, 1.5, 0.2], [3.0, 3.0, -0.1], [3.0, 4.5, 0.0]])[target]
    zero, rows = np.zeros(len(target), dtype=np.int64), np.arange(len(target))
    recording = Recording(Setup(), ("S",), ("A", "B", "C", "D"), zero, target, zero + 1, rows, rows * 1.0, place)
    scatter[2 * times + 5, 1] = 8.0 * 6.0  # six of its own standard deviations, one and a half of the loudest
    adjustment = adjust(recording.with_readings(place + scatter * recording.reading_sigmas()))
    assert adjustment.noisy_targets_and_scatter[0].tolist() == [3, 2]
    assert [
        (reading.pointing_index, reading.observable_column)
        for reading in adjustment.flagged_readings(uses_estimated_noise=True)
    ] == [(2 * times + 5, 1)]
    assert adjustment.flagged_readings(uses_estimated_noise=True)[0].p_value < 1e-3


def test_a_large_error_blames_none_of_the_readings_that_it_bends():
    clean = noisy(3)
    adjustment = adjust(spoiled(clean, [(20, 0)], [80.0]), TRACKER)
    assert (
        np.sum(
            np.abs(adjustment.normalised_residuals)
            > critical_normalised_residual(int(adjustment.problem.is_used_reading.sum()))
        )
        > 1
    )
    assert [(reading.pointing_index, reading.observable_column) for reading in adjustment.flagged_readings()] == [
        (20, 0)
    ]
    two = adjust(spoiled(clean, [(20, 0), (47, 2)], [80.0, 9.0]), TRACKER)
    assert [(reading.pointing_index, reading.observable_column) for reading in two.flagged_readings()] == [
        (20, 0),
        (47, 2),
    ]
    assert two.flagged_readings()[1].estimated_error / two.problem.reading_sigmas[47, 2] == pytest.approx(9.0, abs=4.0)


def test_tau_exceeds_its_limit_as_often_as_its_level_says():
    over, count = 0, 0
    for seed in range(40):
        adjustment = adjust(noisy(seed, (3.0, 3.0, 3.0), stations=2), TRACKER)
        tau = adjustment.normalised_residuals[np.nan_to_num(adjustment.redundancy) > 0.2] / adjustment.sigma0
        over += int(np.sum(p_value_of_tau(np.abs(tau), np.full(len(tau), float(adjustment.dof)), 1) < 0.05))
        count += len(tau)
    assert over / count == pytest.approx(0.05, abs=0.015)


def test_an_error_of_the_detectable_size_is_detected_with_its_power():
    clean = adjust(noisy(3), TRACKER)
    needed = noncentrality(alpha=FAMILY_WISE_LEVEL, n_tests=int(clean.problem.is_used_reading.sum()))
    bias = np.sqrt(needed / clean.redundancy)
    rows = random_stream(5, "rows").permutation(len(clean.recording))[:120]
    limit = critical_normalised_residual(int(clean.problem.is_used_reading.sum()))
    n_detected = 0
    for k, i in enumerate(rows):
        j = k % 3
        expected = clean.normalised_residuals[i, j] + bias[i, j] * np.sqrt(clean.redundancy[i, j])
        if k < 6:
            again = adjust(spoiled(clean.recording, [(i, j)], [bias[i, j]]), TRACKER, start_state=clean.state)
            assert again.normalised_residuals[i, j] == pytest.approx(expected, abs=0.05)
        n_detected += expected > limit
    assert n_detected / len(rows) == pytest.approx(0.8, abs=0.13)


# --- robust adjustment --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_many_blunders_are_excluded_and_nothing_else(seed):
    clean = noisy(seed)
    rng = random_stream(seed, "blunders")
    where = [(int(i), int(rng.integers(3))) for i in rng.permutation(len(clean))[:14]]
    sizes = rng.choice([-1, 1], 14) * 10 ** rng.uniform(1.3, 3.5, 14)
    adjustment = adjust(spoiled(clean, where, sizes), TRACKER, robust=True)
    assert adjustment.solution.has_converged
    assert {tuple(map(int, at)) for at in np.argwhere(adjustment.is_rejected_reading)} == set(where)
    use = np.ones((len(clean), 3), dtype=bool)
    use[tuple(np.array(where).T)] = False
    without = adjust(clean, TRACKER, reading_mask=use)
    np.testing.assert_allclose(adjustment.state.target_points, without.state.target_points, atol=1e-9)


def test_clean_recordings_lose_nothing():
    lost = [int(adjust(noisy(seed), TRACKER, robust=True).is_rejected_reading.sum()) for seed in range(15)]
    assert sum(count > 0 for count in lost) <= 2


def test_what_was_screened_out_wrongly_comes_back():
    """A reading that is gross spoils only itself: the two others of its pointing are used again."""
    clean = noisy(1)
    readings = clean.readings.copy()
    readings[20, 0] += 0.05
    plain, robust = (adjust(clean.with_readings(readings), TRACKER, robust=r) for r in (False, True))
    assert np.flatnonzero(plain.is_gross_pointing).tolist() == [20]
    assert not robust.is_gross_pointing.any()
    assert np.argwhere(robust.is_rejected_reading).tolist() == [[20, 0]]


def test_a_wrong_level_of_noise_is_not_taken_for_blunders():
    adjustment = adjust(noisy(2, (6.0, 6.0, 6.0)), TRACKER, robust=True)
    assert adjustment.is_rejected_reading.sum() <= 2


# --- variance components ------------------------------------------------------------------------------------------


def test_noise_of_each_observable_is_estimated():
    truth = (2.0, 0.5, 4.0)
    adjustment = adjust(noisy(4, truth, faces=2), TRACKER, noise_grouping="observable")
    assert [c.observable for c in adjustment.variance_components] == ["distance", "azimuth", "elevation"]
    for component, true in zip(adjustment.variance_components, truth, strict=True):
        assert component.noise_factor == pytest.approx(true, abs=4 * component.noise_factor_sigma)
        assert component.noise_factor_sigma < 0.1 * true
        assert abs(component.noise_factor - 1.0) > 3.0 * component.noise_factor_sigma
    assert adjustment.sigma0 == pytest.approx(1.0, abs=0.02)


def test_noise_of_each_instrument_is_estimated_in_spite_of_blunders():
    recording, _ = network(faces=2)
    stations = {n: Station(instrument="AB"[i % 2]) for i, n in enumerate(recording.stations)}
    setup = recording.setup.model_copy(
        update={"stations": stations, "instruments": {"A": Instrument(corrected=True), "B": Instrument(corrected=True)}}
    )
    recording = recording.replace(setup=setup)
    scale = np.where(recording.instrument[:, None] == 1, 3.0, 1.0)
    noise = random_stream(6, "noise").standard_normal(recording.readings.shape)
    recording = recording.with_readings(recording.readings + recording.reading_sigmas() * noise * scale)
    where = [(5, 0), (40, 1), (111, 2)]
    adjustment = adjust(spoiled(recording, where, [200, -300, 500]), robust=True, noise_grouping="instrument")
    assert set(where) <= {tuple(map(int, at)) for at in np.argwhere(adjustment.is_rejected_reading)}
    assert adjustment.is_rejected_reading.sum() < 8
    for component in adjustment.variance_components:
        assert component.noise_factor == pytest.approx(
            {"A": 1.0, "B": 3.0}[component.instrument], abs=4 * component.noise_factor_sigma
        )


def test_a_group_without_redundancy_keeps_its_noise():
    recording = noisy(3)
    readings = recording.readings.copy()
    readings[1:, 0] = np.where(np.arange(len(readings) - 1) < 2, readings[1:, 0], np.nan)
    gauge = adjust(recording.with_readings(readings), TRACKER, noise_grouping="observable")
    assert gauge.variance_components[0].noise_factor == 1.0
    assert gauge.variance_components[0].noise_factor_sigma == np.inf


# --- verdict ------------------------------------------------------------------------------------------------------


def test_the_verdict_says_to_which_adjustment_a_sigma0_belongs():
    """`Trust the estimated sigma0: 5.989` stood next to `sigma0 is 0.999`."""
    misfit = adjust(noisy(1, (6.0, 6.0, 6.0)), TRACKER)
    sentence = verdict_on(misfit, fit_with_constants=FitWithConstants(9.0 * misfit.dof, misfit.dof)).sentence
    assert "If these constants are estimated, sigma0 is 3.000 (" in sentence
    assert f"fails the global test: sigma0 = {misfit.sigma0:.3f} (" in sentence
    assert "Trust" not in sentence
    assert "is an outlier with the estimated noise." in sentence


@pytest.mark.parametrize(("factor", "suffix"), [(1.0, ""), (0.25, ", so that the noise is smaller than declared")])
def test_constants_that_explain_the_residuals_are_no_failure(factor: float, suffix: str) -> None:
    """The verdict on two faces of an ordinary tracker began with errors, and said `fails the global test`."""
    misfit = adjust(noisy(1, (6.0, 6.0, 6.0)), TRACKER)
    verdict = verdict_on(misfit, fit_with_constants=FitWithConstants(factor * misfit.dof, misfit.dof))
    assert verdict.sentence.startswith("The instrument constants explain the residuals: if they are estimated, sigma0 ")
    assert f"expected){suffix}." in verdict.sentence
    assert f"does not estimate the instrument constants, has sigma0 = {misfit.sigma0:.3f} (" in verdict.sentence
    assert "fail" not in verdict.sentence
    assert verdict.uses_estimated_noise


def test_the_verdict_says_which_test_to_trust():
    clean = next(a for a in (adjust(noisy(s, faces=2), TRACKER) for s in range(9)) if 0.2 < a.p_value < 0.8)
    assert verdict_on(clean).case is VerdictCase.CLEAN
    hidden = adjust(spoiled(clean.recording, [(50, 1)], [9.0]), TRACKER)
    assert verdict_on(hidden).case is VerdictCase.HIDDEN_ERRORS
    assert verdict_on(hidden).sentence.startswith("One reading is an outlier. Trust the test of single readings, ")
    single = adjust(spoiled(clean.recording, [(50, 1), (90, 0)], [60.0, 40.0]), TRACKER)
    assert verdict_on(single).case is VerdictCase.SINGLE_ERRORS
    assert len(single.flagged_readings()) >= 2
    larger = verdict_on(adjust(noisy(1, (3.0, 3.0, 3.0)), TRACKER))
    assert larger.case is VerdictCase.UNEXPLAINED_MISFIT
    assert larger.uses_estimated_noise
    smaller = verdict_on(adjust(noisy(1, (0.3, 0.3, 0.3)), TRACKER))
    assert smaller.case is VerdictCase.SMALLER_NOISE
    assert smaller.uses_estimated_noise
    for adjustment in (larger, smaller):
        first, *others = adjustment.sentence.split(". ")
        assert first.startswith(("The noise is larger", "The instrument constants", "The declared noise is too large"))
        assert any(sentence.startswith("Trust the ") for sentence in others)
        assert ";" not in adjustment.sentence and max(map(len, others)) < 150, "one idea a sentence"
        assert adjustment.sentence.endswith(".")
        assert "\n" not in adjustment.sentence
