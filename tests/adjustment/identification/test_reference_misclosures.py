"""Sizes of wrong reference values have standard deviations that hold in repeated measurements."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment.identification import FitInput, cause_tests
from ltsim.adjustment.identification.fit import NetworkFit
from ltsim.adjustment.identification.hypothesis import CauseHypothesis, ReferenceOmission
from ltsim.adjustment.identification.hypothesis_library import omissions_of_reference_values
from ltsim.adjustment.identification.reference_misclosures import misclosure_estimate, reference_error_and_covariance
from ltsim.adjustment.reference_values import ReferenceKind, ReferenceValue, reference_values
from ltsim.core.arrays import Floats
from ltsim.core.notation import with_sigma
from ltsim.core.randomness import random_stream
from ltsim.core.units import ARCSECOND, DEGREE, MILLIMETRE
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import LengthGauge, Station, Target
from tests.adjustment.identification.test_selection import CONTROL, hall, identified
from tests.families import family
from tests.networks import YAWS, drawn, network

POINT_SIGMA, LENGTH_SIGMA, SCALE_SIGMA, YAW_SIGMA = 0.01, 0.0018, 5.0, 2.0
"""Standard deviations of coordinates [mm], lengths [mm], their common scale [ppm] and the azimuth zero [arcsec]."""
ERRORS: dict[ReferenceKind, tuple[str, Floats, float]] = {
    "point": ("T12", 0.4 * np.array([0.6, 0.0, -0.8]), MILLIMETRE),
    "length": ("T25-T28", np.array([0.1]), MILLIMETRE),
    "yaw": ("S2", np.array([80.0]), ARCSECOND),
}
"""Name of the wrong reference value, its error, and the unit of the error in SI, by kind."""


def measured(kind: ReferenceKind, trial: int) -> Recording:
    """Network with noise of all readings, reference values and instrument parameters, and one wrong reference value."""
    construction = misalignment_construction()
    recording, truth = network(faces=2, seed=1000 + trial, stations=4, values=drawn(construction, 1000 + trial))
    noise, error = random_stream(1000 + trial, "references"), ERRORS[kind][1]
    points = dict(zip(recording.targets, 1e3 * truth.state.target_points, strict=True))
    coordinate_noise = {name: POINT_SIGMA * noise.standard_normal(3) for name in CONTROL}
    scale, lengths = 1e-6 * SCALE_SIGMA * noise.standard_normal(), []
    for length in recording.setup.gauge.distance:
        is_wrong = kind == "length" and f"{length.from_}-{length.to}" == ERRORS[kind][0]
        change = scale * length.length_mm + LENGTH_SIGMA * noise.standard_normal() + (error[0] if is_wrong else 0.0)
        lengths.append(length.model_copy(update={"length_mm": length.length_mm + change}))
    if kind == "point":
        coordinate_noise["T12"] = coordinate_noise["T12"] + error
    references = {
        name: Target(known_mm=tuple((points[name] + change).tolist()), known_sigma_mm=POINT_SIGMA)
        for name, change in coordinate_noise.items()
    }
    stations = {}
    if kind == "yaw":
        yaw = YAWS[1] / DEGREE + (YAW_SIGMA * noise.standard_normal() + error[0]) / 3600
        stations["S2"] = Station(levelled=True, yaw_deg=yaw, yaw_sigma_arcsec=YAW_SIGMA)
    gauge = LengthGauge(distance=tuple(lengths), sigma_scale_ppm=SCALE_SIGMA)
    targets = {**recording.setup.targets, **references}
    return recording.replace(
        setup=recording.setup.model_copy(update={"targets": targets, "gauge": gauge, "stations": stations})
    )


def fit_without(recording: Recording, kind: ReferenceKind) -> tuple[NetworkFit, CauseHypothesis]:
    """Network without the wrong reference value of a kind, and the hypothesis of its omission."""
    fit_input = FitInput(recording, misalignment_construction())
    whole = NetworkFit.from_start(fit_input)
    assert whole is not None
    values = [
        value
        for value in reference_values(whole.problem, whole.state)
        if (value.kind, value.name) == (kind, ERRORS[kind][0])
    ]
    (hypothesis,) = omissions_of_reference_values(recording, values)
    fit = NetworkFit.from_start(fit_input, [hypothesis])
    assert fit is not None
    return fit, hypothesis


@pytest.mark.parametrize("sigma_mm", [0.1, 0.01, 1e-6])
def test_standard_deviation_of_a_wrong_point_combines_prediction_and_declared_value(sigma_mm: float) -> None:
    recording, _ = hall()
    targets = dict(recording.setup.targets)
    for name in CONTROL:
        targets[name] = targets[name].model_copy(update={"known_sigma_mm": sigma_mm})
    off = np.array(targets["T12"].known_mm) + [0.6, 0.0, -0.8]
    targets["T12"] = targets["T12"].model_copy(update={"known_mm": tuple(off.tolist())})
    selection = identified(recording.replace(setup=recording.setup.model_copy(update={"targets": targets})))
    (test,) = cause_tests(selection)
    fit = selection.fit
    misclosure = (off * MILLIMETRE) - fit.state.target_points[recording.targets.index("T12")]
    covariance = fit.adjustment.target_covariances[recording.targets.index("T12")] + (
        sigma_mm * MILLIMETRE
    ) ** 2 * np.eye(3)
    direction = misclosure / np.linalg.norm(misclosure)
    assert test.estimate is not None and test.sigma is not None
    assert test.estimate == pytest.approx(np.linalg.norm(misclosure) / MILLIMETRE)
    assert test.sigma == pytest.approx(np.sqrt(direction @ covariance @ direction) / MILLIMETRE, rel=1e-6)
    assert f"T12 are off by {with_sigma(test.estimate, test.sigma, 'mm')}: check them." in test.sentence


@pytest.mark.parametrize("kind", family(list(ERRORS), 2))
def test_misclosures_of_a_wrong_reference_value_have_their_covariance(kind: ReferenceKind) -> None:
    chi2 = []
    for trial in range(30):
        fit, hypothesis = fit_without(measured(kind, trial), kind)
        computed = reference_error_and_covariance(fit, hypothesis)
        assert computed is not None
        error, covariance = computed[0] - ERRORS[kind][1] * ERRORS[kind][2], computed[1]
        chi2.append(float(error @ np.linalg.solve(covariance, error)))
    n_components = len(ERRORS[kind][1])
    assert abs(np.mean(chi2) / n_components - 1.0) < 3.0 * np.sqrt(2.0 / (n_components * len(chi2)))


@pytest.mark.long
@pytest.mark.parametrize("kind", ["point", "length"])
def test_intervals_of_two_standard_deviations_contain_the_error_in_95_percent(kind: ReferenceKind) -> None:
    """A fraction of 200 trials has a standard deviation of 1.5 %."""
    size, is_inside = float(np.linalg.norm(ERRORS[kind][1])), []
    for trial in range(200):
        recording = measured(kind, trial).replace(time=10.0 * np.arange(len(measured(kind, trial))), has_clock=True)
        (test,) = [t for t in cause_tests(identified(recording)) if t.kind == "reference-value"]
        assert test.estimate is not None and test.sigma is not None
        is_inside.append(abs(test.estimate - size) < 2.0 * test.sigma)
    assert 0.91 < np.mean(is_inside) < 0.99


def test_a_value_without_equations_has_no_standard_deviation() -> None:
    fit = NetworkFit.from_start(FitInput(hall()[0], misalignment_construction()))
    assert fit is not None
    value = ReferenceValue("level", "S2", "", np.full(2, 1e-5), np.zeros(2))
    hypothesis = CauseHypothesis("reference-value", "level", ("S2",), (), 0.0, ReferenceOmission(value), "S2")
    assert reference_error_and_covariance(fit, hypothesis) is None
    assert misclosure_estimate(fit, hypothesis) == {"estimate": 0.0, "sigma": None, "unit": "arcsec"}
