"""Data snooping of reference values: contradicting coordinates, lengths, levels and azimuths are excluded.

A wrong reference value biases the residuals of all readings that it constrains. Reference values are therefore tested
before single readings. The reference value with the smallest p-value is excluded first.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from ltsim.adjustment.datum import solution_near_excluded_points
from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.reference_tests import (
    MIN_TESTED_REDUNDANCY,
    TESTED_REFERENCE_KINDS,
    ReferenceTest,
    reference_tests,
)
from ltsim.adjustment.reference_values import (
    ReferenceKind,
    common_scale_reference,
    drop_reference,
    reference_values,
    with_nonzero_reference_sigmas,
)
from ltsim.adjustment.reliability import (
    critical_normalised_residual,
    level_of_single_test,
    neg_log_p_chi2,
    noise_factor,
    noise_factor_from_residuals,
    normalise_residuals,
    redundancy_numbers,
)
from ltsim.adjustment.significance import (
    FAMILY_WISE_LEVEL,
    MIN_CERTAIN_ERROR_SIGMAS,
    MIN_GROSS_ERROR_SIGMAS,
    MIN_REPORTED_PROBABILITY,
)
from ltsim.adjustment.snooping import snoop_readings
from ltsim.core.arrays import Bools
from ltsim.physics.model.measurement import NetworkState
from ltsim.solve.gauss_newton import Solution, solve

MIN_TESTED_WHITENED_RESIDUAL = MIN_CERTAIN_ERROR_SIGMAS * float(np.sqrt(MIN_TESTED_REDUNDANCY))
"""Smallest whitened residual of a tested reference value. An error of `MIN_CERTAIN_ERROR_SIGMAS` standard deviations
causes a larger residual, if the redundancy number is at least `MIN_TESTED_REDUNDANCY`."""
MIN_OTHERS_TO_IDENTIFY_WRONG_VALUE = 3
"""Smallest number of other reference values of the same kind that identify which of several contradicting values is
wrong. If there are fewer, no value is excluded."""
MAX_CHI2_FRACTION_AFTER_EXCLUSION = 1e-6
"""Limit of the ratio of chi-square after and before the exclusion of reference values. If the ratio is smaller, the
excluded values are certainly wrong."""
MAX_EXCLUDED_REFERENCE_FRACTION = 1 / 3
"""Largest fraction of the reference values of one kind that may be excluded. If more seem wrong, all values of this
kind are inconsistent and no value is excluded."""


def snoop_references(
    problem: NetworkProblem,
    solution: Solution[NetworkState],
    reference_kinds: Collection[ReferenceKind] = TESTED_REFERENCE_KINDS,
    exempt_values: frozenset[tuple[ReferenceKind, str]] = frozenset(),
) -> tuple[NetworkProblem, Solution[NetworkState], tuple[ReferenceTest, ...]]:
    """Problem without contradicting reference values, its solution, and the tests of the contradicting values.

    The values are excluded one by one, each time the value with the smallest p-value. A single reading that explains
    the misfit better is left out during the tests. Only values of the kinds `reference_kinds` may be excluded, except
    for `exempt_values` (kind and name).
    """
    given, aside = (problem, solution), with_nonzero_reference_sigmas(problem, solution.x)
    out: list[ReferenceTest] = []
    by_far: tuple[NetworkProblem, Solution[NetworkState], int] | None = None
    if solution.factor is not None and aside is not problem:
        solution = solve(aside, solution.x)
    while solution.factor is not None and len(out) < len(problem.model.recording.targets):
        suspect = _most_contradicting_observation(aside, solution, reference_kinds, exempt_values)
        if suspect is None:
            break
        if isinstance(suspect, ReferenceTest):
            out.append(suspect)
            if not suspect.is_excluded:
                break
            model = replace(aside.model, recording=drop_reference(aside.model.recording, suspect))
            aside = with_nonzero_reference_sigmas(aside.with_model(model), solution.x)
        else:
            aside = replace(aside, is_used_reading=aside.is_used_reading & ~suspect)
        solution = solve(aside, solution.x)
        enough = solution.sum_of_squares < MAX_CHI2_FRACTION_AFTER_EXCLUSION * given[1].sum_of_squares
        if by_far is None and out and enough and not _is_any_kind_inconsistent(*given, out):
            by_far = problem.with_model(aside.model), solution, len(out)
    gone = [test for test in out if test.is_excluded]
    too_many = solution.factor is None or _is_any_kind_inconsistent(*given, gone)
    if too_many and by_far is not None:
        reduced, near, count = by_far
        near = solution_near_excluded_points(reduced, solve(reduced, near.x), out[:count])
        reduced, ended, more = snoop_references(reduced, near, reference_kinds, exempt_values)
        return reduced, ended, (*_tests_with_final_errors(out[:count], problem, (reduced, ended)), *more)
    if too_many:
        return *given, _contradicting_group(gone, reference_tests(*given))
    if not gone:
        return *given, tuple(out)
    reduced = problem.with_model(aside.model)
    ended = solution_near_excluded_points(reduced, solve(reduced, solution.x), gone)
    final = reference_tests(reduced, ended)
    others = {kind: [test for test in final if test.kind == kind] for kind in {t.kind for t in gone}}
    weak = [
        test
        for test in gone
        if test.normalised_error < MIN_CERTAIN_ERROR_SIGMAS * _rms_normalised_error(others[test.kind])
    ]
    if weak:
        contradictory = _contradicting_group(weak, [*weak, *(test for group in others.values() for test in group)])
        again = exempt_values | {(test.kind, test.name) for test in weak}
        return (*given, contradictory) if contradictory else snoop_references(*given, reference_kinds, again)
    doubtful = min(test.normalised_error for test in gone) < MIN_GROSS_ERROR_SIGMAS
    if doubtful and _penalised_chi2(reduced, ended, gone) >= _penalised_chi2(problem, given[1], ()):
        return *given, ()
    return reduced, ended, tuple(_tests_with_final_errors(out, problem, (reduced, ended)))


def _tests_with_final_errors(
    tests: Sequence[ReferenceTest],
    problem: NetworkProblem,
    final_problem_and_solution: tuple[NetworkProblem, Solution[NetworkState]],
) -> Iterator[ReferenceTest]:
    """Tests of reference values of `problem`, with errors and noise from the solution after all exclusions."""
    state, factor = final_problem_and_solution[1].x, noise_factor(*final_problem_and_solution)
    names, marks = problem.model.recording.stations, problem.marks
    off = {
        (v.kind, v.name): v.residual
        for v in (*reference_values(problem, state), *common_scale_reference(problem, state))
    }
    for test in (each.with_noise_factor(factor) for each in tests):
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
    """Test of a reference value that contradicts others of its kind, as a tuple; empty if the wrong one is clear.

    `wrong_values` are the tests of rejected values, `all_tests` those of all values. The returned test lists the values
    that may be wrong instead (`indistinguishable_from`).
    """
    for test in wrong_values:
        others = [other for other in all_tests if other.kind == test.kind and other.name != test.name]
        rivals = tuple(other.name for other in others if other.normalised_error > MIN_CERTAIN_ERROR_SIGMAS)
        if rivals and len(others) < MIN_OTHERS_TO_IDENTIFY_WRONG_VALUE:
            return (replace(test, is_excluded=False, indistinguishable_from=rivals),)
    return ()


def _rms_normalised_error(tests: Sequence[ReferenceTest]) -> float:
    """Root mean square of the normalised errors of tested reference values of one kind, at least 1."""
    return float(np.sqrt(max(1.0, sum(t.chi2_drop for t in tests) / max(sum(t.rank for t in tests), 1))))


def _penalised_chi2(
    problem: NetworkProblem, solution: Solution[NetworkState], excluded_tests: Sequence[ReferenceTest]
) -> float:
    """Chi-square without outliers, plus a penalty for each outlier and each excluded reference value.

    The penalty is the critical value of chi-square in the test of the outlier or reference value. The sum serves to
    decide between two explanations of a misfit: a few outliers, or wrong reference values.
    """
    accepted, ended = snoop_readings(problem, solution.x)
    readings = int(problem.is_used_reading.sum())
    count = len(list(reference_values(problem, solution.x))) + len(excluded_tests)
    paid = sum(
        float(special.chdtri(test.rank, level_of_single_test(count, FAMILY_WISE_LEVEL))) for test in excluded_tests
    )
    return (
        ended.sum_of_squares
        + paid
        + critical_normalised_residual(readings) ** 2 * (readings - int(accepted.is_used_reading.sum()))
    )


def _most_contradicting_observation(
    problem: NetworkProblem,
    solution: Solution[NetworkState],
    kinds: Collection[ReferenceKind],
    exempt_values: Collection[tuple[ReferenceKind, str]],
) -> ReferenceTest | Bools | None:
    """Test of the most contradicting reference value, or mask (n, 3) with the flag of a reading that contradicts more.

    Values of the `kinds` are tested, except for `exempt_values` (kind and name). The result is None if no reference
    value contradicts the other observations significantly.
    """
    tests = [test for test in reference_tests(problem, solution, MIN_TESTED_WHITENED_RESIDUAL) if test.rank]
    tests = [test for test in tests if test.kind in {*kinds, "scale"} and (test.kind, test.name) not in exempt_values]
    if not tests or problem.dof < 2:
        return None
    assert solution.factor is not None
    redundancy = redundancy_numbers(problem, solution.factor)
    w = normalise_residuals(problem, problem.reading_residuals(problem.model.predict(solution.x)), redundancy)
    shown = noise_factor_from_residuals(w, redundancy)

    def scatter_without(test: ReferenceTest) -> float:
        healed = np.sqrt(max(solution.sum_of_squares - test.chi2_drop, 0.0) / max(problem.dof - test.rank, 1))
        return max(1.0, min(shown, float(healed)))

    def neg_log_corrected_p(chi2_drop: float, rank: int, n_tests: int) -> float:
        return float(neg_log_p_chi2(chi2_drop, rank)) - float(np.log(max(n_tests, 1)))

    count = len(list(reference_values(problem, solution.x)))
    chances = [neg_log_corrected_p(test.chi2_drop / scatter_without(test) ** 2, test.rank, count) for test in tests]
    best = int(np.argmax(chances))
    chance, scatter = chances[best], scatter_without(tests[best])
    scaled = tests[best].chi2_drop / scatter**2
    if scaled < max(MIN_CERTAIN_ERROR_SIGMAS, critical_normalised_residual(count)) ** 2 or chance < -np.log(
        FAMILY_WISE_LEVEL
    ):
        return None
    worst = int(np.argmax(np.nan_to_num(np.abs(w))))
    reading = float(np.nan_to_num(w).flat[worst]) / scatter  # both causes are tested with the same noise
    if neg_log_corrected_p(reading**2, 1, int(problem.is_used_reading.sum())) <= chance:
        second = _second_setup_over_mark(problem, tests[best])
        likely = [
            k
            for k, other in enumerate(chances)
            if k == best
            or (tests[k].kind, tests[k].name) == ("mark", second)
            or other >= chance + np.log(MIN_REPORTED_PROBABILITY)
        ]
        if len(likely) > 1 and tests[best].kind == "level":
            return None  # a few levels contradict each other: the tests of other values identify the cause better
        if tests[best].kind == "scale":
            return replace(tests[best], is_excluded="scale" in kinds)
        marks = all(tests[k].kind == "mark" for k in likely)  # distinct points in each case: the later one is excluded
        chosen = likely[-1] if marks else best
        rivals = tuple(tests[k].name for k in likely if k != chosen)
        return replace(tests[chosen], is_excluded=marks or not rivals, indistinguishable_from=rivals)
    aside = np.zeros(w.shape, dtype=bool)
    aside.flat[worst] = True
    return aside


def _second_setup_over_mark(problem: NetworkProblem, test: ReferenceTest) -> str:
    """Name of the other set-up over a mark, if exactly two set-ups over it determine the mark; otherwise empty.

    It does not matter then which of the two set-ups is excluded. Their tests of a large error differ only by errors of
    linearisation.
    """
    stations, names = problem.model.recording.stations, problem.marks.mark_names
    if test.kind != "mark" or problem.marks.target_indices[stations.index(test.name)] >= 0:
        return ""
    mark = names[stations.index(test.name)]
    others = [station for station, name in zip(stations, names, strict=True) if name == mark and station != test.name]
    return others[0] if len(others) == 1 else ""


def _is_any_kind_inconsistent(
    problem: NetworkProblem, solution: Solution[NetworkState], excluded_tests: Sequence[ReferenceTest]
) -> bool:
    """True if more than `MAX_EXCLUDED_REFERENCE_FRACTION` of the reference values of at least one kind are excluded."""
    every = [value.kind for value in reference_values(problem, solution.x)]
    gone = [test.kind for test in excluded_tests]
    return any(
        gone.count(kind) > max(1.0, MAX_EXCLUDED_REFERENCE_FRACTION * every.count(kind))
        for kind in TESTED_REFERENCE_KINDS
    )
