"""The network calibrator finds what was put in, says how well, and what it cannot know."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy import stats

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.adjustment.remedies.network import PlannedNetwork
from ltsim.adjustment.remedies.undetermined import (
    gains_and_combinations,
    rotate_to_simple_structure,
    undetermined_combinations,
)
from ltsim.calibration.network import calibrate_network
from ltsim.calibration.prior_conflict import log_odds_of_changed_constants
from ltsim.core.errors import ModelError
from ltsim.core.probability import PRIOR_BY_RELATIVE_EFFECT_SIZE, PRIOR_OF_WRONG_INSTRUMENT_CONSTANT
from ltsim.geometry.polar import from_polar, to_polar
from ltsim.geometry.rigid import rigid_motion_jacobian
from ltsim.physics.model.construction import dh_construction, misalignment_construction
from ltsim.recordings.setup import GaugeDistance, Instrument, LengthGauge, Prior, Station
from tests.families import family


def test_without_noise_only_the_priors_pull(make, drawn) -> None:
    truth = drawn(misalignment_construction(), 1, 0)
    calibration = calibrate_network(make(truth, faces=(1, 2), noise=0.0))
    assert calibration.fit.status == "converged"
    # A linear estimator with priors falls short of the truth by C P x exactly, and by nothing else.
    pulled = -calibration.covariance @ (truth / calibration.prior_sigma[0] ** 2)
    assert np.allclose(
        (calibration.estimates[0] - truth) / calibration.sigma[0], pulled / calibration.sigma[0], atol=0.01
    )


def test_calibration_improves_the_criteria_and_an_adjustment_has_no_parameters(make, drawn) -> None:
    recording = make(drawn(misalignment_construction(), 1, 1, share=2.0))
    calibration = calibrate_network(recording)
    plain = lt.adjust(recording)
    assert calibration.criteria is not None
    assert calibration.criteria.distance.improvement_percent > 40
    assert plain.instrument_parameter_names == ()
    assert plain.fit.chi2 > 2 * calibration.fit.chi2
    assert plain.criteria is not None
    assert plain.criteria.distance.after is None
    assert 0.8 < calibration.fit.sigma0 < 1.2


def test_a_single_face_leaves_the_vertical_group_undetermined_and_two_faces_determine_it(make, drawn) -> None:
    truth = drawn(misalignment_construction(), 1, 2)
    calibration, two = calibrate_network(make(truth)), calibrate_network(make(truth, faces=(1, 2)))
    worst = calibration.undetermined[0]
    assert worst.gain < 0.1
    assert {"vertical-index", "elevation-eccentricity-cos"} <= set(worst.combination)
    assert "both faces" in worst.cure
    assert len(two.undetermined) < len(calibration.undetermined)
    # The promise holds: along that combination the two-face recording has the gain that the cure named.
    direction = np.array([worst.combination.get(name, 0.0) for name in calibration.instrument_parameter_names])
    direction /= np.linalg.norm(direction)
    scaled = two.covariance / np.outer(two.prior_sigma, two.prior_sigma)
    promised = float(worst.cure.rsplit(" to ", 1)[1].rstrip(" %)")) / 100
    assert 1 - direction @ scaled @ direction == pytest.approx(promised, abs=0.05)


def test_hypothetical_network_starts_from_the_real_covariance(make, drawn) -> None:
    construction = misalignment_construction()
    adjustment = adjust(make(drawn(construction, 1, 3)), construction)
    covariance, prior = PlannedNetwork.from_adjustment(adjustment).parameter_covariance_and_prior_sigma()
    assert np.allclose(covariance[0], adjustment.first_instrument_covariance, rtol=1e-6, atol=0)
    assert np.array_equal(prior, adjustment.problem.prior.sigma)


def test_null_space_of_the_paper_chain_is_named(make) -> None:
    calibration = calibrate_network(make(np.zeros(16), faces=(1, 2)), dh_construction())
    silent = [c for c in calibration.undetermined if c.gain < 1e-6]
    alone = {next(iter(c.combination)) for c in silent if len(c.combination) == 1}
    without_effect = {f"J2.eZ_{s}" for s in ("c", "sin", "cos", "sin2", "cos2")}
    without_effect |= {f"T.e{axis}_{k}" for axis in "XYZ" for k in range(3)}
    assert without_effect <= alone
    assert {"J1.eY_c", "J1.dY_c"} <= alone  # azimuth index and height: the pose's
    assert all("reference points or a tighter specification may" in c.cure for c in silent)


def test_both_constructions_agree_on_the_targets_of_two_faces(make, drawn) -> None:
    recording = make(drawn(misalignment_construction(), 1, 4), faces=(1, 2))
    first, second = calibrate_network(recording), calibrate_network(recording, dh_construction())
    sigma = np.sqrt(np.einsum("tii->ti", first.target_covariances))
    assert np.abs((first.target_points - second.target_points) / sigma).max() < 0.2


def test_gains_are_shares_of_the_prior_variance() -> None:
    prior = np.array([2.0, 1.0, 3.0])
    covariance = np.diag(prior**2 * [1.0, 0.04, 0.6])
    assert np.allclose(gains_and_combinations(covariance, prior)[0], [0.0, 0.4, 0.96])
    combinations = undetermined_combinations(covariance, prior)
    assert [list(d.coefficients(("a", "b", "c"))) for d in combinations] == [["a"], ["c"]]
    assert combinations[1].gain == pytest.approx(0.4)


def test_simple_rotation_undoes_a_mixture() -> None:
    rng = np.random.default_rng(2)
    mixed = np.eye(9)[:, :4] @ np.linalg.qr(rng.standard_normal((4, 4)))[0]
    simple = rotate_to_simple_structure(mixed)
    assert np.allclose(np.sort(np.abs(simple).max(axis=0)), 1.0, atol=1e-6)
    assert np.allclose(simple.T @ simple, np.eye(4))


def joint_covariance(adjustment, names=None) -> np.ndarray:
    """(3 T, 3 T) of all targets by inner constraints over some of them."""
    at = adjustment.problem.unknowns.target_columns.ravel()
    whole = adjustment.factorised_normals.multiply_by_covariance(np.eye(adjustment.problem.unknowns.n_columns))[
        np.ix_(at, at)
    ]
    return adjustment.with_inner_datum(names).datum.transform_covariance(whole[None], at[None])[0]


def test_inner_constraints_equal_the_pseudo_inverse(make, drawn) -> None:
    adjustment = adjust(make(drawn(misalignment_construction(), 1, 5)), misalignment_construction())
    unknowns, system = adjustment.problem.unknowns, adjustment.solution.system
    rows = system.design[: -adjustment.problem.free_motions.shape[1]]  # without the datum
    # Dense: targets alone, everything else eliminated; the pseudo-inverse of a normal matrix is the datum of all.
    at = unknowns.target_columns.ravel()
    rest = np.setdiff1d(np.arange(unknowns.n_columns), at)
    scale = np.linalg.norm(rows, axis=0)
    scaled = rows / scale
    range_basis, spread, _ = np.linalg.svd(scaled[:, rest], full_matrices=False)
    basis = range_basis[:, spread > 1e-9 * spread[0]]
    free = (scaled[:, at] - basis @ (basis.T @ scaled[:, at])) * scale[at]
    dense = np.linalg.pinv(free.T @ free, rcond=1e-10, hermitian=True)
    inner = joint_covariance(adjustment)
    blocks = adjustment.with_inner_datum().target_covariances
    assert np.allclose(
        blocks, [inner[3 * t : 3 * t + 3, 3 * t : 3 * t + 3] for t in range(28)], atol=1e-12 * inner.max()
    )
    assert np.allclose(inner, dense, atol=1e-5 * np.abs(dense).max())
    assert np.trace(inner) < np.trace(adjustment.target_covariances.sum(axis=0))
    motion = rigid_motion_jacobian(adjustment.state.target_points - adjustment.state.target_points.mean(axis=0))
    assert np.abs(inner @ motion).max() < 1e-6 * np.abs(inner).max()


def test_inner_constraints_over_chosen_targets(make, drawn) -> None:
    adjustment = adjust(make(drawn(misalignment_construction(), 1, 6)), misalignment_construction())
    chosen = np.array([0, 7, 13, 20])
    names = [adjustment.recording.targets[t] for t in chosen]
    inner, whole = joint_covariance(adjustment, names), joint_covariance(adjustment)
    at = (3 * chosen[:, None] + np.arange(3)).ravel()
    assert np.trace(inner[np.ix_(at, at)]) < np.trace(whole[np.ix_(at, at)])
    assert np.trace(inner) > np.trace(whole)
    with pytest.raises(ModelError, match="three that are not on one line"):
        adjustment.with_inner_datum(names[:2])


def test_a_range_offset_of_six_prior_sigmas_is_estimated_as_it_is_and_reported(make, drawn) -> None:
    at, off, others = misalignment_construction().parameter_names.index("range-offset"), [], 0
    for seed in range(6):
        truth = drawn(misalignment_construction(), 26, seed)
        truth[at] = 60e-6
        calibration = calibrate_network(make(truth, faces=(1, 2), trial=seed), recommend_measurements=False)
        notes = [note for note in calibration.notes if "contradict" in note]
        assert notes[0].startswith("range-offset: ")
        assert "declared prior of 10 um: the readings determine the estimate" in notes[0]
        assert calibration.sigma[0, at] < 5e-6
        off.append((calibration.estimates[0, at] - 60e-6) / calibration.sigma[0, at])
        others += len(notes) - 1
    assert np.sum(np.abs(off) > 2.0) <= 1
    assert abs(np.mean(off)) < 0.7
    assert others <= 1


def test_constants_of_the_declared_size_contradict_nothing(make, drawn) -> None:
    for seed in range(5):
        calibration = calibrate_network(
            make(drawn(misalignment_construction(), 27, seed), trial=seed), recommend_measurements=False
        )
        assert not [note for note in calibration.notes if "contradict" in note]


def test_a_scale_of_two_corrected_trackers_is_detected_under_noise_that_is_declared_too_large(make, points) -> None:
    """A correction leaves 0.3 of the guarantee; the noise is told by the readings where they scatter less."""
    scale, estimates = misalignment_construction().parameter_names.index("range-scale"), []
    ends = [(k, k + 12) for k in range(12)]
    lengths = [1e3 * float(np.linalg.norm(points[a] - points[b])) for a, b in ends]
    walls = [
        GaugeDistance(**{"from": f"T{a + 1:02d}", "to": f"T{b + 1:02d}"}, length_mm=length, sigma_mm=0.002)
        for (a, b), length in zip(ends, lengths, strict=True)
    ]
    for seed in range(3):
        values = np.zeros(16)
        values[scale] = 12e-6
        recording = make(values, trial=seed)
        noise = recording.setup.instrument.noise
        noise = noise.model_copy(update={k: 3 * v for k, v in noise.model_dump().items()})
        instruments = {name: Instrument(corrected=True, noise=noise) for name in "AB"}
        stations = {s: Station(instrument="AB"[k % 2]) for k, s in enumerate(recording.stations)}
        setup = recording.setup.model_copy(
            update={"instruments": instruments, "stations": stations, "gauge": LengthGauge(distance=tuple(walls))}
        )
        calibration = calibrate_network(recording.replace(setup=setup), recommend_measurements=False)
        assert calibration.arrays.is_prior_rejected.sum(axis=0)[scale] == 2
        assert calibration.arrays.is_prior_rejected.sum() == 2
        assert np.max(calibration.prior_sigma[:, scale]) == pytest.approx(0.6e-6)
        assert (
            sum("leaves errors of 0.6 ppm: the readings determine the estimate" in note for note in calibration.notes)
            == 2
        )
        assert [round(3 * n.factor) for n in calibration.noise] == [1, 1, 1]
        estimates.append((calibration.estimates[:, scale] - 12e-6) / calibration.sigma[:, scale])
    assert np.sqrt(np.mean(np.square(estimates))) < 1.8


def test_a_nearly_unobservable_constant_contradicts_nothing_where_an_observable_constant_does() -> None:
    """Two changes of five sigmas: of 35 and of 2.5 times what was known of the constant, by a mixture of normals."""
    odds = log_odds_of_changed_constants(np.full(2, 5.0), np.array([7.0, 0.5]) ** -2.0, 48)
    assert odds[0] < 0.0 < odds[1]
    for log_odds, weight in zip(odds, (7.0**-2, 0.5**-2), strict=True):
        spreads = np.sqrt([1.0 + weight * size**2 for size in PRIOR_BY_RELATIVE_EFFECT_SIZE])
        changed = np.sum(np.array(list(PRIOR_BY_RELATIVE_EFFECT_SIZE.values())) * stats.norm.pdf(5.0, scale=spreads))
        assert log_odds == pytest.approx(
            np.log(PRIOR_OF_WRONG_INSTRUMENT_CONSTANT / 48 * changed / stats.norm.pdf(5.0))
        )


def test_a_declared_prior_holds_for_a_corrected_instrument_too(make) -> None:
    recording = make(np.zeros(16))
    instrument = Instrument(corrected=True, prior=Prior(parameters={"beam-tilt": 3.0}))
    calibration = calibrate_network(
        recording.replace(setup=recording.setup.model_copy(update={"instrument": instrument}))
    )
    sizes = dict(zip(calibration.instrument_parameter_names, calibration.prior_sigma[0], strict=True))
    assert sizes["beam-tilt"] == pytest.approx(3e-6)
    assert sizes["range-offset"] == pytest.approx(3e-6)


@pytest.mark.parametrize("seed", family([2, 12, 17]))
def test_errors_of_an_uncalibrated_instrument_move_no_station_in_a_plain_adjustment(seed: int) -> None:
    recording, _ = lt.simulate("paper-workshop", seed=seed)
    adjustment = lt.adjust(recording)
    assert adjustment.verdict is not None
    assert "moves during its occupation" not in adjustment.verdict.sentence
    rows = recording.station == 2
    share = (recording.time[rows] - recording.time[rows].min()) / np.ptp(recording.time[rows])
    readings, sunk = recording.readings.copy(), from_polar(recording.readings[rows])
    readings[rows] = to_polar(sunk + share[:, None] * [0.0, 0.0, 2e-3])
    moved = lt.adjust(recording.with_readings(readings))
    assert moved.verdict is not None
    size = re.match(r"Station S3 moves during its occupation, by (\S+) \+- 5", moved.verdict.sentence)
    assert size is not None
    assert float(size[1]) == pytest.approx(2000.0, abs=25.0)  # errors of the instrument among them
