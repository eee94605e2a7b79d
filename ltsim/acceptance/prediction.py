"""Prediction of acceptance tests: errors, sensitivities, probabilities to pass, and undetected point errors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ltsim.acceptance.files import (
    AcceptanceFile,
    InstrumentConstantSensitivity,
    TestOutcome,
    WorstPassingInstrument,
    group_summaries,
)
from ltsim.acceptance.spec import AcceptanceSettings, AcceptanceTest, points_around_instrument
from ltsim.core.arrays import Bools, Floats
from ltsim.core.randomness import random_stream
from ltsim.core.units import MICROMETRE
from ltsim.geometry.polar import beam_frame_axes, components_across_beam, from_polar, to_polar
from ltsim.geometry.rigid import remove_rigid_motion
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.recording import reading_sigmas_from_noise
from ltsim.recordings.setup import Noise
from ltsim.recordings.specification import Specification

MAX_NEGLIGIBLE_FRACTION_OF_LIMIT = 1e-6
"""Change of a test's error, as a fraction of its limit, that counts as rounding. A test counts as dependent on an
instrument constant if the constant, with the size of its prior standard deviation, changes the error by more."""
MAX_NEGLIGIBLE_FRACTION_OF_PRIOR_SIGMA = 1e-6
"""Smallest size of an instrument constant that is not replaced by zero, as a fraction of its prior standard deviation.
"""
MAX_CONSTANT_SIZE_IN_PRIOR_SIGMAS = 3.0
"""Largest size of an instrument constant, in prior standard deviations, in the search for the instrument with the
largest point errors that passes all tests."""


@dataclass(frozen=True)
class AcceptancePlan:
    """Plan of acceptance tests with their limits, for an instrument with a given geometric error model."""

    tests: tuple[AcceptanceTest, ...]
    """Acceptance tests of the plan."""
    construction: GeometricErrorModel
    """Geometric error model of the instrument."""
    specification: Specification
    """Manufacturer's specification with the limits of the tests."""
    declared_noise: Noise
    """Declared standard deviations of the readings."""

    @cached_property
    def _test_end_points(self) -> tuple[Floats, Floats]:
        """First and second points of all tests, each of shape (tests, 3) [m]."""
        return np.array([t.first_point for t in self.tests]), np.array([t.second_point for t in self.tests])

    @cached_property
    def is_length_test(self) -> Bools:
        """Mask (tests,) that is True for the tests of a length, and False for two-face tests."""
        return np.array([t.kind == "length" for t in self.tests])

    @cached_property
    def permissible_errors(self) -> Floats:
        """Maximum permissible errors (tests,) [m] by the specification."""
        first, second = self._test_end_points
        limit = self.specification.two_face_limits(first)
        chosen = self.is_length_test
        limit[chosen] = self.specification.length_limits(first[chosen], second[chosen])
        return limit

    def test_errors(self, constants: Floats) -> Floats:
        """Exact errors (tests, 2) [m] of the tests without noise, for an instrument with these `constants`.

        The row of a length contains measured minus true length, and 0. The row of a two-face test contains the point
        measured in face 1 minus that in face 2, to the left and upwards as seen from the instrument.
        """
        first, second = self._test_end_points
        front = np.ones(len(first), dtype=np.int64)
        points = from_polar(self.construction.readings_from_points(first, front, constants))
        far_points = from_polar(
            self.construction.readings_from_points(second, np.where(self.is_length_test, 1, 2), constants)
        )
        errors = np.zeros((len(first), 2))
        errors[:, 0] = np.linalg.norm(far_points - points, axis=1) - np.linalg.norm(second - first, axis=1)
        errors[~self.is_length_test] = components_across_beam(points - far_points, first)[~self.is_length_test]
        return errors

    @cached_property
    def test_error_derivatives(self) -> Floats:
        """Derivative (tests, 2, constants) [m per SI unit] of the test errors by the instrument constants."""
        steps = np.diag([p.prior_sigma for p in self.construction.parameters])
        columns = [(self.test_errors(s) - self.test_errors(-s)) / (2 * s.sum()) for s in steps]
        return np.stack(columns, axis=2)

    @cached_property
    def error_sigmas(self) -> Floats:
        """Standard deviations (tests, 2) [m] of both components of the test errors, due to noise of the readings."""
        first, second = self._test_end_points
        squares = np.zeros((len(first), 2))
        near, far = (self._beam_axes_and_noise(points) for points in (first, second))
        way = second - first
        line_lengths = np.linalg.norm(way, axis=1, keepdims=True)
        direction = way / np.where(line_lengths > 0, line_lengths, 1.0)
        for axes, sigma in (near, far):
            squares[:, 0] += np.sum((np.einsum("kai,ki->ka", axes, direction) * sigma) ** 2, axis=1)
        squares[~self.is_length_test] = 2 * near[1][~self.is_length_test, 1:] ** 2
        return np.sqrt(squares)

    def _beam_axes_and_noise(self, points: Floats) -> tuple[Floats, Floats]:
        """Unit vectors along the beam, left and up at points (tests, 3) [m], and noise of the points along these axes.

        The unit vectors have the shape (tests, 3, 3); the noise is given as standard deviations (tests, 3) [m].
        """
        polar = to_polar(points)
        axes = np.stack(beam_frame_axes(polar[:, 1], polar[:, 2]), axis=1)
        flat = np.zeros(len(polar))
        sigma = reading_sigmas_from_noise([self.declared_noise], flat.astype(int), polar[:, 0], flat)
        return axes, sigma * np.where([True, False, False], 1.0, polar[:, :1])

    def predict(self, mean_constants: Floats, covariance: Floats, *, n_trials: int, seed: int) -> AcceptancePrediction:
        """Predicted tests of an instrument whose constants have a known mean and covariance.

        `mean_constants` has the shape (constants,) [SI], `covariance` (constants, constants) [SI]. The probability to
        pass is estimated with `n_trials` random draws of instrument constants and noise; the errors are linear in the
        difference of the constants from their mean.
        """
        rng = random_stream(seed, "accept")
        mean_errors = self.test_errors(mean_constants)
        root = _covariance_root(covariance)
        passed = np.zeros(len(self.tests))
        every, groups = 0, dict.fromkeys((t.group for t in self.tests), 0)
        of_group = {g: np.array([t.group == g for t in self.tests]) for g in groups}
        for start in range(0, n_trials, 2000):
            count = min(2000, n_trials - start)
            drawn = (
                rng.standard_normal((count, root.shape[1]))
                @ (self.test_error_derivatives @ root).reshape(-1, root.shape[1]).T
            )
            noise = rng.standard_normal((count, *self.error_sigmas.shape)) * self.error_sigmas
            within = self.is_within_limits(mean_errors + drawn.reshape(count, *mean_errors.shape) + noise)
            passed += within.sum(axis=0)
            every += int(within.all(axis=1).sum())
            for name, mine in of_group.items():
                groups[name] += int(within[:, mine].all(axis=1).sum())
        variance = (
            np.einsum("kip,pq,kiq->ki", self.test_error_derivatives, covariance, self.test_error_derivatives)
            + self.error_sigmas**2
        )
        return AcceptancePrediction(
            expected_errors=mean_errors,
            error_sigmas=np.sqrt(variance),
            pass_probabilities=passed / n_trials,
            all_pass_probability=every / n_trials,
            pass_probability_by_group={name: count / n_trials for name, count in groups.items()},
        )

    def is_within_limits(self, errors: Floats) -> Bools:
        """Mask (..., tests) of the tests whose errors (..., tests, 2) [m] are within their limits."""
        return np.hypot(errors[..., 0], errors[..., 1]) <= self.permissible_errors

    def smallest_failing_constants(self) -> tuple[Floats, list[AcceptanceTest]]:
        """Smallest size (constants,) [SI] of each instrument constant at which a test fails, and the test that fails.

        All other constants are zero. The size is infinite if no test depends on the constant.
        """
        per_unit = np.linalg.norm(self.test_error_derivatives, axis=1) / self.permissible_errors[:, None]
        indices = np.argmax(per_unit, axis=0)
        max_errors = per_unit[indices, np.arange(len(indices))]
        prior_sigmas = np.array([p.prior_sigma for p in self.construction.parameters])
        failing_sizes = np.where(
            max_errors * prior_sigmas > MAX_NEGLIGIBLE_FRACTION_OF_LIMIT,
            1.0 / np.maximum(max_errors, np.finfo(float).tiny),
            np.inf,
        )
        return failing_sizes, [self.tests[i] for i in indices]

    def worst_passing_constants(self, prior_sigmas: Floats, points: Floats) -> tuple[Floats, float, float]:
        """Instrument constants that pass all tests although the errors of `points` are largest, and these errors.

        `points` has the shape (points, 3) [m]. The result is the instrument constants (constants,) [SI], the root mean
        square point error [m] and the largest point error [m]. The search is along the directions with the largest
        ratio of point errors to test errors. It ends at the limits of the tests, and at
        `MAX_CONSTANT_SIZE_IN_PRIOR_SIGMAS` times `prior_sigmas` (constants,) [SI].
        """
        harm = point_errors_by_constant(self.construction, points, prior_sigmas)
        directions = (self.test_error_derivatives * prior_sigmas / self.permissible_errors[:, None, None]).reshape(
            -1, len(prior_sigmas)
        )
        metric = directions.T @ directions + np.eye(len(prior_sigmas)) / MAX_CONSTANT_SIZE_IN_PRIOR_SIGMAS**2
        root = np.linalg.inv(np.linalg.cholesky(metric))
        _, vectors = np.linalg.eigh(root @ harm.T @ harm @ root.T)
        tried = np.array(
            [self._longest_passing_vector(way / np.linalg.norm(way), prior_sigmas) for way in (root.T @ vectors).T]
        )
        gaps = np.linalg.norm((tried / prior_sigmas @ harm.T).reshape(len(tried), -1, 3), axis=2)
        rms = np.sqrt(np.mean(gaps**2, axis=1))
        best_index = int(rms.argmax())
        tried[np.abs(tried) < MAX_NEGLIGIBLE_FRACTION_OF_PRIOR_SIGMA * prior_sigmas] = 0.0
        return tried[best_index], float(rms[best_index]), float(gaps[best_index].max())

    def _longest_passing_vector(self, unit_direction: Floats, prior_sigmas: Floats) -> Floats:
        """Longest vector (constants,) [SI] of instrument constants along a direction that passes every test, to 0.1 %.

        `unit_direction` (constants,) is in units of `prior_sigmas` (constants,) [SI].
        """
        low, high = 0.0, MAX_CONSTANT_SIZE_IN_PRIOR_SIGMAS
        while high - low > 1e-3 * MAX_CONSTANT_SIZE_IN_PRIOR_SIGMAS:
            middle = (low + high) / 2
            passes = self.is_within_limits(self.test_errors(middle * unit_direction * prior_sigmas)).all()
            low, high = (middle, high) if passes else (low, middle)
        return low * unit_direction * prior_sigmas


@dataclass(frozen=True)
class AcceptancePrediction:
    """Predicted results of acceptance tests."""

    expected_errors: Floats
    """Expected errors (tests, 2) [m]. A length has its error and 0; a two-face difference has its components to the
    left and upwards, as seen from the instrument."""
    error_sigmas: Floats
    """Standard deviations (tests, 2) [m] of the two components of `expected_errors`, including noise."""
    pass_probabilities: Floats
    """Probability (tests,) that each test passes."""
    all_pass_probability: float
    """Probability that all tests pass."""
    pass_probability_by_group: dict[str, float]
    """Probability that all tests of a group pass, by name of the group."""


def point_errors_by_constant(construction: GeometricErrorModel, points: Floats, prior_sigma: Floats) -> Floats:
    """Displacement (coordinates, constants) [m] of points by each instrument constant with the size `prior_sigma`.

    The points are measured in face 1. The rigid motion that fits the displacements best is subtracted. `points` has the
    shape (points, 3) [m], and `prior_sigma` (constants,) [SI].
    """
    front = np.ones(len(points), dtype=np.int64)
    columns = [
        (
            from_polar(construction.readings_from_points(points, front, s))
            - from_polar(construction.readings_from_points(points, front, -s))
        )
        / 2
        for s in np.diag(prior_sigma)
    ]
    displacements = np.stack([c.ravel() for c in columns], axis=1)
    return remove_rigid_motion(displacements, points - points.mean(axis=0))


def _covariance_root(covariance: Floats) -> Floats:
    """Matrix (constants, rank) whose product with its transpose is the covariance matrix (constants, constants)."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def predicted_result(
    plan: AcceptancePlan,
    prediction: AcceptancePrediction,
    prior_sigmas: Floats,
    acceptance_settings: AcceptanceSettings,
    *,
    instrument_description: str,
) -> AcceptanceFile:
    """Content of `accept.json` for a prediction: probability that an instrument passes its tests, and expected errors.

    `prior_sigmas` (constants,) [SI] are the prior standard deviations of the instrument constants. The sentence of the
    result begins with `instrument_description`.
    """
    values, rms, largest = plan.worst_passing_constants(prior_sigmas, points_around_instrument())
    error_sizes = np.hypot(prediction.expected_errors[:, 0], prediction.expected_errors[:, 1])
    errors = np.where(plan.is_length_test, prediction.expected_errors[:, 0], error_sizes)
    expanded_uncertainties = 2 * np.sqrt(np.sum(prediction.error_sigmas**2, axis=1))
    tests = tuple(
        TestOutcome(
            name=t.name, group=t.group, limit_um=limit, error_um=e, expanded_uncertainty_um=u, pass_probability=float(p)
        )
        for t, limit, e, u, p in zip(
            plan.tests,
            *(np.asarray(x) / MICROMETRE for x in (plan.permissible_errors, errors, expanded_uncertainties)),
            prediction.pass_probabilities,
            strict=True,
        )
    )
    smallest, first = plan.smallest_failing_constants()
    parameters = plan.construction.parameters
    sensitivities = tuple(
        InstrumentConstantSensitivity(
            name=p.name,
            unit=p.unit,
            prior_sigma=float(prior_sigmas[k] / p.si_per_display_unit),
            smallest_failing_value=float(smallest[k] / p.si_per_display_unit),
            failing_test=first[k].name if np.isfinite(smallest[k]) else "",
        )
        for k, p in enumerate(parameters)
    )
    chance = (
        f"{100 * prediction.all_pass_probability:.1f} %"
        if prediction.all_pass_probability < 0.9995
        else "more than 99.9 %"
    )
    least_probable = min(zip(prediction.pass_probabilities, plan.tests, strict=True), key=lambda pair: pair[0])
    sentence = f"{instrument_description} passes all {len(tests)} tests with a probability of {chance}"
    if least_probable[0] < 0.9995:
        sentence += f"; the least probable to pass is {least_probable[1].name} ({100 * least_probable[0]:.1f} %)"
    return AcceptanceFile(
        title=acceptance_settings.title,
        error_origin="predicted",
        plan_name=acceptance_settings.plan_name,
        specification=plan.specification,
        sigma_assumption=plan.specification.limit_interpretation_sentence,
        pass_probability=prediction.all_pass_probability,
        sentence=sentence,
        groups=group_summaries(tests, prediction.pass_probability_by_group),
        tests=tests,
        sensitivities=sensitivities,
        worst_passing_instrument=WorstPassingInstrument(
            constants={p.name: float(v / p.si_per_display_unit) for p, v in zip(parameters, values, strict=True)},
            rms_point_error_um=rms / MICROMETRE,
            largest_point_error_um=largest / MICROMETRE,
        ),
    )
