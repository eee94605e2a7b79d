"""Tests of reference values (known coordinates, lengths, levels, azimuths) against other observations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy import special

from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.reference_values import (
    ReferenceKind,
    ReferenceValue,
    ReferenceValueRows,
    common_scale_reference,
    reference_values,
    with_nonzero_reference_sigmas,
)
from ltsim.adjustment.reliability import noise_factor, noncentrality
from ltsim.adjustment.significance import FAMILY_WISE_LEVEL, MIN_CERTAIN_ERROR_SIGMAS
from ltsim.core.arrays import Floats, batches
from ltsim.core.notation import count_text, number_text, with_sigma
from ltsim.core.rounding import SQRT_MACHINE_EPSILON
from ltsim.core.units import ARCSECOND, MILLIMETRE
from ltsim.physics.effects.scale_causes import temperature_errors_text
from ltsim.physics.model.measurement import NetworkState
from ltsim.solve.design import to_dense
from ltsim.solve.gauss_newton import Solution, solve

PHRASE_BY_REFERENCE_KIND: dict[ReferenceKind, str] = {
    "point": "the known coordinates of",
    "difference": "the known difference",
    "length": "the known length",
    "level": "the level of",
    "yaw": "the azimuth zero of",
    "mark": "the set-up of",
    "axes": "the declared coordinates of",
    "scale": "the scale of",
}
"""First words of a sentence on the test of a reference value, by its kind; the name of the value follows them."""
ERROR_UNIT_BY_REFERENCE_KIND = {"level": ("arcsec", ARCSECOND), "yaw": ("arcsec", ARCSECOND), "scale": ("ppm", 1e-6)}
"""Display unit of the error of a reference value, and size of the unit [SI], by kind; other kinds have millimetres."""
TESTED_REFERENCE_KINDS: tuple[ReferenceKind, ...] = ("point", "difference", "length", "level", "yaw", "mark", "scale")
"""Kinds of reference values that are tested, and by default excluded if they contradict the other observations."""
TESTED_KINDS_EXCEPT_SCALE: tuple[ReferenceKind, ...] = TESTED_REFERENCE_KINDS[:-1]
"""Kinds of reference values whose tests may exclude values, if reference lengths determine the scale of the network. A
common scale error of the lengths is then only reported."""
MIN_TESTED_REDUNDANCY = 1e-3
"""Smallest redundancy number of a component of a reference value that the other observations are able to test."""
MAX_HORIZONTAL_TO_VERTICAL_RATIO = 0.01
"""Limit of the horizontal error of a point, divided by its vertical error. If the ratio is smaller, the error is
reported as an error of height."""


@dataclass(frozen=True)
class ReferenceTest(ReferenceValue):
    """Test of a reference value against the other observations of a network."""

    error: Floats
    """Estimated errors (q,) [m, rad or 1] of the q components: declared value minus estimate by other observations."""
    error_sigmas: Floats
    """Standard deviations (q,) of the errors of the q components; infinite for components that other observations do
    not test."""
    chi2_drop: float
    """Decrease of chi-square by the exclusion of the reference value."""
    rank: int
    """Number of those components of the reference value that the other observations of the network check."""
    is_excluded: bool = False
    """True if the reference value contradicts the other observations and is excluded from the adjustment."""
    critical_value: float = MIN_CERTAIN_ERROR_SIGMAS
    """Critical value of the test: value of `normalised_error` above which the reference value is excluded."""
    indistinguishable_from: tuple[str, ...] = ()
    """Names of other reference values whose errors would explain the misfit equally well. None of these values is
    excluded, unless all are set-ups over marks."""
    error_length_sigma: float | None = None
    """Standard deviation [m, rad or 1] of the length of `error`, by its covariance; None if this covariance is not
    known."""

    @property
    def normalised_error(self) -> float:
        """Error in its standard deviations: square root of `chi2_drop`; for one component the absolute w statistic."""
        return float(np.sqrt(self.chi2_drop))

    @property
    def is_height_error(self) -> bool:
        """True if the error is significant in the height, but not in the horizontal coordinates."""
        return is_in_height_alone(self.error, self.error_sigmas)

    @property
    def error_text(self) -> str:
        """Text with the size of the error (length of its vector), its standard deviation and unit."""
        error_size, sigma = self._error_size_and_sigma
        unit, factor = ERROR_UNIT_BY_REFERENCE_KIND.get(self.kind, ("mm", MILLIMETRE))
        return with_sigma(error_size / factor, sigma / factor, unit)

    @property
    def _error_size_and_sigma(self) -> tuple[float, float]:
        """Length [m, rad or 1] of the error, and its standard deviation.

        If the covariance of the error is not known, the standard deviation is the size divided by `normalised_error`.
        """
        error_size, sigma = float(np.linalg.norm(self.error)), self.error_length_sigma
        if sigma is None:
            sigma = error_size / self.normalised_error if self.normalised_error else 0.0
        return error_size, sigma

    @property
    def statistic_text(self) -> str:
        """Text with the statistic of the test: w (size / standard deviation) for one component, else chi-square.

        The chi-square of several components tests all of them together. Its square root exceeds the ratio of the length
        of the error to the standard deviation of this length, if their standard deviations differ.
        """
        error_size, sigma = self._error_size_and_sigma
        if self.rank == 1 and sigma:
            return f"w = {number_text(error_size / sigma)}"
        return f"chi2 = {number_text(self.chi2_drop)} for {count_text(self.rank, 'component')}"

    @property
    def sentence(self) -> str:
        """Sentence for the user on a reference value that contradicts the other observations."""
        what = f"{PHRASE_BY_REFERENCE_KIND[self.kind]} {self.name}"
        if self.kind == "mark":
            others = ", ".join(self.indistinguishable_from)
            mark = f"the mark of {others}" if others else "its mark"
            where, cause = ("above", "low") if self.error[-1] < 0 else ("below", "high")
            where, cause = (
                (where, f" (its height is declared too {cause})") if self.is_height_error else ("away from", "")
            )
            end = f"{mark}{cause} ({self.statistic_text}): its position is estimated separately"
            return f"set-up {self.name} is {self.error_text} {where} {end}"
        if self.kind == "scale":
            more, less = ("long", "short") if self.error[0] > 0 else ("short", "long")
            causes = "check the temperature, the expansion coefficient and the scale of the ranges"
            reason = temperature_errors_text(float(self.error[0]), expansion_per_k=self.expansion_per_k)
            causes += f" ({reason})"
            remark = "; the ranges now define the scale, the lengths only their ratios" if self.is_excluded else ""
            size = f"{self.name} are {self.error_text} too {more} ({self.statistic_text})"
            return f"{size}, or all ranges are too {less}: {causes}{remark}"
        if self.indistinguishable_from:
            both = f"{', '.join((self.name, *self.indistinguishable_from))} are inconsistent"
            return f"{both} ({what} by {self.error_text}); the readings do not show which one is wrong: check each"
        note = "as the readings show: excluded from the adjustment"
        if self.kind == "axes":
            note = "as the other points show: excluded from the datum"
        if self.occupied_by and self.is_height_error:
            note = f"or the height of set-up {self.occupied_by} over it is wrong: excluded"
        verb = "are" if self.kind in ("point", "axes") else "is"
        return f"{what} {verb} off by {self.error_text} ({self.statistic_text}), {note}"

    def with_noise_factor(self, factor: float) -> Self:
        """Same test with all standard deviations multiplied by `factor`, for noise larger than declared."""
        chi2_drop, error_sigmas = self.chi2_drop / factor**2, factor * self.error_sigmas
        return replace(
            self,
            declared_sigmas=factor * self.declared_sigmas,
            error_sigmas=error_sigmas,
            chi2_drop=chi2_drop,
            error_length_sigma=None if (sigma := self.error_length_sigma) is None else factor * sigma,
        )

    @property
    def redundancy(self) -> Floats:
        """Redundancy numbers (q,) of the q components: part of an error of the component that its residual shows."""
        return np.where(self.error_sigmas > 0, np.minimum((self.declared_sigmas / self.error_sigmas) ** 2, 1.0), 0.0)

    @property
    def minimal_detectable_errors(self) -> Floats:
        """Errors (q,) of the q components that the test detects with a probability of 80 %; infinite if untested."""
        return np.sqrt(noncentrality(alpha=FAMILY_WISE_LEVEL)) * self.error_sigmas


def reference_tests(
    problem: NetworkProblem, solution: Solution[NetworkState], min_residual: float = 0.0
) -> list[ReferenceTest]:
    """Tests of those reference values of an adjustment whose whitened residuals are at least `min_residual`.

    If `min_residual` is positive, the common scale of all reference lengths is tested too. If it is 0, exact reference
    values first get a small standard deviation, because a test is impossible without one.
    """
    if not min_residual and solution.factor is not None:
        problem, given = with_nonzero_reference_sigmas(problem, solution.x), problem
        solution = solution if problem is given else solve(problem, solution.x)
    if solution.factor is None:
        return []
    residual, tests = problem.whitened_residuals(solution.x), []
    declared = reference_values(problem, solution.x)
    values = [v for v in declared if float(np.linalg.norm(residual[v.equation_indices])) >= min_residual]
    values += common_scale_reference(problem, solution.x) if min_residual else []
    for batch in (values[part] for part in batches(len(values), 3 * solution.system.design.shape[1])):
        inside = np.hstack(
            [to_dense(solution.system.design[value.equation_indices]).T @ value.design_columns for value in batch]
        )
        response, first = solution.factor.multiply_by_covariance(inside), 0
        for value in batch:
            columns = slice(first, first := first + value.design_columns.shape[1])
            gram = value.design_columns.T @ value.design_columns - inside[:, columns].T @ response[:, columns]
            tests.append(_reference_test(value, gram, value.design_columns.T @ residual[value.equation_indices]))
    return tests


def reference_tests_with_estimated_noise(
    problem: NetworkProblem, solution: Solution[NetworkState], min_residual: float = 0.0
) -> list[ReferenceTest]:
    """Tests of reference values as by `reference_tests`, with standard deviations for the estimated noise."""
    tests = reference_tests(problem, solution, min_residual)
    factor = noise_factor(problem, solution) if tests else 1.0
    return [test.with_noise_factor(factor) for test in tests]


def passes_global_test(problem: NetworkProblem, solution: Solution[NetworkState]) -> bool:
    """True if chi-square is not too large for the declared noise, at the significance level `FAMILY_WISE_LEVEL`."""
    return bool(special.chdtrc(max(problem.dof, 1), solution.sum_of_squares) >= FAMILY_WISE_LEVEL)


def requires_instrument_constants_for_points(
    problem: NetworkProblem, solution: Solution[NetworkState], wrong_values: Sequence[ReferenceTest] = ()
) -> bool:
    """True if errors of the instrument constants may look like errors of known points.

    This is possible if the network has known points, and if a fit that does not estimate the instrument constants fails
    the global test, or passes it only without the known points among `wrong_values`.
    """
    has_constants = problem.model.construction.n_parameters > 0
    has_misfit = any(test.kind == "point" for test in wrong_values) or not passes_global_test(problem, solution)
    return bool(len(problem.control_rows)) and not has_constants and has_misfit


def reference_tests_with_instrument_constants(
    problem: NetworkProblem, solution: Solution[NetworkState]
) -> tuple[ReferenceTest, ...]:
    """Tests of the reference values of an adjustment, with instrument constants as a source of uncertainty.

    In a network without reference lengths, instrument constants are unknowns of the tests only if a fit with them
    passes the global test and a fit without them does not. Standard deviations are those of the tested fit, multiplied
    by its `noise_factor` (ratio of estimated to declared noise, at least 1). The residuals are those of the adjustment
    itself.
    """
    tested, state = problem.with_instrument_constants(solution.x)
    tested_solution = solution if tested is problem else solve(tested, state)
    if tested is problem and requires_instrument_constants_for_points(problem, solution):
        with_shape_parameters, state = problem.with_instrument_constants(solution.x, requires_length=False)
        other_solution = solve(with_shape_parameters, state)
        if passes_global_test(with_shape_parameters, other_solution):
            tested, tested_solution = with_shape_parameters, other_solution
    tests = reference_tests_with_estimated_noise(tested, tested_solution)
    residuals = {(value.kind, value.name): value.residual for value in reference_values(problem, solution.x)}
    return tuple(replace(test, residual=residuals.get((test.kind, test.name), test.residual)) for test in tests)


def _reference_test(value: ReferenceValueRows, gram_matrix: Floats, residual_inner_products: Floats) -> ReferenceTest:
    """Test of a reference value with q components.

    Unit errors of the components change the whitened residuals of the adjustment. `gram_matrix` (q, q) contains the
    inner products of these changes, `residual_inner_products` (q,) the inner products of the changes and the residuals.
    """
    norms = np.linalg.norm(value.design_columns, axis=0)
    is_active = norms > SQRT_MACHINE_EPSILON * norms.max()  # readings in plan do not depend on heights
    norms = np.where(is_active, norms, np.inf)
    redundancies, eigenvectors = np.linalg.eigh(gram_matrix / np.outer(norms, norms))
    checked = redundancies > MIN_TESTED_REDUNDANCY
    redundancies, eigenvectors = redundancies[checked], eigenvectors[:, checked]
    eigen_products, eigen_errors = eigenvectors.T @ (residual_inner_products / norms), eigenvectors / norms[:, None]
    is_determined = np.sum(eigenvectors**2, axis=1) > 0.5
    error = eigen_errors @ (eigen_products / redundancies)
    return ReferenceTest(
        value.kind,
        value.name,
        value.declared_axes,
        value.declared_sigmas,
        value.residual,
        error,
        np.where(is_determined, np.sqrt(np.sum(eigen_errors**2 / redundancies, axis=1)), np.inf),
        float(np.sum(eigen_products**2 / redundancies)),
        int(checked.sum()),
        occupied_by=value.occupied_by,
        expansion_per_k=value.expansion_per_k,
        error_length_sigma=length_sigma(error, (eigen_errors / redundancies) @ eigen_errors.T),
    )


def length_sigma(vector: Floats, covariance: Floats) -> float:
    """Standard deviation of the length of a `vector` (q,) with the `covariance` (q, q); 0 for the zero vector."""
    length = float(np.linalg.norm(vector))
    return float(np.sqrt(max(float(vector @ covariance @ vector), 0.0))) / length if length else 0.0


def is_in_height_alone(error: Floats, error_sigmas: Floats) -> bool:
    """True if an error (k,) is significant in its last component, the height, but not in the horizontal coordinates.

    `error_sigmas` (k,) are the standard deviations of the k components. Errors of heights alone are no such errors.
    """
    *plan, height = np.abs(error).tolist()
    small = [
        max(MIN_CERTAIN_ERROR_SIGMAS * sigma, MAX_HORIZONTAL_TO_VERTICAL_RATIO * height)
        for sigma in error_sigmas[:-1].tolist()
    ]
    is_significant = height > MIN_CERTAIN_ERROR_SIGMAS * error_sigmas[-1]
    return bool(plan) and bool(is_significant) and all(map(float.__lt__, plan, small))
