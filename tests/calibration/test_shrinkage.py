"""What is applied of a calibration: never what is expected to make new points worse, however wrong the prior."""

from __future__ import annotations

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment.evaluation.clouds import measured_points, rms_point_error
from ltsim.calibration.files import read_calibration, write_calibration
from ltsim.calibration.network import calibrate_network
from ltsim.calibration.shrinkage import ScaledPrior, held_out_targets, point_error_matrix, point_noise_rms
from ltsim.core.arrays import Floats
from ltsim.core.notation import number_text
from ltsim.core.randomness import random_stream
from ltsim.physics.effects import parameter_text
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings import Recording
from ltsim.recordings.setup import Instrument, Noise, Prior
from tests.families import family
from tests.networks import drawn, mesh, network

BUILT = misalignment_construction()
SIGMA = np.array([p.prior_sigma for p in BUILT.parameters])
FACTORS = (0.1, 0.3, 1.0, 3.0, 10.0, 100.0, 1000.0)
NOISES = (1.0, 10.0, 50.0)


def with_prior(recording: Recording, factor: float, noise: float = 1.0) -> Recording:
    """The recording with priors stated so many times as wide, and so much noise stated."""
    before = Prior()
    prior = Prior(**{name: getattr(before, name) * factor for name in Prior.model_fields if name != "parameters"})
    quiet = Noise()
    louder = Noise(**{name: getattr(quiet, name) * noise for name in Noise.model_fields})
    instrument = Instrument(prior=prior, noise=louder)
    return recording.replace(setup=recording.setup.model_copy(update={"instrument": instrument}))


@pytest.fixture(scope="module")
def evidence() -> tuple[Floats, Floats]:
    """Information (16, 16) of a network of one face on the parameters in prior sigmas, and a new point's error."""
    calibration = calibrate_network(network(seed=1)[0], BUILT, recommend_measurements=False)
    assert calibration.adjustment is not None
    unit = np.outer(SIGMA, SIGMA)
    return np.linalg.inv(calibration.covariance / unit) - np.eye(16), point_error_matrix(calibration.adjustment) * unit


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("factor", FACTORS)
def test_new_points_do_not_become_worse_under_a_wrong_prior(
    evidence: tuple[Floats, Floats], factor: float, noise: float
) -> None:
    """Parameters drawn at the truth's size; the prior stated `factor` times as wide, the noise up to useless."""
    information, by_unit = evidence[0] * factor**2 / noise**2, evidence[1] * factor**2
    root = np.linalg.cholesky(information + 1e-12 * np.trace(information) * np.eye(16))
    rng = random_stream(11, "worth")
    before, after = np.zeros(400), np.zeros(400)
    for trial in range(len(before)):
        true = rng.standard_normal(16) / factor
        prior = ScaledPrior(information, information @ true + root @ rng.standard_normal(16))
        error = prior.shrunk_correction(by_unit)[0] - true
        before[trial], after[trial] = true @ by_unit @ true, error @ by_unit @ error
    ratio = np.sqrt(after / before)
    assert ratio.mean() < 1.02
    assert np.sqrt(after.mean() / before.mean()) < 1.02 + 2 * ratio.std() / np.sqrt(len(ratio))
    if noise == 1.0:
        assert ratio.mean() < 0.25


@pytest.mark.parametrize("factor", [0.1, 10.0, 1000.0])
def test_a_wrong_prior_is_reported_and_the_correction_still_corrects(factor: float) -> None:
    recording, truth = network(seed=5, values=drawn(BUILT, 5))
    right = lt.calibrate(recording, advise=False)
    wrong = lt.calibrate(with_prior(recording, factor), advise=False)
    assert right.correction is not None
    assert wrong.correction is not None
    size = "larger" if factor < 1.0 else "smaller"
    assert not any("than their prior sigmas" in s for s in right.correction.sentences)
    assert any(f"{size} than their prior sigmas" in s for s in wrong.correction.sentences)
    assert wrong.correction.prior_scale * factor == pytest.approx(right.correction.prior_scale, rel=0.35)
    assert right.adjustment is not None
    by_value = point_error_matrix(right.adjustment)
    values = truth.state.instrument_parameters[0]
    missed = wrong.applied_values[0] - values
    assert missed @ by_value @ missed < 0.25**2 * (values @ by_value @ values)


def test_a_recording_that_tells_nothing_corrects_nothing_and_says_so() -> None:
    recording = with_prior(network(seed=4)[0], 1000.0, noise=200.0)
    noise = random_stream(5, "noise").standard_normal(recording.readings.shape)
    calibration = lt.calibrate(
        recording.with_readings(recording.readings + recording.reading_sigmas() * noise), advise=False
    )
    assert calibration.correction is not None
    assert np.linalg.norm(calibration.applied_values / SIGMA) < 0.2 * np.linalg.norm(calibration.estimates / SIGMA)
    assert any("increase the errors of new points" in s for s in calibration.correction.sentences)


def test_the_expected_error_of_a_new_point_is_right_on_average() -> None:
    """Root mean square over instruments drawn from the prior, of the error that is left and of what is told of it."""
    predicted, observed = [], []
    for seed in range(12):
        recording, truth = network(seed=seed, values=drawn(BUILT, seed))
        calibration = lt.calibrate(recording, advise=False)
        assert calibration.correction is not None
        assert calibration.adjustment is not None
        by_value = point_error_matrix(calibration.adjustment)
        gap = calibration.estimates[0] - truth.state.instrument_parameters[0]
        observed.append(gap @ by_value @ gap)
        predicted.append((1e-6 * calibration.correction.corrected_error_um) ** 2)
        assert calibration.correction.corrected_error_um < calibration.correction.uncorrected_error_um
    assert np.sqrt(np.mean(observed) / np.mean(predicted)) == pytest.approx(1.0, abs=0.35)


def test_an_error_of_a_new_point_says_the_noise_of_its_reading() -> None:
    """One definition: the rms distance from the truth in 3D, as simulated points show it, with its reading's noise."""
    errors = []
    for seed in range(6):
        recording, truth = network(seed=seed)
        errors.append(rms_point_error(recording, measured_points(recording), truth.state.target_points))
    calibration = lt.calibrate(recording, advise=False)
    assert calibration.correction is not None
    noise_rms = point_noise_rms(recording, recording.reading_sigmas())
    free = 1 - 6 / (3 * len(recording.targets))  # a rigid fit of each station takes six of its numbers
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(noise_rms * np.sqrt(free), rel=0.05)
    assert calibration.correction.noise_error_um == pytest.approx(1e6 * noise_rms)
    both = np.hypot(calibration.correction.corrected_error_um, calibration.correction.noise_error_um)
    assert f"{number_text(both, 3)} um corrected (" in repr(calibration)


@pytest.mark.parametrize("has_reference", [False, True])
def test_a_target_held_out_is_predicted_as_an_adjustment_without_it_predicts(has_reference: bool) -> None:
    """The closed form against a calibration that never saw the target, nor what is known of its coordinates."""
    recording = network(faces=2, seed=2, values=drawn(BUILT, 2), stations=2)[0]
    if has_reference:
        places = dict(zip(recording.targets, 1e3 * mesh(), strict=True))
        targets = {
            name: target.model_copy(update={"known_mm": tuple(places[name].tolist()), "known_sigma_mm": 0.01})
            for name, target in recording.setup.targets.items()
        }
        recording = recording.replace(setup=recording.setup.model_copy(update={"targets": targets}))
    calibration = calibrate_network(recording, BUILT, recommend_measurements=False)
    assert calibration.adjustment is not None
    held = held_out_targets(calibration.adjustment)[0]
    target = int(
        np.flatnonzero(
            calibration.adjustment.problem.unknowns.target_columns[:, 0]
            >= calibration.adjustment.problem.unknowns.n_retained
        )[0]
    )
    others = recording.select(recording.target != target)
    without = calibrate_network(others, BUILT, recommend_measurements=False)
    shift = held.estimate_shift / calibration.prior_sigma[0]
    assert (calibration.estimates - without.estimates)[0] / calibration.prior_sigma[0] == pytest.approx(shift, abs=2e-3)
    unit = np.outer(calibration.prior_sigma, calibration.prior_sigma)
    assert held.parameter_covariance / unit == pytest.approx(without.covariance / unit, abs=2e-3)


def test_a_term_that_only_local_errors_feign_is_not_applied() -> None:
    """One target read 30 um off across the beam at one face: what it feigns does not hold for the others."""
    recording = network(faces=2, seed=8, stations=1)[0]
    readings = recording.readings.copy()
    for name, size in (("T03", 30e-6), ("T11", -25e-6), ("T20", 30e-6)):
        rows = (recording.target == recording.targets.index(name)) & (recording.face == 1)
        readings[rows, 1] += size / readings[rows, 0]
    calibration = lt.calibrate(recording.with_readings(readings), advise=False)
    assert calibration.correction is not None
    assert calibration.correction.unapplied_parameters
    words = parameter_text(calibration.correction.unapplied_parameters[0])
    assert any("predicted better without the term" in s and words in s for s in calibration.correction.sentences)
    at = [calibration.instrument_parameter_names.index(name) for name in calibration.correction.unapplied_parameters]
    assert np.all(calibration.applied_values[0, at] == 0.0)
    assert np.any(calibration.estimates[0, at] != 0.0)


@pytest.mark.parametrize(("stations", "sparse", "most"), family([(1, True, 0.7), (2, True, 0.8), (1, False, 1.05)]))
def test_terms_excluded_by_default_make_new_points_no_worse(stations: int, sparse: bool, most: float) -> None:
    """Trackers drawn over seeds: six of sixteen terms, a third as large as stated, or all as large as stated.

    Where the prior says what the instrument is, nothing can beat all sixteen estimates; little may be lost.
    """
    six = [name.startswith(("transit", "beam", "vertical")) for name in BUILT.parameter_names]
    errors = []
    for seed in range(10):
        values = drawn(BUILT, seed) * (np.array(six) / 3 if sparse else 1.0)
        calibration = lt.calibrate(network(faces=2, seed=seed, values=values, stations=stations)[0], advise=False)
        assert calibration.adjustment is not None
        form = point_error_matrix(calibration.adjustment)
        errors.append(
            [gap @ form @ gap for gap in (calibration.applied_values[0] - values, calibration.estimates[0] - values)]
        )
    applied, estimated = np.sqrt(np.mean(errors, axis=0))
    assert applied < most * estimated


def test_applied_values_are_stored_in_the_file(tmp_path) -> None:
    recording = with_prior(network(seed=4, values=drawn(BUILT, 4))[0], 10.0)
    calibration = lt.calibrate(recording, advise=False)
    write_calibration(calibration, tmp_path / "cal")
    again = read_calibration(tmp_path / "cal")
    assert again.applied_values == pytest.approx(calibration.applied_values, rel=1e-12)
    assert again.correction is not None
    assert calibration.correction is not None
    assert again.correction.sentences == calibration.correction.sentences
    assert lt.correct(recording, again).readings == pytest.approx(
        lt.correct(recording, calibration).readings, abs=1e-12
    )


@pytest.mark.long
@pytest.mark.parametrize("factor", [0.1, 1.0, 10.0, 1000.0])
@pytest.mark.parametrize("noise", [1.0, 10.0])
def test_whole_calibrations_do_not_make_new_points_worse(factor: float, noise: float) -> None:
    """The same with whole calibrations: python -m pytest -m long -s tests/calibration/test_worth.py."""
    ratios = []
    for seed in range(60):
        values = drawn(BUILT, seed)
        recording, _ = network(values=values)
        with_wrong_prior = with_prior(recording, factor, noise)
        draw = random_stream(seed, "noise").standard_normal(recording.readings.shape)
        calibration = lt.calibrate(
            with_wrong_prior.with_readings(recording.readings + with_wrong_prior.reading_sigmas() * draw), advise=False
        )
        assert calibration.adjustment is not None
        by_value = point_error_matrix(calibration.adjustment)
        gap = calibration.applied_values[0] - values
        ratios.append(np.sqrt((gap @ by_value @ gap) / (values @ by_value @ values)))
    print(f"prior x {factor:g}, noise x {noise:g}: new points err {np.mean(ratios):.3f} of what they did")
    assert np.mean(ratios) < 1.02


def test_what_no_instrument_has_is_not_applied() -> None:
    asked = ScaledPrior(100.0 * np.eye(4), 100.0 * np.array([200.0, -150.0, 300.0, 90.0]))
    applied, _ = asked.shrunk_correction(np.eye(4))
    assert not applied.any()
    assert "no correction is applied" in asked.scale_sentence


def test_without_a_term_that_helps_held_out_targets_nothing_is_applied() -> None:
    nothing = ScaledPrior(np.zeros((0, 0)), np.zeros(0))
    applied, note = nothing.shrunk_correction(np.zeros((0, 0)))
    assert not len(applied) and note == nothing.scale_sentence == ""
    assert nothing.point_errors(np.zeros((0, 0)), applied) == (0.0, 0.0)


def test_a_scale_beyond_the_prior_is_not_followed_where_the_readings_contradict_each_other(
    evidence: tuple[Floats, Floats],
) -> None:
    information, by_unit = evidence
    vector = information @ (6.0 * random_stream(3, "worth").standard_normal(16))
    followed, bent = ScaledPrior(information, vector), ScaledPrior(information, vector, sigma0=2.5)
    assert followed.shrunk_correction(by_unit)[0].any()
    assert "larger than their prior sigmas: prior sigmas 5.6 times as large are most likely" in followed.scale_sentence
    assert not bent.shrunk_correction(by_unit)[0].any()
    assert "contradict each other by 2.5 times their noise" in bent.scale_sentence


def test_an_instrument_without_errors_contradicts_no_prior(evidence: tuple[Floats, Floats]) -> None:
    """Sigmas 0.0001 times as large as declared, and a contradiction, were reported for a clean instrument."""
    information, _ = evidence
    clean = ScaledPrior(information, np.zeros(16))
    assert clean.scale_sentence.startswith("the errors of the instrument are insignificant: their rms is at most ")
