"""What constants of the instrument do to the tests: closed forms, chances, blind directions."""

from __future__ import annotations

import numpy as np
import pytest

import ltsim as lt
from ltsim.acceptance.prediction import AcceptancePlan
from ltsim.acceptance.spec import asme_tests, iso_two_face_tests, points_around_instrument
from ltsim.core.arrays import Floats
from ltsim.physics.model.construction import misalignment_construction, steering_mirror_construction
from ltsim.recordings.specification import data_sheet_specification

SHEET = data_sheet_specification("leica-at500")
URAD = MICROMETRE = 1e-6


@pytest.fixture(scope="module")
def plan() -> AcceptancePlan:
    return AcceptancePlan(
        tuple(asme_tests(1.5, (2.0, 6.0, 30.0))), misalignment_construction(), SHEET, SHEET.to_instrument().noise
    )


def predicted_errors(plan: AcceptancePlan, name: str, size: float) -> Floats:
    values = np.zeros(plan.construction.n_parameters)
    values[plan.construction.parameter_index(name)] = size
    return values


def test_count_of_the_standards(plan: AcceptancePlan) -> None:
    kinds = [t.kind for t in plan.tests]
    assert kinds.count("two-face") == 36
    assert sum(t.group != "line of sight" for t in plan.tests if t.kind == "length") == 33
    assert len(iso_two_face_tests(1.5)) == 18
    assert len({t.name for t in plan.tests}) == len(plan.tests)


@pytest.mark.parametrize(
    ("name", "per_unit"),
    [
        ("beam-tilt", lambda r, phi: 2 * r),  # azimuth by t / cos(phi) in each face, r cos(phi) of it across the beam
        ("vertical-index", lambda r, phi: 2 * r),
        ("transit-tilt", lambda r, phi: 2 * r * abs(np.sin(phi))),  # azimuth by t tan(phi)
        ("beam-offset-lateral", lambda r, phi: 2.0),
        ("beam-offset-vertical", lambda r, phi: 2.0),
        ("transit-offset", lambda r, phi: 2 * abs(np.sin(phi))),
        ("range-offset", lambda r, phi: 0.0),
        ("range-scale", lambda r, phi: 0.0),
    ],
)
def test_two_face_sensitivities_in_closed_form(plan: AcceptancePlan, name: str, per_unit) -> None:
    """As Muralikrishnan et al. (2009) give them: what flips with the face shows twice."""
    size = 10 * MICROMETRE
    errors = plan.test_errors(predicted_errors(plan, name, size))
    for test, error in zip(plan.tests, errors, strict=True):
        if test.kind == "two-face":
            x, y, z = test.first_point
            r, phi = np.linalg.norm(test.first_point), np.arctan2(z, np.hypot(x, y))
            assert np.hypot(*error) == pytest.approx(per_unit(r, phi) * size, abs=2e-4 * size)


def test_length_sensitivities_in_closed_form(plan: AcceptancePlan) -> None:
    """A scale stretches every length; the zero of the ranges acts by the sum of the ends' cosines."""
    scale, zero = (
        plan.test_errors(predicted_errors(plan, "range-scale", 1e-6)),
        plan.test_errors(predicted_errors(plan, "range-offset", 10 * MICROMETRE)),
    )
    for test, stretched, moved in zip(plan.tests, scale, zero, strict=True):
        if test.kind == "length":
            first, second = np.array(test.first_point), np.array(test.second_point)
            way = second - first
            u = way / np.linalg.norm(way)
            cosines = u @ (second / np.linalg.norm(second) - first / np.linalg.norm(first))
            assert abs(stretched[0]) == pytest.approx(1e-6 * np.linalg.norm(way), rel=1e-4)
            assert abs(moved[0]) == pytest.approx(10 * MICROMETRE * abs(cosines), abs=1e-10)


def test_limits(plan: AcceptancePlan) -> None:
    limits = dict(zip((t.name for t in plan.tests), plan.permissible_errors / MICROMETRE, strict=True))
    assert limits["two-face 6 m level 0 deg"] == pytest.approx(2 * (15 + 6 * 6))
    # the zero of the ranges cancels along one line of sight
    assert limits["line of sight 2 to 6 m"] == pytest.approx(np.hypot(10 + 0.3 * 2, 10 + 0.3 * 6))


def test_chance_to_pass_is_that_of_simulated_instruments(plan: AcceptancePlan) -> None:
    nominal = SHEET.to_instrument()
    prior = np.array([p.prior_sigma_from(nominal.prior) for p in plan.construction.parameters])
    predicted = plan.predict(np.zeros(len(prior)), np.diag(prior**2), n_trials=20_000, seed=3)
    rng = np.random.default_rng(11)
    passed = [
        plan.is_within_limits(
            plan.test_errors(rng.standard_normal(len(prior)) * prior)
            + rng.standard_normal((len(plan.tests), 2)) * plan.error_sigmas
        ).all()
        for _ in range(600)
    ]
    assert np.mean(passed) == pytest.approx(predicted.all_pass_probability, abs=3 * np.sqrt(0.25 / 600))
    assert 0 < predicted.all_pass_probability < min(predicted.pass_probabilities)
    assert set(predicted.pass_probability_by_group) == {t.group for t in plan.tests}


@pytest.mark.parametrize("design", ["source-in-head", "steering-mirror"])
def test_an_instrument_can_pass_and_be_bad(design: str) -> None:
    built = steering_mirror_construction() if design == "steering-mirror" else misalignment_construction()
    nominal = SHEET.to_instrument(design)
    plan = AcceptancePlan(tuple(iso_two_face_tests(1.5)), built, SHEET, nominal.noise)
    prior = np.array([p.prior_sigma_from(nominal.prior) for p in built.parameters])
    values, rms, largest = plan.worst_passing_constants(prior, points_around_instrument())
    assert plan.is_within_limits(plan.test_errors(values)).all()
    assert np.linalg.norm(values / prior) <= 3.001
    assert largest > rms > 10 * MICROMETRE


def test_it_errs_on_a_network_as_predicted(plan: AcceptancePlan) -> None:
    """The worst instrument that passes is simulated in the workshop: targets are off, a good one's are not."""
    prior = np.array([p.prior_sigma_from(SHEET.to_instrument().prior) for p in plan.construction.parameters])
    worst, _, _ = plan.worst_passing_constants(prior, points_around_instrument())
    quiet = {"distance_mm": 1e-4, "distance_ppm": 0.0, "azimuth_arcsec": 1e-3, "elevation_arcsec": 1e-3}
    sizes = []
    for factor in (0.0, 1.0):
        values = zip(plan.construction.parameters, factor * worst, strict=True)
        errors = {"draw": False, **{p.name: float(v / p.si_per_display_unit) for p, v in values}}
        scenario = lt.scenario(
            "paper-workshop-re-aimed",
            {
                "instrument.errors": errors,
                "instrument.noise": quiet,
                "instrument.resolution": {"distance_um": 0.0, "angle_arcsec": 0.0},
            },
        )
        recording, truth = lt.simulate(scenario, seed=1)
        adjustment = lt.adjust(recording)
        places = dict(zip(adjustment.target_names, adjustment.target_points, strict=True))
        points = np.array([places[name] for name in truth.target_names])
        gaps = np.linalg.norm(points[:, None] - points[None], axis=2) - np.linalg.norm(
            truth.target_points[:, None] - truth.target_points[None], axis=2
        )
        sizes.append(float(np.sqrt(np.mean(gaps**2))))
    assert sizes[1] > 5 * MICROMETRE
    assert sizes[1] > 10 * sizes[0]
