"""Tests of a field check that compare the stations of a recording: common targets, levels and known lengths."""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.blunders import detect_blunders
from ltsim.adjustment.centring import estimate_centring_errors
from ltsim.adjustment.estimate import adjust
from ltsim.adjustment.fieldcheck.result import BonferroniFamily, CheckItem, two_sided_chi2_p_value
from ltsim.adjustment.quality import network_warnings, require_usable_adjustment
from ltsim.adjustment.reference_tests import reference_tests_with_estimated_noise
from ltsim.adjustment.reference_values import ReferenceKind
from ltsim.adjustment.significance import GLOBAL_TEST_LEVEL, MIN_CHECKED_REDUNDANCY, MIN_DOF_FOR_ESTIMATED_NOISE
from ltsim.adjustment.station_motions import FittedMotion, SuddenMotion, motions_with_sentences
from ltsim.adjustment.verdict import VerdictCase, verdict_on
from ltsim.core.arrays import Bools
from ltsim.core.errors import ConvergenceError, LtsimError, NetworkError
from ltsim.core.rounding import SQRT_MACHINE_EPSILON
from ltsim.core.units import ARCSECOND, MILLIMETRE
from ltsim.physics.effects.motions import StationMotionEffect
from ltsim.physics.model.construction import declared_construction
from ltsim.recordings.recording import SIGMA_COLUMNS, Recording
from ltsim.recordings.specification import noise_origin
from ltsim.solve.design import robust_sigma

N_NETWORK_TESTS = 2
"""Number of tests that compare all stations: one of common targets, one of levels. Known lengths add a third test."""
EXCLUDABLE_REFERENCE_KINDS: tuple[ReferenceKind, ...] = ("point", "difference", "length", "mark", "scale")
"""Kinds of reference values that the adjustment of a field check may exclude. Levels are not among them, because they
are tested station by station."""


def n_network_tests(recording: Recording) -> int:
    """Number of tests that compare all stations of a recording: 2, or 3 with known lengths."""
    return N_NETWORK_TESTS + bool(recording.gauge.distance)


def adjust_for_check(recording: Recording, motions: Sequence[StationMotionEffect]) -> Adjustment | LtsimError:
    """Network adjustment with the station motions `motions` as unknowns, or the error that prevents the adjustment."""
    try:
        plain = adjust(
            recording, effects=motions, robust=bool(motions), tested_reference_kinds=EXCLUDABLE_REFERENCE_KINDS
        )
        require_usable_adjustment(plain)
    except (NetworkError, ConvergenceError) as problem:
        return problem
    return plain


def with_increased_noise_at_noisy_targets(
    recording: Recording, adjustment_or_error: Adjustment
) -> tuple[Recording, tuple[CheckItem, ...]]:
    """Recording with increased standard deviations at noisy targets, and the failed test of these targets.

    Readings to a noisy target scatter much more than those to other targets. Errors of the instrument, which affect
    near and steep targets most, cannot be the reason, because they are estimated. Without noisy targets the recording
    is returned unchanged, without a test.
    """
    if adjustment_or_error.rejected_references or not len(adjustment_or_error.noisy_targets_and_scatter[0]):
        return recording, ()
    with suppress(NetworkError):  # instruments of two designs: their errors are not estimated
        adjustment_or_error = adjust(
            recording,
            declared_construction(recording),
            effects=adjustment_or_error.effects,
            tested_reference_kinds=EXCLUDABLE_REFERENCE_KINDS,
        )
    noisy_targets, ratio, ratio_elsewhere = adjustment_or_error.noisy_targets_and_scatter
    if (
        not len(noisy_targets)
        or not ratio > 1.0
        or verdict_on(adjustment_or_error).case is not VerdictCase.UNEXPLAINED_MISFIT
    ):
        return recording, ()
    is_noisy = np.isin(recording.target, noisy_targets)
    w_by_observable = [
        w[share > MIN_CHECKED_REDUNDANCY]
        for w, share in zip(
            adjustment_or_error.normalised_residuals[is_noisy].T,
            adjustment_or_error.redundancy[is_noisy].T,
            strict=True,
        )
    ]
    ratios = [robust_sigma(w) if len(w) >= MIN_DOF_FOR_ESTIMATED_NOISE else ratio for w in w_by_observable]
    sigma = (
        np.where(is_noisy[:, None], np.maximum(ratios, 1.0), 1.0)
        * recording.reading_sigmas()
        / [MILLIMETRE, ARCSECOND, ARCSECOND]
    )
    scaled_recording = recording.replace(
        covariates={**recording.covariates, **dict(zip(SIGMA_COLUMNS, sigma.T, strict=True))}
    )
    names = tuple(recording.targets[t] for t in noisy_targets)
    origin = noise_origin(recording.notes)
    scatter_words = f"scatter {ratio:.2g} times the {origin} noise, other readings {ratio_elsewhere:.2g} times"
    sentence = f"readings to {', '.join(names)} {scatter_words}"
    return scaled_recording, (
        CheckItem.from_test("", "closure", False, f"{sentence}: these targets are unstable", targets=names),
    )


def network_check_items(
    recording: Recording,
    adjustment_or_error: Adjustment | LtsimError,
    test_family: BonferroniFamily,
    motions: Sequence[StationMotionEffect],
    station_motions: Sequence[FittedMotion],
    *,
    uses_target_noise: bool,
    noise_text: str,
) -> tuple[CheckItem, ...]:
    """Results of the tests that compare all stations, with the errors of the instrument estimated.

    `adjustment_or_error` is the network adjusted with the declared noise. With `uses_target_noise`, `recording` has
    increased noise at some targets. `motions` are station motions that the tests of single set-ups detected,
    `station_motions` motions that only the comparison of stations shows. `noise_text` is a text on the estimated noise
    of `recording`, empty for the declared noise.
    """
    try:
        construction = declared_construction(recording)
    except NetworkError as problem:
        return (CheckItem.from_test("", "network", True, f"the stations are not compared: {problem}"),)
    try:
        if isinstance(adjustment_or_error, LtsimError):
            raise adjustment_or_error
        motions = (*motions, *station_motions)
        fitted = adjust(
            recording, construction, effects=motions, robust=True, tested_reference_kinds=EXCLUDABLE_REFERENCE_KINDS
        )
    except (NetworkError, ConvergenceError) as problem:
        return (CheckItem.from_test("", "network", False, f"the set-ups do not form a network: {problem}"),)
    check_items = [CheckItem.from_test("", "network", False, doubt) for doubt in network_warnings(adjustment_or_error)]
    check_items += [
        CheckItem.from_test(
            ", ".join(motion.stations), "bump" if isinstance(motion, SuddenMotion) else "drift", False, sentence
        )
        for motion, sentence in motions_with_sentences(fitted)
        if motion in station_motions
    ]
    is_explained = np.zeros(len(recording), dtype=bool)
    for motion, *_ in detect_blunders(adjustment_or_error):
        stations = ", ".join(motion.stations)
        check_items.append(
            CheckItem.from_test(
                stations,
                "mistake",
                False,
                motion.sentence,
                targets=motion.targets,
                rows=tuple(motion.pointing_indices + 1),
            )
        )
        is_explained[motion.pointing_indices] = True
    centring_errors = estimate_centring_errors(adjustment_or_error)
    if centring_errors is not None:
        marks = tuple(dict.fromkeys(motion.mark for motion in centring_errors.occupations))
        check_items.append(CheckItem.from_test("", "mistake", False, centring_errors.sentence, targets=marks))
    check_items += [
        CheckItem.from_test("", "reference", False, test.sentence, targets=() if test.kind == "scale" else (test.name,))
        for test in fitted.rejected_references
    ]
    if fitted.solution.has_converged and fitted.dof > 0:
        use, any_rejected = fitted.problem.is_used_reading, fitted.is_rejected_reading.any()
        requires_new_adjustment = any_rejected or uses_target_noise or len(motions) > len(adjustment_or_error.effects)
        adjustment = (
            adjust(recording, effects=motions, reading_mask=use, tested_reference_kinds=EXCLUDABLE_REFERENCE_KINDS)
            if requires_new_adjustment
            else adjustment_or_error
        )
        if _has_instrument_errors(adjustment, fitted):
            adjustment = fitted
        elif any_rejected:
            adjustment = adjust(
                recording, effects=motions, robust=True, tested_reference_kinds=EXCLUDABLE_REFERENCE_KINDS
            )
        p_value, less = two_sided_chi2_p_value(adjustment.chi2, adjustment.dof)
        if (
            uses_target_noise and not less and test_family.corrected_p_value(p_value) < test_family.false_alarm_rate
        ):  # larger noise: only outliers relative to it are reported
            is_explained |= ~np.isin(
                np.arange(len(is_explained)),
                [reading.pointing_index for reading in adjustment_or_error.flagged_readings(uses_estimated_noise=True)],
            )
        check_items += [
            *_target_agreement_items(adjustment, is_explained, test_family, noise_text),
            *_level_items(fitted, test_family),
        ]
        check_items += _length_items(fitted, test_family)
    return tuple(check_items)


def _has_instrument_errors(adjustment_without_errors: Adjustment, adjustment_with_errors: Adjustment) -> bool:
    """True if errors of the instrument explain the misfit of a network better than larger noise does (F test).

    `adjustment_without_errors` does not estimate instrument errors, `adjustment_with_errors` does.
    """
    n_parameters = adjustment_with_errors.problem.unknowns.instrument_columns.size
    f_statistic = (
        (adjustment_without_errors.chi2 - adjustment_with_errors.chi2)
        / n_parameters
        / max(adjustment_with_errors.chi2 / adjustment_with_errors.dof, 1e-30)
    )
    return bool(special.fdtrc(n_parameters, adjustment_with_errors.dof, max(f_statistic, 0.0)) < GLOBAL_TEST_LEVEL)


def _target_agreement_items(
    adjustment: Adjustment, is_explained: Bools, test_family: BonferroniFamily, noise_text: str
) -> list[CheckItem]:
    """Result of the test that stations agree on their common targets, as a list with one item.

    A failed test names the pointing with the largest residual. `is_explained` (n,) flags those of n pointings that
    other tests already report, so that they are left out here. `noise_text` is a text on the estimated noise, empty for
    the declared noise.
    """
    recording, out = adjustment.recording, adjustment.is_rejected_reading.any(axis=1) & ~is_explained
    alone, less = two_sided_chi2_p_value(adjustment.chi2, adjustment.dof)
    p = test_family.corrected_p_value(alone)
    scatter = f"sigma0 is {adjustment.sigma0:.2f}, expected is 1 ({adjustment.dof} degrees of freedom)"
    scatter += f"; {noise_text}" if noise_text else ""
    if not out.any():
        passed = less or p >= test_family.false_alarm_rate
        verb = "agree" if passed else "disagree"
        if passed and not less and alone < GLOBAL_TEST_LEVEL:
            scatter += (
                f"; noise alone causes so large a value in one of {1 / alone:.0f} networks, so the test is passed"
            )
        return [
            CheckItem.from_test("", "network", passed, f"the stations {verb} on their common targets: {scatter}", p)
        ]
    largest_residuals = np.nan_to_num(np.abs(adjustment.residuals / adjustment.problem.reading_sigmas)).max(axis=1)
    outlier_rows = np.flatnonzero(out)
    outlier_rows = outlier_rows[np.argsort(-largest_residuals[outlier_rows], kind="stable")]
    station, target = recording.station[outlier_rows[0]], recording.target[outlier_rows[0]]
    first_reading_text = f"{recording.stations[station]} to {recording.targets[target]}, row {outlier_rows[0] + 1}"
    phrase = f"{len(outlier_rows)} pointings contradict" if len(outlier_rows) > 1 else "a pointing contradicts"
    sentence = f"{phrase} the other stations ({'the worst is ' if len(outlier_rows) > 1 else ''}{first_reading_text})"
    targets = tuple(dict.fromkeys(recording.targets[t] for t in recording.target[outlier_rows]))
    return [
        CheckItem.from_test("", "network", False, sentence, targets=targets, rows=tuple((outlier_rows + 1).tolist()))
    ]


def _level_items(fitted: Adjustment, test_family: BonferroniFamily) -> list[CheckItem]:
    """Results of the tests that the level of each station agrees with the vertical of the other stations."""
    items, levels = [], fitted.problem.level_rows
    for test in fitted.reference_tests if len(levels) > 1 else ():
        if test.kind == "level" and test.redundancy.max() > MIN_CHECKED_REDUNDANCY:
            p = test_family.corrected_p_value(float(special.chdtrc(test.rank, test.chi2_drop)), len(levels))
            verb = "agrees with" if p >= test_family.false_alarm_rate else "deviates from"
            sentence = f"{test.name}: its level {verb} the vertical of the other stations ({test.error_text})"
            items.append(CheckItem.from_test(test.name, "level", p >= test_family.false_alarm_rate, sentence, p))
    return items


def _length_items(fitted: Adjustment, test_family: BonferroniFamily) -> list[CheckItem]:
    """Result of the test that the scale of the known lengths agrees with the measured distances, as a list.

    For a single known length, the length itself is tested. The uncertainty includes the specification of the
    instrument. The list is empty if the adjustment excluded a length or the scale, which another item reports.
    """
    if any(test.kind in ("length", "scale") for test in fitted.rejected_references):
        return []
    tests = reference_tests_with_estimated_noise(fitted.problem, fitted.solution, SQRT_MACHINE_EPSILON)
    lengths = [test for test in tests if test.kind == "length" and test.rank]
    scales = [test for test in tests if test.kind == "scale" and test.rank] or lengths[:1]
    check_items = []
    for test in scales:
        p = test_family.corrected_p_value(float(special.chdtrc(test.rank, test.chi2_drop)))
        passed = p >= test_family.false_alarm_rate
        agreement = (
            f"{test.name}: consistent with the measured distances within noise and specification ({test.error_text})"
        )
        check_items.append(CheckItem.from_test("", "reference", passed, agreement if passed else test.sentence, p))
    return check_items
