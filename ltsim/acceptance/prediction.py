"""Errors, sensitivities, pass probabilities and blind directions of tests, by an instrument's constants and noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ltsim.acceptance.files import AcceptanceFile, SensitivityEntry, TestEntry, WorstEntry, group_entries
from ltsim.acceptance.spec import Acceptance, Test, envelope
from ltsim.core.arrays import Bools, Floats
from ltsim.core.randomness import stream
from ltsim.core.units import MICROMETRE
from ltsim.geometry.polar import across_beam, from_polar, to_polar, unit_vectors
from ltsim.geometry.rigid import less_rigid
from ltsim.physics.model.construction import Construction
from ltsim.recordings.recording import noise_sigma
from ltsim.recordings.setup import Noise
from ltsim.recordings.specification import Specification

UNSEEN = 1e-6
"""Share of a limit that a constant of usual size makes by rounding alone."""
PLAUSIBLE = 3.0
"""Prior standard deviations within which an instrument is looked for that passes although it is bad."""


@dataclass(frozen=True)
class AcceptancePlan:
    """Tests of an instrument of one construction, with their limits."""

    tests: tuple[Test, ...]
    construction: Construction
    specification: Specification
    noise: Noise

    @cached_property
    def _ends(self) -> tuple[Floats, Floats]:
        return np.array([t.first for t in self.tests]), np.array([t.second for t in self.tests])

    @cached_property
    def is_length(self) -> Bools:
        """Lengths; the others are two-face tests, (k,)."""
        return np.array([t.kind == "length" for t in self.tests])

    @cached_property
    def limits(self) -> Floats:
        """(k,) [m]: what the specification permits."""
        first, second = self._ends
        limit = self.specification.of_two_faces(first)
        chosen = self.is_length
        limit[chosen] = self.specification.of_lengths(first[chosen], second[chosen])
        return limit

    def errors(self, values: Floats) -> Floats:
        """Errors (k, 2) [m] of the tests by an instrument with constants (p,) [SI], without noise; exact.

        Of a length: measured minus true, and 0. Of a two-face test: the front face's point less the back face's, to
        the left and up as seen from the instrument.
        """
        first, second = self._ends
        front = np.ones(len(first), dtype=np.int64)
        points = from_polar(self.construction.readings(first, front, values))
        far = from_polar(self.construction.readings(second, np.where(self.is_length, 1, 2), values))
        errors = np.zeros((len(first), 2))
        errors[:, 0] = np.linalg.norm(far - points, axis=1) - np.linalg.norm(second - first, axis=1)
        errors[~self.is_length] = across_beam(points - far, first)[~self.is_length]
        return errors

    @cached_property
    def sensitivities(self) -> Floats:
        """Change of the errors with each constant, by central differences, (k, 2, p) [m per SI unit]."""
        steps = np.diag([p.prior_sigma for p in self.construction.parameters])
        columns = [(self.errors(s) - self.errors(-s)) / (2 * s.sum()) for s in steps]
        return np.stack(columns, axis=2)

    @cached_property
    def scatter(self) -> Floats:
        """Standard deviations of the errors by the noise of the readings, (k, 2) [m]."""
        first, second = self._ends
        squares = np.zeros((len(first), 2))
        near, far = (self._point_noise(points) for points in (first, second))
        way = second - first
        length = np.linalg.norm(way, axis=1, keepdims=True)
        direction = way / np.where(length > 0, length, 1.0)
        for axes, sigma in (near, far):
            squares[:, 0] += np.sum((np.einsum("kai,ki->ka", axes, direction) * sigma) ** 2, axis=1)
        squares[~self.is_length] = 2 * near[1][~self.is_length, 1:] ** 2
        return np.sqrt(squares)

    def _point_noise(self, points: Floats) -> tuple[Floats, Floats]:
        """Beam, left and up (k, 3, 3) and the standard deviations (k, 3) [m] along them."""
        polar = to_polar(points)
        axes = np.stack(unit_vectors(polar[:, 1], polar[:, 2]), axis=1)
        flat = np.zeros(len(polar))
        sigma = noise_sigma([self.noise], flat.astype(int), polar[:, 0], flat)
        return axes, sigma * np.where([True, False, False], 1.0, polar[:, :1])

    def predict(self, mean: Floats, covariance: Floats, *, trials: int, seed: int) -> AcceptancePrediction:
        """Errors of an instrument whose constants have a mean (p,) and a covariance (p, p) [SI].

        The chance to pass is that of `trials` draws of constants and noise; the errors of each draw are linear in its
        distance from the mean, where they are exact.
        """
        rng = stream(seed, "accept")
        middle = self.errors(mean)
        root = _root(covariance)
        passed = np.zeros(len(self.tests))
        every, groups = 0, dict.fromkeys((t.group for t in self.tests), 0)
        of_group = {g: np.array([t.group == g for t in self.tests]) for g in groups}
        for start in range(0, trials, 2000):
            count = min(2000, trials - start)
            drawn = (
                rng.standard_normal((count, root.shape[1])) @ (self.sensitivities @ root).reshape(-1, root.shape[1]).T
            )
            noise = rng.standard_normal((count, *self.scatter.shape)) * self.scatter
            within = self.within(middle + drawn.reshape(count, *middle.shape) + noise)
            passed += within.sum(axis=0)
            every += int(within.all(axis=1).sum())
            for name, mine in of_group.items():
                groups[name] += int(within[:, mine].all(axis=1).sum())
        variance = np.einsum("kip,pq,kiq->ki", self.sensitivities, covariance, self.sensitivities) + self.scatter**2
        return AcceptancePrediction(
            errors=middle,
            sigma=np.sqrt(variance),
            passes=passed / trials,
            all_pass=every / trials,
            group_passes={name: count / trials for name, count in groups.items()},
        )

    def within(self, errors: Floats) -> Bools:
        """True if errors (..., k, 2) [m] are within the limits, (...,)."""
        return np.hypot(errors[..., 0], errors[..., 1]) <= self.limits

    def smallest_failing(self) -> tuple[Floats, list[Test]]:
        """Size (p,) [SI] at which each constant alone fails a test, and the test that it fails first; inf if none."""
        per_unit = np.linalg.norm(self.sensitivities, axis=1) / self.limits[:, None]
        at = np.argmax(per_unit, axis=0)
        most = per_unit[at, np.arange(len(at))]
        usual = np.array([p.prior_sigma for p in self.construction.parameters])
        size = np.where(most * usual > UNSEEN, 1.0 / np.maximum(most, np.finfo(float).tiny), np.inf)
        return size, [self.tests[i] for i in at]

    def worst_passing(self, prior: Floats, points: Floats) -> tuple[Floats, float, float]:
        """The constants (p,) [SI] that harm points (n, 3) [m] around the instrument most, and still keep every limit.

        Beside them the error of these points, root mean square and largest [m]. The constants are looked for along the
        directions in which harm over what the tests see is largest, each as long as the limits and `PLAUSIBLE` prior
        standard deviations (p,) allow.
        """
        harm = harm_of(self.construction, points, prior)
        directions = (self.sensitivities * prior / self.limits[:, None, None]).reshape(-1, len(prior))
        bound = directions.T @ directions + np.eye(len(prior)) / PLAUSIBLE**2
        root = np.linalg.inv(np.linalg.cholesky(bound))
        _, vectors = np.linalg.eigh(root @ harm.T @ harm @ root.T)
        tried = np.array([self._stretched(way / np.linalg.norm(way), prior) for way in (root.T @ vectors).T])
        gaps = np.linalg.norm((tried / prior @ harm.T).reshape(len(tried), -1, 3), axis=2)
        rms = np.sqrt(np.mean(gaps**2, axis=1))
        best = int(rms.argmax())
        return tried[best], float(rms[best]), float(gaps[best].max())

    def _stretched(self, direction: Floats, prior: Floats) -> Floats:
        """The longest (p,) [SI] along a direction in units of the prior that keeps every limit, to 0.1 %."""
        low, high = 0.0, PLAUSIBLE
        while high - low > 1e-3 * PLAUSIBLE:
            middle = (low + high) / 2
            passes = self.within(self.errors(middle * direction * prior)).all()
            low, high = (middle, high) if passes else (low, middle)
        return low * direction * prior


@dataclass(frozen=True)
class AcceptancePrediction:
    """Predicted outcome of the tests."""

    errors: Floats
    sigma: Floats
    """Expected errors and their standard deviations, noise included, (k, 2) [m]."""
    passes: Floats
    """Chance that each test is passed, (k,)."""
    all_pass: float
    """Chance that all are."""
    group_passes: dict[str, float]
    """Chance that all of a group are."""


def harm_of(construction: Construction, points: Floats, scale: Floats) -> Floats:
    """Displacement of front-face points (n, 3) [m] by each constant at `scale`, after a best fit, (3 n, p) [m].

    A common shift and turn of all points does no harm.
    """
    front = np.ones(len(points), dtype=np.int64)
    columns = [
        (from_polar(construction.readings(points, front, s)) - from_polar(construction.readings(points, front, -s))) / 2
        for s in np.diag(scale)
    ]
    moved = np.stack([c.ravel() for c in columns], axis=1)
    return less_rigid(moved, points - points.mean(axis=0))


def _root(covariance: Floats) -> Floats:
    """A root (p, r) of a covariance that may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def predicted(
    plan: AcceptancePlan, prediction: AcceptancePrediction, prior: Floats, acceptance: Acceptance, *, of: str
) -> AcceptanceFile:
    """Predicted outcome of the tests of instrument `of`; `prior` (p,) [SI]: standard deviations of its constants."""
    values, rms, largest = plan.worst_passing(prior, envelope())
    size = np.hypot(prediction.errors[:, 0], prediction.errors[:, 1])
    signed = np.where(plan.is_length, prediction.errors[:, 0], size)
    expanded = 2 * np.sqrt(np.sum(prediction.sigma**2, axis=1))
    tests = tuple(
        TestEntry(name=t.name, group=t.group, limit_um=limit, error_um=e, expanded_um=u, passes=float(p))
        for t, limit, e, u, p in zip(
            plan.tests,
            *(np.asarray(x) / MICROMETRE for x in (plan.limits, signed, expanded)),
            prediction.passes,
            strict=True,
        )
    )
    smallest, first = plan.smallest_failing()
    parameters = plan.construction.parameters
    sensitivities = tuple(
        SensitivityEntry(
            name=p.name,
            unit=p.unit,
            prior_sigma=float(prior[k] / p.factor),
            smallest_failing=float(smallest[k] / p.factor),
            test=first[k].name if np.isfinite(smallest[k]) else "",
        )
        for k, p in enumerate(parameters)
    )
    chance = f"{100 * prediction.all_pass:.1f} %" if prediction.all_pass < 0.9995 else "more than 99.9 %"
    weakest = min(zip(prediction.passes, plan.tests, strict=True), key=lambda pair: pair[0])
    sentence = f"{of} passes all {len(tests)} tests with a chance of {chance}"
    if weakest[0] < 0.9995:
        sentence += f"; the hardest is {weakest[1].name} ({100 * weakest[0]:.1f} %)"
    return AcceptanceFile(
        title=acceptance.title,
        kind="predicted",
        plan=acceptance.plan,
        specification=plan.specification,
        assumption=plan.specification.assumption,
        passes=prediction.all_pass,
        sentence=sentence,
        groups=group_entries(tests, prediction.group_passes, predicted=True),
        tests=tests,
        sensitivities=sensitivities,
        worst_passing=WorstEntry(
            constants={p.name: float(v / p.factor) for p, v in zip(parameters, values, strict=True)},
            rms_um=rms / MICROMETRE,
            largest_um=largest / MICROMETRE,
        ),
    )
