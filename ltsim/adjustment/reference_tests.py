"""Tests of reference values: coordinates, heights, lengths, levels and azimuths are observations like readings.

A wrong reference value biases the residuals of all readings that it constrains. Reference values are therefore tested
before single readings. Of all hypotheses that one value is wrong, that with the smallest p-value is accepted first.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.reference_values import (
    ReferenceKind,
    ReferenceValue,
    ReferenceValueRows,
    common_scale,
    drop_reference,
    reference_values,
    relax_exact_references,
)
from ltsim.adjustment.reliability import (
    critical_w,
    level_of_single_test,
    neg_log_p_chi2,
    noise_scale,
    noncentrality,
    redundancy_numbers,
    standardised_residuals,
)
from ltsim.adjustment.significance import FAMILY_LEVEL, MIN_CLEAR_SIGMAS, MIN_GROSS_SIGMAS, MIN_REPORTED_PROBABILITY
from ltsim.adjustment.snooping import snoop_readings
from ltsim.core.arrays import Bools, Floats, batches
from ltsim.core.notation import with_sigma
from ltsim.core.rounding import MAX_ROUNDING_ERROR
from ltsim.core.units import ARCSECOND, MILLIMETRE
from ltsim.physics.model.measurement import NetworkState
from ltsim.solve.design import to_dense
from ltsim.solve.gauss_newton import Solution, solve

REFERENCE_KIND_PHRASES: dict[ReferenceKind, str] = {
    "point": "the known coordinates of",
    "difference": "the known difference",
    "length": "the known length",
    "level": "the level of",
    "yaw": "the azimuth zero of",
    "mark": "the set-up of",
    "axes": "the declared coordinates of",
    "scale": "the scale of",
}
"""Subject of a sentence by kind of reference value; the name of the value follows."""
ERROR_UNITS = {"level": ("arcsec", ARCSECOND), "yaw": ("arcsec", ARCSECOND), "scale": ("ppm", 1e-6)}
"""Unit of an error and its size in SI units, by kind of reference value; millimetres for all other kinds."""
TESTED_REFERENCE_KINDS: tuple[ReferenceKind, ...] = ("point", "difference", "length", "level", "yaw", "mark", "scale")
"""Kinds of reference values that are tested."""
SCALE_DEPENDENT_KINDS: tuple[ReferenceKind, ...] = TESTED_REFERENCE_KINDS[:-1]
"""Kinds of values that may be excluded if lengths determine the scale; a common scale error is then only reported."""
MIN_TESTED_REDUNDANCY = 1e-3
"""Redundancy up to which the other observations do not test a component of a reference value."""
MIN_RESIDUAL = MIN_CLEAR_SIGMAS * float(np.sqrt(MIN_TESTED_REDUNDANCY))
"""Whitened residual below which a reference value is not tested: an error of `MIN_CLEAR_SIGMAS` causes a larger one."""
MAX_INCLINATION = 0.01
"""Ratio of horizontal to vertical error up to which an error of a point counts as a height error."""
MIN_VALUES_FOR_TYPICAL_ERROR = 3
"""Number of other reference values of the same kind below which a wrong value is not identified if another one also
contradicts.
"""
MAX_CHI2_FRACTION = 1e-6
"""Ratio of chi-square after and before the exclusion of reference values, below which they are certainly wrong."""
MAX_EXCLUDED_FRACTION = 1 / 3
"""Fraction of wrong reference values of one kind above which all of that kind are inconsistent and none is excluded."""


@dataclass(frozen=True)
class ReferenceTest(ReferenceValue):
    """Test of a reference value against the other observations of a network."""

    error: Floats
    """Estimated error of each of q components, (q,): declared value minus the estimate by the other observations."""
    sigma_error: Floats
    """Standard deviations of the errors, (q,); infinite for components that the other observations do not test."""
    chi2_drop: float
    """Decrease of chi-square if the value is excluded."""
    rank: int
    """Number of components that the other observations test."""
    is_excluded: bool = False
    """True if the value contradicts the other observations and is excluded from the adjustment."""
    critical_value: float = MIN_CLEAR_SIGMAS
    """Value of `normalised_error` above which the reference value is excluded."""
    indistinguishable_from: tuple[str, ...] = ()
    """Names of other reference values whose error explains the misfit as well; none of these is excluded."""

    @property
    def normalised_error(self) -> float:
        """Square root of the decrease of chi-square; for one component the absolute normalised residual."""
        return float(np.sqrt(self.chi2_drop))

    @property
    def is_height(self) -> bool:
        """True if the error is significant in the height and not in the horizontal coordinates."""
        *plan, height = np.abs(self.error).tolist()
        small = [max(MIN_CLEAR_SIGMAS * sigma, MAX_INCLINATION * height) for sigma in self.sigma_error[:-1]]
        is_significant = height > MIN_CLEAR_SIGMAS * self.sigma_error[-1]
        return bool(plan) and is_significant and all(map(float.__lt__, plan, small))

    @property
    def error_text(self) -> str:
        """Text of the length of the error with its standard deviation and unit."""
        error_size = float(np.linalg.norm(self.error))
        along = self.error / error_size if error_size else np.zeros(len(self.error))
        sigma = float(np.linalg.norm(along * np.where(np.isfinite(self.sigma_error), self.sigma_error, 0.0)))
        unit, factor = ERROR_UNITS.get(self.kind, ("mm", MILLIMETRE))
        return with_sigma(error_size / factor, sigma / factor, unit)

    @property
    def sentence(self) -> str:
        """Sentence on a reference value that contradicts the other observations."""
        what = f"{REFERENCE_KIND_PHRASES[self.kind]} {self.name}"
        if self.kind == "mark":
            others = ", ".join(self.indistinguishable_from)
            mark = f"the mark of {others}" if others else "its mark"
            where, cause = ("above", "low") if self.error[-1] < 0 else ("below", "high")
            where, cause = (where, f" (its height is declared too {cause})") if self.is_height else ("away from", "")
            end = f"{mark}{cause} (w = {self.normalised_error:.3g}): its position is estimated separately"
            return f"set-up {self.name} is {self.error_text} {where} {end}"
        if self.kind == "scale":
            more, less = ("long", "short") if self.error[0] > 0 else ("short", "long")
            causes = "check the temperature, the expansion coefficient and the scale of the ranges"
            remark = "; the ranges define the scale and the lengths only their ratios" if self.is_excluded else ""
            size = f"{self.name} are {self.error_text} too {more} (w = {self.normalised_error:.3g})"
            return f"{size}, or all ranges are too {less}: {causes}{remark}"
        if self.indistinguishable_from:
            both = f"{', '.join((self.name, *self.indistinguishable_from))} are inconsistent"
            return f"{both} ({what} by {self.error_text}); the data do not show which one is wrong"
        note = "by the other points: excluded from the datum" if self.kind == "axes" else "not its readings: excluded"
        if self.occupied_by and self.is_height:
            note = f"or the height of set-up {self.occupied_by} over it: excluded"
        verb = "are" if self.kind in ("point", "axes") else "is"
        return f"{what} {verb} off by {self.error_text} (w = {self.normalised_error:.3g}), {note}"

    @property
    def redundancy(self) -> Floats:
        """Redundancy numbers (q,): derivative of the residual of each component with respect to its error."""
        return np.where(self.sigma_error > 0, np.minimum((self.sigma / self.sigma_error) ** 2, 1.0), 0.0)

    @property
    def minimal_detectable(self) -> Floats:
        """Minimal detectable errors (q,) of the components at a power of 80 %; infinite for untested components."""
        return np.sqrt(noncentrality(alpha=FAMILY_LEVEL)) * self.sigma_error


def reference_tests(
    problem: NetworkProblem, solution: Solution[NetworkState], min_residual: float = 0.0
) -> list[ReferenceTest]:
    """Tests of the reference values of an adjustment with whitened residuals of at least `min_residual`.

    With a positive limit the common scale of all lengths is tested too; with 0 exact values get a small sigma first.
    """
    if not min_residual and solution.factor is not None:
        problem, given = relax_exact_references(problem, solution.x), problem
        solution = solution if problem is given else solve(problem, solution.x)
    if solution.factor is None:
        return []
    residual, tests = problem.whitened_residuals(solution.x), []
    declared = reference_values(problem, solution.x)
    values = [v for v in declared if float(np.linalg.norm(residual[v.rows])) >= min_residual]
    values += common_scale(problem, solution.x) if min_residual else []
    for batch in (values[part] for part in batches(len(values), 3 * solution.system.design.shape[1])):
        inside = np.hstack([to_dense(solution.system.design[value.rows]).T @ value.design_columns for value in batch])
        response, first = solution.factor.covariance_columns(inside), 0
        for value in batch:
            columns = slice(first, first := first + value.design_columns.shape[1])
            gram = value.design_columns.T @ value.design_columns - inside[:, columns].T @ response[:, columns]
            tests.append(_reference_test(value, gram, value.design_columns.T @ residual[value.rows]))
    return tests


def reference_tests_with_constants(
    problem: NetworkProblem, solution: Solution[NetworkState]
) -> tuple[ReferenceTest, ...]:
    """Tests of the reference values of an adjustment, whose errors are uncertain by the constants of the instruments.

    The residuals are those of the adjustment itself.
    """
    tested, state = problem.with_instrument_constants(solution.x)
    tests = reference_tests(tested, solution if tested is problem else solve(tested, state))
    residuals = {(value.kind, value.name): value.residual for value in reference_values(problem, solution.x)}
    return tuple(replace(test, residual=residuals.get((test.kind, test.name), test.residual)) for test in tests)


def _reference_test(value: ReferenceValueRows, gram_matrix: Floats, residual_product: Floats) -> ReferenceTest:
    """Test of a value with q components, from inner products of the changes of residuals by unit errors of each."""
    norms = np.linalg.norm(value.design_columns, axis=0)
    is_active = norms > MAX_ROUNDING_ERROR * norms.max()  # readings in plan do not depend on heights
    norms = np.where(is_active, norms, np.inf)
    redundancies, eigenvectors = np.linalg.eigh(gram_matrix / np.outer(norms, norms))
    checked = redundancies > MIN_TESTED_REDUNDANCY
    redundancies, eigenvectors = redundancies[checked], eigenvectors[:, checked]
    eigen_products, eigen_errors = eigenvectors.T @ (residual_product / norms), eigenvectors / norms[:, None]
    is_determined = np.sum(eigenvectors**2, axis=1) > 0.5
    return ReferenceTest(
        value.kind,
        value.name,
        value.declared_components,
        value.sigma,
        value.residual,
        eigen_errors @ (eigen_products / redundancies),
        np.where(is_determined, np.sqrt(np.sum(eigen_errors**2 / redundancies, axis=1)), np.inf),
        float(np.sum(eigen_products**2 / redundancies)),
        int(checked.sum()),
        occupied_by=value.occupied_by,
    )


def snoop_references(
    problem: NetworkProblem,
    solution: Solution[NetworkState],
    kinds: Collection[ReferenceKind] = TESTED_REFERENCE_KINDS,
    exempt_values: frozenset[tuple[ReferenceKind, str]] = frozenset(),
) -> tuple[NetworkProblem, Solution[NetworkState], tuple[ReferenceTest, ...]]:
    """Problem without contradicting reference values, its solution, and the tests of these values.

    The values are excluded one at a time, that with the smallest p-value first. A single reading that explains the
    misfit better is left out during the tests. `kinds` restricts the exclusion; `exempt_values` (kind and name) stay in
    use.
    """
    given, aside = (problem, solution), relax_exact_references(problem, solution.x)
    out: list[ReferenceTest] = []
    by_far: tuple[NetworkProblem, Solution[NetworkState], int] | None = None
    if solution.factor is not None and aside is not problem:
        solution = solve(aside, solution.x)
    while solution.factor is not None and len(out) < len(problem.model.recording.targets):
        suspect = _largest_error(aside, solution, kinds, exempt_values)
        if suspect is None:
            break
        if isinstance(suspect, ReferenceTest):
            out.append(suspect)
            if not suspect.is_excluded:
                break
            model = replace(aside.model, recording=drop_reference(aside.model.recording, suspect))
            aside = relax_exact_references(aside.with_model(model), solution.x)
        else:
            aside = replace(aside, used_readings=aside.used_readings & ~suspect)
        solution = solve(aside, solution.x)
        enough = solution.sum_of_squares < MAX_CHI2_FRACTION * given[1].sum_of_squares
        if by_far is None and out and enough and not _exclude_inconsistent_kind(*given, out):
            by_far = problem.with_model(aside.model), solution, len(out)
    gone = [test for test in out if test.is_excluded]
    too_many = solution.factor is None or _exclude_inconsistent_kind(*given, gone)
    if too_many and by_far is not None:
        reduced, near, count = by_far
        reduced, ended, more = snoop_references(reduced, solve(reduced, near.x), kinds, exempt_values)
        return reduced, ended, (*_with_final_errors(out[:count], problem, ended.x), *more)
    if too_many:
        return *given, _contradicting_group(gone, reference_tests(*given))
    if not gone:
        return *given, tuple(out)
    reduced = problem.with_model(aside.model)
    ended = solve(reduced, solution.x)
    final = reference_tests(reduced, ended)
    others = {kind: [test for test in final if test.kind == kind] for kind in {t.kind for t in gone}}
    weak = [test for test in gone if test.normalised_error < MIN_CLEAR_SIGMAS * _typical_error(others[test.kind])]
    if weak:
        contradictory = _contradicting_group(weak, [*weak, *(test for group in others.values() for test in group)])
        again = exempt_values | {(test.kind, test.name) for test in weak}
        return (*given, contradictory) if contradictory else snoop_references(*given, kinds, again)
    doubtful = min(test.normalised_error for test in gone) < MIN_GROSS_SIGMAS
    if doubtful and _penalised_chi2(reduced, ended, gone) >= _penalised_chi2(problem, given[1], ()):
        return *given, ()
    return reduced, ended, tuple(_with_final_errors(out, problem, ended.x))


def _with_final_errors(
    tests: Sequence[ReferenceTest], problem: NetworkProblem, state: NetworkState
) -> Iterator[ReferenceTest]:
    """Tests of reference values, in which the errors of excluded values refer to the final state."""
    names, marks = problem.model.recording.stations, problem.marks
    off = {(v.kind, v.name): v.residual for v in (*reference_values(problem, state), *common_scale(problem, state))}
    for test in tests:
        if test.is_excluded and test.kind == "mark":
            station = names.index(test.name)
            yield replace(
                test,
                error=marks.position_from_mark(station, state.station_positions, state.target_points)
                - state.station_positions[station],
            )
        elif test.is_excluded:
            yield replace(test, residual=off[test.kind, test.name], error=off[test.kind, test.name])
        else:
            yield test


def _contradicting_group(
    wrong_values: Sequence[ReferenceTest], all_tests: Sequence[ReferenceTest]
) -> tuple[ReferenceTest, ...]:
    """Test of a value that contradicts others of its kind, if the data do not show which one is wrong; else empty."""
    for test in wrong_values:
        others = [other for other in all_tests if other.kind == test.kind and other.name != test.name]
        rivals = tuple(other.name for other in others if other.normalised_error > MIN_CLEAR_SIGMAS)
        if rivals and len(others) < MIN_VALUES_FOR_TYPICAL_ERROR:
            return (replace(test, is_excluded=False, indistinguishable_from=rivals),)
    return ()


def _typical_error(tests: Sequence[ReferenceTest]) -> float:
    """Root-mean-square error of reference values of one kind, in their standard deviations; at least 1."""
    return float(np.sqrt(max(1.0, sum(t.chi2_drop for t in tests) / max(sum(t.rank for t in tests), 1))))


def _penalised_chi2(
    problem: NetworkProblem, solution: Solution[NetworkState], excluded_values: Sequence[ReferenceTest]
) -> float:
    """Chi-square without outliers, plus a penalty for each outlier and for each excluded reference value.

    A few outliers may explain a misfit as well as one wrong reference value. The penalty is the critical value of the
    test of the outlier or reference value.
    """
    accepted, ended = snoop_readings(problem, solution.x)
    readings = int(problem.used_readings.sum())
    n_values = len(list(reference_values(problem, solution.x))) + len(excluded_values)
    paid = sum(float(special.chdtri(t.rank, level_of_single_test(n_values, FAMILY_LEVEL))) for t in excluded_values)
    return ended.sum_of_squares + paid + critical_w(readings) ** 2 * (readings - int(accepted.used_readings.sum()))


def _largest_error(
    problem: NetworkProblem,
    solution: Solution[NetworkState],
    kinds: Collection[ReferenceKind],
    exempt_values: Collection[tuple[ReferenceKind, str]],
) -> ReferenceTest | Bools | None:
    """Test of the most contradicting reference value, or flag (n, 3) of a reading that contradicts more; else None."""
    tests = [test for test in reference_tests(problem, solution, MIN_RESIDUAL) if test.rank]
    tests = [test for test in tests if test.kind in {*kinds, "scale"} and (test.kind, test.name) not in exempt_values]
    if not tests or problem.dof < 2:
        return None
    assert solution.factor is not None
    redundancy = redundancy_numbers(problem, solution.factor)
    w = standardised_residuals(problem, problem.reading_residuals(problem.model.predict(solution.x)), redundancy)
    sigma0 = noise_scale(w, redundancy)

    def noise(test: ReferenceTest) -> float:
        healed = np.sqrt(max(solution.sum_of_squares - test.chi2_drop, 0.0) / max(problem.dof - test.rank, 1))
        return max(1.0, min(sigma0, float(healed)))

    def neg_log_corrected_p(chi2_drop: float, rank: int, n_tests: int) -> float:
        return float(neg_log_p_chi2(chi2_drop, rank)) - float(np.log(n_tests))

    n_values = len(list(reference_values(problem, solution.x)))
    chances = [neg_log_corrected_p(test.chi2_drop / noise(test) ** 2, test.rank, n_values) for test in tests]
    best = int(np.argmax(chances))
    chance, scatter = chances[best], noise(tests[best])
    scaled = tests[best].chi2_drop / scatter**2
    if scaled < max(MIN_CLEAR_SIGMAS, critical_w(n_values)) ** 2 or chance < -np.log(FAMILY_LEVEL):
        return None
    worst = int(np.argmax(np.nan_to_num(np.abs(w))))
    reading = float(np.nan_to_num(w).flat[worst]) / scatter  # two causes are weighed by one noise
    if neg_log_corrected_p(reading**2, 1, int(problem.used_readings.sum())) <= chance:
        second = _second_setup_over_mark(problem, tests[best])
        likely = [
            k
            for k, other in enumerate(chances)
            if k == best
            or (tests[k].kind, tests[k].name) == ("mark", second)
            or other >= chance + np.log(MIN_REPORTED_PROBABILITY)
        ]
        if len(likely) > 1 and tests[best].kind == "level":
            return None  # A few levels against each other: nothing that others would not tell better.
        if tests[best].kind == "scale":
            return replace(tests[best], is_excluded="scale" in kinds)
        marks = all(tests[k].kind == "mark" for k in likely)  # Either way they are distinct points: the later one goes.
        chosen = likely[-1] if marks else best
        rivals = tuple(tests[k].name for k in likely if k != chosen)
        return replace(tests[chosen], is_excluded=marks or not rivals, indistinguishable_from=rivals)
    aside = np.zeros(w.shape, dtype=bool)
    aside.flat[worst] = True
    return aside


def _second_setup_over_mark(problem: NetworkProblem, test: ReferenceTest) -> str:
    """Name of the other set-up over a mark that two set-ups and nothing else determine; otherwise empty.

    The exclusion of either set-up from the mark is then the same. Tests of a large error differ only by linearisation.
    """
    stations, names = problem.model.recording.stations, problem.marks.mark_names
    if test.kind != "mark" or problem.marks.target_indices[stations.index(test.name)] >= 0:
        return ""
    mark = names[stations.index(test.name)]
    others = [station for station, name in zip(stations, names, strict=True) if name == mark and station != test.name]
    return others[0] if len(others) == 1 else ""


def _exclude_inconsistent_kind(
    problem: NetworkProblem, solution: Solution[NetworkState], excluded_tests: Sequence[ReferenceTest]
) -> bool:
    every = [value.kind for value in reference_values(problem, solution.x)]
    gone = [test.kind for test in excluded_tests]
    return any(
        gone.count(kind) > max(1.0, MAX_EXCLUDED_FRACTION * every.count(kind)) for kind in TESTED_REFERENCE_KINDS
    )
