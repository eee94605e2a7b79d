"""Effects that a person asks for, estimated beside the calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.calibration.files import read_calibration, write_calibration
from ltsim.cli.main import run
from ltsim.core.errors import ModelError
from ltsim.core.randomness import random_stream
from ltsim.core.units import SI_PER_UNIT
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.range_cyclic import RangeCyclic
from ltsim.physics.effects.station_settling import StationSettling
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings import Recording
from tests.families import family
from tests.networks import drawn, network, with_effect

RATE = 40e-6 / 3600
"""[rad/s] of the vertical index while the tracker stands at S3."""


@pytest.fixture(scope="module")
def drifting() -> Recording:
    recording = network(faces=2, seed=5, values=drawn(misalignment_construction(), 5))[0]
    readings = recording.readings + recording.reading_sigmas() * random_stream(5, "beside").standard_normal(
        recording.readings.shape
    )
    there = recording.station == 2
    clock = recording.time - recording.time[there].min()
    readings[there, 2] -= RATE * clock[there]
    return recording.with_readings(readings)


@pytest.mark.parametrize("wanted", family(["index-drift", "index-drift:S3,law=visit", "index-drift:S3"], 2))
def test_an_effect_is_estimated_with_its_uncertainty_where_and_how_it_acts(drifting: Recording, wanted: str) -> None:
    plain, calibration = (
        lt.calibrate(drifting, advise=False),
        lt.calibrate(drifting, with_effects=[wanted], advise=False),
    )
    (effect,) = calibration.effects
    assert (effect.effect, effect.place_text, effect.n_distinguishable_parameters) == ("index-drift", "S3", 1)
    rate, law = effect.parameters
    assert rate.unit == "urad/h" and law.value == "visit"
    assert isinstance(rate.value, float) and rate.sigma is not None
    assert abs(rate.value - 1e6 * 3600 * RATE) < 4 * rate.sigma < 0.5 * rate.value
    assert effect.chi2_drop == pytest.approx(plain.fit.chi2 - calibration.fit.chi2)
    assert effect.p_value < 1e-6
    assert effect.n_candidates == (1 if "law" in wanted else effect.n_candidates)
    assert "chi-square falls by" in str(calibration)


def test_requested_effects_are_stored_in_the_file(drifting: Recording, tmp_path: Path) -> None:
    calibration = lt.calibrate(drifting, with_effects=["index-drift:S3", "range-cyclic"], advise=False)
    write_calibration(calibration, tmp_path / "cal")
    assert read_calibration(tmp_path / "cal").effects == calibration.effects
    wavelength = calibration.effects[1].parameters[-1]
    assert (wavelength.name, wavelength.unit) == ("wavelength", "mm") and wavelength.sigma is not None


def test_a_law_is_fitted_in_the_words_of_a_diagnosis(drifting: Recording, tmp_path: Path) -> None:
    plain, named = (
        lt.calibrate(drifting, advise=False),
        lt.calibrate(drifting, with_effects=["index-drift:S3,law=visit"]),
    )
    calibration = lt.calibrate(drifting, with_effects=["vertical index ~ station-time:S3"], advise=False)
    (law,), (effect,) = calibration.effects, named.effects
    assert (law.effect, law.place_text, law.n_distinguishable_parameters, law.n_candidates) == (
        "vertical index ~ station-time",
        "S3",
        1,
        1,
    )
    (_, swing), rate = law.parameters, effect.parameters[0]
    hours = drifting.time[drifting.station == 2].max() / 3600 - drifting.time[drifting.station == 2].min() / 3600
    assert swing.name == "swing" and swing.unit == "urad" and swing.sigma is not None and rate.sigma is not None
    assert abs(swing.value) == pytest.approx(abs(rate.value) * hours, rel=1e-3)
    assert swing.sigma == pytest.approx(rate.sigma * hours, rel=1e-3)
    assert law.chi2_drop == pytest.approx(plain.fit.chi2 - calibration.fit.chi2)
    write_calibration(calibration, tmp_path / "cal")
    assert read_calibration(tmp_path / "cal").effects == calibration.effects


def test_a_law_with_separate_coefficients_for_each_set_up_says_so(drifting: Recording) -> None:
    words = "vertical index ~ station-time, separately at each set-up"
    (law,) = lt.calibrate(drifting, with_effects=[words], advise=False).effects
    assert (law.effect, law.place_text, law.n_distinguishable_parameters) == (words, "", len(drifting.stations))
    assert law.sentence.startswith(f"{words}: rms ") and ", swing " in law.sentence


def test_a_curve_is_reported_by_its_amplitude_next_to_an_effect(drifting: Recording) -> None:
    wanted = ["range-cyclic", "vertical index ~ a smooth function of station-time:S3", "position of targets ~ time:T02"]
    _, curve, moved = lt.calibrate(drifting, with_effects=wanted, advise=False).effects
    swing = next(p for p in curve.parameters if p.name == "swing")
    assert swing.sigma is not None and isinstance(swing.value, float)
    assert swing.value > 4 * swing.sigma and curve.n_distinguishable_parameters > 3
    assert [p.name for p in moved.parameters] == ["rms", "swing along x", "swing along y", "swing along z"]


def test_effects_that_the_recording_does_not_determine_are_excluded_and_reported(drifting: Recording) -> None:
    unaimed = lt.calibrate(drifting, with_effects=["smr-incidence"], advise=False)
    assert unaimed.effects[0].n_distinguishable_parameters == 0
    assert "not estimated, because" in unaimed.effects[0].sentence


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ("beam-tilt", "always estimated in a calibration"),
        ("noise-level", "changes the noise, not the readings"),
        ("target-swap", "a blunder in the recording"),
        ("index-drift:S9", "'S9' is not a station"),
        ("index-drift:law=sometimes", "expected one of"),
        ("index-drift:pace=3", "no shape parameter"),
        ("no-such-effect", "no effect"),
        ("beam ~ time", "expected one of distance, azimuth"),
        ("beam tilt ~ time:S9", "'S9' is not a station"),
        ("beam tilt ~ time:pace=3", "belong in its text"),
        ("beam tilt ~ pressure^2", "expected a text such as .* station-time"),
    ],
)
def test_effects_that_cannot_be_fitted_are_refused_in_a_sentence(
    drifting: Recording, wanted: str, message: str
) -> None:
    with pytest.raises(ModelError, match=message):
        lt.calibrate(drifting, with_effects=[wanted])


def test_the_command_line_says_it_and_refuses_it_elsewhere(
    drifting: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lt.write(drifting, tmp_path / "rec")
    assert run(["calibrate", str(tmp_path / "rec"), "--with", "index-drift:S3"]) == 0
    assert "index-drift at S3" in capsys.readouterr().out
    assert run(["calibrate", str(tmp_path / "rec"), "--with", "index-drift", "--method", "distance"]) == 2


@pytest.mark.long
@pytest.mark.parametrize(
    ("wanted", "true", "values"),
    [
        ("station-settling:S3", StationSettling(("S3",), time_constant=480.0), [30e-6, -20e-6, 40e-6]),
        ("range-cyclic", RangeCyclic(wavelength=0.75), [10e-6, 0.0]),
    ],
)
def test_constants_scatter_as_much_as_reported(wanted: str, true: Effect, values: list[float]) -> None:
    truth = getattr(true, true.shape_parameters[0].name) / SI_PER_UNIT[true.shape_parameters[0].unit]
    misses = []
    for seed in range(40):
        calibration = lt.calibrate(with_effect(true, values, seed=seed), with_effects=[wanted], advise=False)
        constant = calibration.effects[0].parameters[-1]
        assert isinstance(constant.value, float) and constant.sigma is not None
        misses.append((constant.value - truth) / constant.sigma)
    assert 0.7 < np.sqrt(np.mean(np.square(misses))) < 1.4
    assert abs(np.mean(misses)) < 0.5


def test_reported_values_of_several_effects_are_those_of_their_common_adjustment(drifting: Recording) -> None:
    drift = "index-drift:S3,law=visit"
    calibration = lt.calibrate(drifting, with_effects=["station-settling:S3,time_constant=10", drift], advise=False)
    alone = lt.calibrate(drifting, with_effects=["station-settling:S3,time_constant=10"], advise=False)
    assert sum(e.chi2_drop for e in calibration.effects) > alone.effects[0].chi2_drop
    reported = [p for e in calibration.effects for p in e.parameters if p.sigma is not None]
    assert calibration.adjustment is not None
    state, spread = (
        calibration.adjustment.state.extra_parameters,
        np.sqrt(np.diag(calibration.adjustment.effect_covariance)),
    )
    unit = [SI_PER_UNIT[p.unit] for p in reported]
    assert [p.value for p in reported] == pytest.approx(state / unit, rel=1e-6)
    assert [p.sigma for p in reported] == pytest.approx(calibration.uncertainty_factor * spread / unit, rel=1e-6)
    parameter = calibration.effects[0].parameters[-1]
    assert (parameter.name, parameter.value, parameter.sigma) == ("time_constant", 10.0, None)


def test_rejected_readings_noise_and_fixed_parameters_stay_in_the_report() -> None:
    recording = with_effect(RangeCyclic(wavelength=0.75), [10e-6, 0.0], noise=2.0)
    readings = recording.readings.copy()
    readings[3, 0] += 1e-3
    calibration = lt.calibrate(
        recording.with_readings(readings),
        with_effects=["range-cyclic"],
        robust=True,
        noise_from_data=True,
        parameters=["beam-tilt", "vertical-index"],
        advise=False,
    )
    assert any(out.row == 4 and out.excluded for out in calibration.outliers) and calibration.is_fixed.any()
    parameters, adjusted = calibration.effects[0].parameters, calibration.adjustment
    assert adjusted is not None
    assert [1e-6 * p.value for p in parameters[:2]] == pytest.approx(
        adjusted.state.extra_parameters, rel=1e-3, abs=1e-9
    )
    for entry, value, least in zip(parameters, (10.0, 0.0, 750.0), (0.5, 1.0, 3.0), strict=True):
        assert abs(entry.value - value) < 4 * entry.sigma
        assert least < entry.sigma < 10 * least
