"""Noise in windows of time: the evidence is the sum over all sequences of states, and the windows are found."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.noise import NoiseHypothesisSet, noise_hypotheses
from ltsim.diagnosis.noise_estimation import with_estimated_sizes
from ltsim.diagnosis.noise_groups import GroupNoiseMixture, RecordingNoiseLevel
from ltsim.diagnosis.noise_hypothesis import NoiseHypothesis
from ltsim.diagnosis.noise_windows import NOISY_OBSERVABLE_SET_INDICATORS, NOISY_WINDOW_VARIANCE_FACTORS, NoiseWindows
from ltsim.physics.laws.places import target_clusters
from ltsim.physics.model.construction import misalignment_construction
from tests.networks import drawn, network


@pytest.fixture(scope="module")
def space() -> ResidualSpace:
    recording, _ = network(faces=2, values=drawn(misalignment_construction(), 1), seed=1)
    return ResidualSpace.from_adjustment(adjust(recording, misalignment_construction()))


def with_angular_noise(space: ResidualSpace, noisy: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    """Residuals with noise of a size [declared sigmas] added to the angles of some pointings."""
    pointing, kind = np.nonzero(space.is_used_reading)
    rows = np.flatnonzero(noisy[pointing] & (kind > 0))
    added = np.zeros((space.n_equations, 1))
    added[rows, 0] = size * rng.standard_normal(len(rows))
    return space.whitened_residuals + space.project(added)[:, 0]


def most_probable(space: ResidualSpace, residual: np.ndarray) -> NoiseHypothesis:
    """Most probable change of the noise for some residuals."""
    bank = NoiseHypothesisSet.from_residual_space(space, noise_hypotheses(space.sightings))
    return bank.ranked_noise_hypotheses(residual, space.redundancy, np.zeros((space.n_equations, 0)))[0][1]


def test_the_evidence_is_the_sum_over_all_sequences(space: ResidualSpace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ltsim.diagnosis.noise_windows.MAX_CHAIN_STEPS", 5)
    windows = NoiseWindows.from_residual_space(space)[0]
    residual = 1.5 * space.whitened_residuals[:, None]
    ratios = windows._log_likelihood_ratios(residual, space.redundancy)[..., 0].reshape(5, -1)
    logs = []
    for go in windows._state_change_probabilities:
        for states in product((0, 1), repeat=6):  # the state before the first step, and those of the steps
            odds = [np.log(go if a != b else 1.0 - go) for a, b in pairwise(states)]
            logs.append(np.log(0.5) + sum(odds) + np.array(states[1:]) @ ratios)
    count = len(windows._state_change_probabilities) * ratios.shape[1]
    expected = log_sum_exp(np.array(logs).ravel()) - np.log(count)
    assert windows.log_evidence(residual, space.redundancy)[0] == pytest.approx(expected, rel=1e-9)


def test_the_times_of_a_compressor_are_detected(space: ResidualSpace) -> None:
    time = space.sightings.time
    noisy = np.zeros(len(time), dtype=bool)
    for share in (0.1, 0.4, 0.75):
        noisy |= (time > np.quantile(time, share)) & (time <= np.quantile(time, share + 0.1))
    residual = with_angular_noise(space, noisy, 4.0, random_stream(2, "compressor"))
    best = most_probable(space, residual)
    assert best.family_name == "unknown:noise:windows" and best.effect.observables == ("azimuth", "elevation")
    assert (best.effect.is_in_band(space.sightings) == noisy).mean() > 0.95
    fitted = with_estimated_sizes(replace(space, whitened_residuals=residual), space.reading_sigmas, best)
    assert 4.0 < np.sqrt(1.0 + fitted.sizes[0]) < 5.5


def test_noise_of_several_targets_for_a_time_is_located_at_them(space: ResidualSpace) -> None:
    sightings, time = space.sightings, space.sightings.time
    group = max((g for g in target_clusters(sightings) if len(g) <= len(sightings.target_names) // 3), key=len)
    noisy = np.isin(sightings.target, group) & (time > np.quantile(time, 0.3)) & (time <= np.quantile(time, 0.7))
    best = most_probable(space, with_angular_noise(space, noisy, 6.0, random_stream(3, "fan")))
    pattern = best.effect.variance(sightings, np.ones((len(time), 3)), np.ones(1))[:, 1] > 1.0
    assert best.family_name == "unknown:noise:windows"
    assert (pattern == noisy).mean() > 0.95


def test_expected_factors_are_the_mean_over_all_sequences(
    space: ResidualSpace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ltsim.diagnosis.noise_windows.MAX_CHAIN_STEPS", 4)
    monkeypatch.setattr("ltsim.diagnosis.noise_windows.NOISY_STATE_VARIANCE_FACTOR_GRID", NOISY_WINDOW_VARIANCE_FACTORS)
    windows = NoiseWindows.from_residual_space(space)[0]
    residual, sets = 1.5 * space.whitened_residuals, len(NOISY_OBSERVABLE_SET_INDICATORS)
    ratios = windows._log_likelihood_ratios(residual[:, None], space.redundancy)[..., 0].reshape(4, sets, -1)
    logs, added = [], []
    for go, acts, factor in product(
        windows._state_change_probabilities, range(sets), range(len(windows.variance_factor_grid))
    ):
        for states in product((0, 1), repeat=5):
            odds = [np.log(go if a != b else 1.0 - go) for a, b in pairwise(states)]
            noisy = np.array(states[1:])
            logs.append(sum(odds) + noisy @ ratios[:, acts, factor])
            added.append(
                (windows.variance_factor_grid[factor] - 1.0)
                * np.outer(noisy, NOISY_OBSERVABLE_SET_INDICATORS[acts]).ravel()
            )
    weight = np.exp(np.array(logs) - log_sum_exp(np.array(logs)))
    expected = 1.0 + windows.group_indicators.T @ (weight @ np.array(added))
    assert windows.expected_variance_factors(residual, space.redundancy) == pytest.approx(expected, rel=1e-9)


def test_the_variance_of_uncertain_windows_is_averaged(space: ResidualSpace) -> None:
    """By Stein's loss the posterior mean is nearer to the true variance than the most probable windows."""
    time, used = space.sightings.time, space.is_used_reading
    noisy = (time > np.quantile(time, 0.3)) & (time <= np.quantile(time, 0.6))
    truth = np.ones(used.shape)
    truth[noisy, 1:] = 2.0
    losses = []
    for seed in range(6):
        residual = with_angular_noise(space, noisy, 1.0, random_stream(seed, "edges"))
        case = replace(space, whitened_residuals=residual)
        windows = NoiseWindows.from_residual_space(case)[0]
        likeliest = windows.most_likely_effect(residual, space.redundancy)
        sizes = with_estimated_sizes(case, space.reading_sigmas, NoiseHypothesis("windows", likeliest, (0.0,))).sizes
        single = (likeliest.variance(space.sightings, space.reading_sigmas, np.array(sizes)) / space.reading_sigmas**2)[
            used
        ]
        mean = windows.expected_variance_factors(residual, space.redundancy)[: len(single)]
        losses.append([np.sum(truth[used] / f - 1.0 - np.log(truth[used] / f)) for f in (single, mean)])
    single, mean = np.mean(losses, axis=0)
    assert mean < 0.75 * single


def test_a_common_level_and_noisy_groups_have_expected_factors(space: ResidualSpace) -> None:
    level = RecordingNoiseLevel.from_residual_space(space, allows_noise_below_declared=True)
    doubled = level.expected_variance_factors(2.0 * space.whitened_residuals, space.redundancy)
    assert doubled[: int(space.is_used_reading.sum())] == pytest.approx(4.0, rel=0.25)
    assert (doubled[int(space.is_used_reading.sum()) :] == 1.0).all()
    by_target = next(a for a in GroupNoiseMixture.candidates(space) if a.effect.group_kind == "target")
    noisy = space.sightings.target == 0
    residual = with_angular_noise(space, noisy, 10.0, random_stream(4, "group"))
    factors = by_target.expected_variance_factors(residual, space.redundancy)
    of_target = noisy[np.nonzero(space.is_used_reading)[0]]
    rows = len(of_target)
    assert factors[:rows][of_target].min() > 10.0 and factors[:rows][~of_target].max() < 2.0
