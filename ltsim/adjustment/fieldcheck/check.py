"""Field check: tests of every set-up by repeated measurements, and tests of the network, with corrected p-values.

All tests of a recording share one false-alarm probability, `level`. Half of it is for the tests of single set-ups, half
for the tests of the network. Each half is divided equally among its tests, and the part of each test equally among the
targets, time gaps or pointings that the test examines (Bonferroni).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.blunders import apply_corrections, detect_blunders
from ltsim.adjustment.fieldcheck.bump_choice import most_significant, neg_log_p_of_chi2_drop
from ltsim.adjustment.fieldcheck.network import (
    adjust_for_check,
    n_network_tests,
    network_check_items,
    with_increased_noise_at_noisy_targets,
)
from ltsim.adjustment.fieldcheck.result import (
    BonferroniFamily,
    Check,
    CheckArrays,
    CheckItem,
    CheckItemKind,
    SetupCheck,
)
from ltsim.adjustment.fieldcheck.scatter import noise_factors_by_target_scatter, repeatability_item, target_scatter_item
from ltsim.adjustment.fieldcheck.sentences import (
    bump_sentence,
    estimated_noise_text,
    gross_pointing_sentence,
    station_drift_sentence,
    two_face_sentence,
    zero_drift_sentence,
)
from ltsim.adjustment.fieldcheck.setup_model import AddedColumnsFit, SetupModel, TwoFaceDifferences
from ltsim.adjustment.identification import CauseSelection, cause_tests, identify_causes
from ltsim.adjustment.reliability import neg_log_p_chi2
from ltsim.adjustment.significance import FAMILY_WISE_LEVEL, MAX_SINGLE_ERROR_FRACTION
from ltsim.adjustment.station_motions import UniformMotion, with_mean_times_of_consecutive_pointings
from ltsim.adjustment.structure import raise_for_singular_network
from ltsim.core.arguments import check_argument_bounds
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.core.limits import MAX_ADJUSTED_POINTINGS, MAX_ADJUSTED_TARGETS
from ltsim.core.rounding import index_of_largest
from ltsim.geometry.rigid import MIN_POINTS_FOR_POSE
from ltsim.physics.effects.index_drift import IndexDrift
from ltsim.physics.effects.motions import StationMotionEffect
from ltsim.physics.effects.range_drift import RangeDrift
from ltsim.physics.effects.station_bump import StationBump
from ltsim.physics.model.construction import GeometricErrorModel, declared_construction
from ltsim.recordings.exchange import RecordingSource, load_recording
from ltsim.recordings.recording import Recording
from ltsim.recordings.times import interval_text

N_TESTS_PER_SETUP = 6
"""Number of tests of one set-up: two faces, gross errors, sudden motion, station drift, instrument drift, scatter."""


DriftSentenceFunction = Callable[[Recording, AddedColumnsFit, bool], str]
"""Function that returns the sentence on a drift test, from the recording of a set-up, the fit of the drift, and a flag,
True if the test passed."""


def check(
    recording: RecordingSource, *, level: float = FAMILY_WISE_LEVEL, mpe: tuple[float, float] | None = None
) -> Check:
    """Field check of a recording: tests of two-face differences, repeated points, motions, drifts and scatter.

    Parameters
    ----------
    recording : Recording, str or Path
    level : float
        Probability of a false alarm in the whole recording, for the declared noise and a tracker within specification.
    mpe : pair of float, optional
        Maximum permissible two-face difference, as a length: constant part [um] and part proportional to the range
        [um/m], such as ``(20, 6)``; default from the noise and the specification of the instrument.

    Raises
    ------
    NetworkError
        When no station measured a target twice, so that no test is possible, or when the recording has more than
        `MAX_ADJUSTED_POINTINGS` pointings.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> lt.check(recording).passed
    True
    """
    check_argument_bounds(level=level, required_argument="level")
    full_recording = load_recording(recording)
    full_recording.require_at_most(MAX_ADJUSTED_POINTINGS, MAX_ADJUSTED_TARGETS, "a check")
    identification = identify_causes(full_recording) if len(full_recording.stations) > 1 else None
    selection = identification if identification is not None and _uses_corrected_readings(identification) else None
    moving = identification.certain_station_motions if identification is not None and selection is None else ()
    causes = () if selection is None else cause_tests(selection)
    corrected = full_recording if selection is None else selection.fit.correct_recording(full_recording)
    paired = (
        full_recording if selection is None else selection.fit.correct_recording(full_recording, keeps_outliers=True)
    )
    family = BonferroniFamily(level, 2 * N_TESTS_PER_SETUP * max(len(full_recording.stations), 1))
    all_indices = range(len(full_recording.stations))
    setups, network = (
        tuple(_test_setup(corrected, paired, full_recording, s, family, mpe) for s in all_indices),
        tuple[CheckItem, ...](),
    )
    if len(full_recording.stations) > 1:
        motions = tuple(motion for setup in setups for motion in setup.motions)
        moving = tuple(motion for motion in moving if motion.stations not in {m.stations for m in motions})
        # An adjustment refuses a recording in a wrong unit; so does its comparison of the stations.
        is_in_wrong_unit = selection is not None and selection.has_unit_errors
        adjustment_or_error = adjust_for_check(full_recording if is_in_wrong_unit else corrected, motions)
        recording_to_test, noise_scaled_recording, scattering = corrected, corrected, tuple[CheckItem, ...]()
        if isinstance(adjustment_or_error, Adjustment):
            noise_scaled_recording, scattering = with_increased_noise_at_noisy_targets(corrected, adjustment_or_error)
            recording_to_test = apply_corrections(noise_scaled_recording, detect_blunders(adjustment_or_error))
        if recording_to_test is not corrected:  # errors with an identified cause are no errors of a set-up
            setups = tuple(
                _test_setup(recording_to_test, recording_to_test, full_recording, s, family, mpe) for s in all_indices
            )
        shared = BonferroniFamily(level, 2 * n_network_tests(full_recording))
        network_tests = network_check_items(
            noise_scaled_recording,
            adjustment_or_error,
            shared,
            motions,
            moving,
            uses_target_noise=noise_scaled_recording is not corrected,
            noise_text=estimated_noise_text(noise_scaled_recording, full_recording),
        )
        network = (*scattering, *network_tests)
    result = Check.from_items(CheckArrays(full_recording, setups), network, level, causes)
    if not result.items:
        message = "no station measured a target twice, so no test is possible yet; "
        raise NetworkError(message + "measure some targets in both faces, or the first targets again at the end")
    return result


def _uses_corrected_readings(selection: CauseSelection) -> bool:
    """True if a field check tests set-ups and network with readings that are corrected for the identified causes."""
    return selection.requires_adjustment_with_causes or selection.is_consistent or selection.has_unit_errors


@raise_for_singular_network
def _test_setup(
    setup_recording: Recording,
    paired_recording: Recording,
    recording_with_declared_noise: Recording,
    station: int,
    test_family: BonferroniFamily,
    mpe: tuple[float, float] | None,
) -> SetupCheck:
    """Results of the tests of the set-up with the index `station`.

    The three recordings contain the same pointings with different corrections. All tests share the false-alarm rate of
    `test_family`. The two-face differences are those of `paired_recording`, which contains outliers. The other tests
    use `setup_recording`. `recording_with_declared_noise` is for sentences. `mpe` is the maximum permissible two-face
    difference: constant part [um] and part per range [um/m]; None for the limit by noise and specification.
    """
    indices = np.flatnonzero(setup_recording.station == station)
    recording, row_numbers, name = setup_recording.select(indices), indices + 1, setup_recording.stations[station]
    construction, noise_text = (
        declared_construction(recording),
        estimated_noise_text(recording, recording_with_declared_noise.select(indices)),
    )
    setup_model = SetupModel.from_recording(recording, construction)
    setup_tests = GrossAndMotionTests((), setup_model, (), recording)
    if setup_model.dof > 0:
        setup_tests = _gross_and_motion_tests(setup_model, construction, test_family, row_numbers)
    two_faced, corrected = paired_recording.select(indices), setup_tests.motion_corrected_recording.readings
    corrected = np.where(np.isnan(corrected), two_faced.readings, corrected)
    items, faces = (
        list[CheckItem](),
        TwoFaceDifferences.from_recordings(
            two_faced, two_faced.with_readings(corrected), construction, test_family.alpha_per_test, mpe
        ),
    )
    if faces is not None:
        noise = "the estimated noise and the specification" if noise_text else "noise and specification"
        limit = noise if mpe is None else "the limit"
        sentence, targets, worst = two_face_sentence(faces, recording, limit)
        pair = tuple(row_numbers[worst].tolist())
        items.append(CheckItem.from_test(name, "two-face", not targets, sentence, targets=targets, rows=pair))
    if setup_model.dof < 1:
        return SetupCheck(name, tuple(items), faces, None, row_numbers)
    remaining = setup_tests.corrected_setup_model
    scale = noise_factors_by_target_scatter(remaining, test_family)
    if scale is None:
        items += [*setup_tests.items, repeatability_item(remaining, test_family, noise_text)]
    else:
        setup_tests = _gross_and_motion_tests(
            SetupModel.from_recording(recording, construction, sigma=setup_model.reading_sigmas * scale),
            construction,
            test_family,
            row_numbers,
        )
        items += [target_scatter_item(setup_model, remaining, test_family, noise_text), *setup_tests.items]
    return SetupCheck(name, tuple(items), faces, remaining, row_numbers, setup_tests.motions)


@dataclass(frozen=True)
class GrossAndMotionTests:
    """Results of the tests of one set-up for gross errors, motions of the station and drifts of the instrument."""

    items: tuple[CheckItem, ...]
    """Test results, one per test."""
    corrected_setup_model: SetupModel
    """Linear model of the readings without gross pointings, in which detected motions and drifts are fitted too."""
    motions: tuple[StationMotionEffect, ...]
    """Detected motions of the station: sudden (bump) or at a constant rate (drift)."""
    motion_corrected_recording: Recording
    """Recording of the set-up whose readings are corrected for the detected motions and drifts."""


def _gross_and_motion_tests(
    setup_model: SetupModel, construction: GeometricErrorModel, test_family: BonferroniFamily, row_numbers: Ints
) -> GrossAndMotionTests:
    """Tests of one set-up for gross errors, a bump, and drifts of the station and of the instrument's zeros.

    `row_numbers` (n,) are the rows of the n pointings of the set-up in the whole recording, from 1.
    """
    gross, bump, setup_model = _gross_pointings_and_bump(setup_model, construction, test_family)
    check_items = [
        _gross_item(setup_model, gross, row_numbers, test_family),
        _bump_item(setup_model, bump, row_numbers, test_family),
    ]
    recording, uniform_motion = setup_model.recording, UniformMotion((setup_model.recording.stations[0],))
    motions: list[StationMotionEffect] = [] if bump is None else [bump]
    designs = [motion.design(setup_model.sightings) for motion in motions]
    remaining = reduce(SetupModel.with_fitted_columns, designs, setup_model)
    drift_design, zeros = uniform_motion.design(setup_model.sightings), _instrument_drift_design(setup_model)
    check_items.append(_drift_item(remaining, test_family, "drift", drift_design, station_drift_sentence))
    if not check_items[-1].passed:
        motions.append(uniform_motion)
        designs, remaining = [*designs, drift_design], remaining.with_fitted_columns(drift_design)
    check_items.append(_drift_item(remaining, test_family, "instrument-drift", zeros, zero_drift_sentence))
    if not check_items[-1].passed:
        designs, remaining = [*designs, zeros], remaining.with_fitted_columns(zeros)
    if designs:
        together = np.concatenate(designs, axis=2)
        recording = recording.with_readings(recording.readings - together @ setup_model.fit_columns(together).estimates)
    return GrossAndMotionTests(tuple(check_items), remaining, tuple(motions), recording)


def _gross_pointings_and_bump(
    setup_model: SetupModel, construction: GeometricErrorModel, test_family: BonferroniFamily
) -> tuple[dict[int, float], StationBump | None, SetupModel]:
    """Gross pointings (index and p-value), sudden station motion, and linear model without the gross pointings.

    Gross pointings are removed one by one, until a bump (station motion) explains the readings better than the next
    gross error does. The bump is None if it is not significant.
    """
    gross: dict[int, float] = {}
    most = max(1, MAX_SINGLE_ERROR_FRACTION * len(setup_model.row_mask))
    while True:
        drop, rank = setup_model.removal_chi2_drops_and_dof()
        alone = neg_log_p_chi2(drop, rank) - np.log(len(setup_model.row_mask))
        worst = index_of_largest(alone)
        bump, explained, gaps = best_fitting_bump(setup_model)
        creep = neg_log_p_of_chi2_drop(setup_model.fit_columns(UniformMotion().design(setup_model.sightings)))
        steady = creep >= neg_log_p_of_chi2_drop(explained) - np.log(gaps)
        bump = None if steady or setup_model.p_value(explained) * gaps >= test_family.alpha_per_test else bump
        enough = (
            alone[worst] <= max(-np.log(test_family.alpha_per_test), creep if steady else 0.0) or len(gross) >= most
        )
        if enough or (bump is not None and alone[worst] <= neg_log_p_of_chi2_drop(explained) - np.log(gaps)):
            return gross, bump, setup_model
        gross[worst] = float(np.exp(-alone[worst]))
        use: Bools = setup_model.row_mask & np.asarray(np.arange(len(setup_model.row_mask)) != worst)
        setup_model = SetupModel.from_recording(setup_model.recording, construction, use, setup_model.reading_sigmas)


def best_fitting_bump(setup_model: SetupModel) -> tuple[StationBump | None, AddedColumnsFit, int]:
    """Bump (sudden motion of the station) that explains the readings best, its fit, and the number of tested time gaps.

    A bump is possible in each time gap between pointings with at least three targets measured before and after it. The
    result is None, with an empty fit, if there is no such gap.
    """
    candidates = [
        bump
        for bump in StationBump.candidates(setup_model.sightings)
        if _n_targets_across_bump(setup_model, bump) >= MIN_POINTS_FOR_POSE
    ]
    if not candidates:
        return None, AddedColumnsFit(0.0, 0, np.zeros(6), np.zeros((6, 6))), 1
    explained_by = {bump: setup_model.fit_columns(bump.design(setup_model.sightings)) for bump in candidates}
    for bump in most_significant(explained_by).neighbours(setup_model.sightings):
        if _n_targets_across_bump(setup_model, bump) >= MIN_POINTS_FOR_POSE:
            explained_by[bump] = setup_model.fit_columns(bump.design(setup_model.sightings))
    best_candidate = most_significant(explained_by)
    return best_candidate, explained_by[best_candidate], len(np.unique(setup_model.sightings.time)) - 1


def _n_targets_across_bump(setup_model: SetupModel, bump: StationBump) -> int:
    """Number of targets measured both before and after a bump (sudden motion of the station)."""
    is_after = setup_model.sightings.time >= bump.time
    target = setup_model.recording.target
    return len(np.intersect1d(target[setup_model.row_mask & is_after], target[setup_model.row_mask & ~is_after]))


def _gross_item(
    setup_model: SetupModel, p_values: Mapping[int, float], row_numbers: Ints, test_family: BonferroniFamily
) -> CheckItem:
    """Test result for gross errors of a set-up, from the p-values of its rejected pointings by index.

    `row_numbers` (n,) are the row numbers of the n pointings of the set-up in the whole recording, from 1.
    """
    recording, name = setup_model.recording, setup_model.recording.stations[0]
    targets = tuple(dict.fromkeys(recording.targets[recording.target[i]] for i in p_values))
    sentence, numbers = (
        gross_pointing_sentence(setup_model, list(p_values), row_numbers),
        tuple(row_numbers[list(p_values)].tolist()),
    )
    chance = test_family.corrected_p_value(max(p_values.values())) if p_values else None
    return CheckItem.from_test(name, "gross", not p_values, sentence, chance, targets=targets, rows=numbers)


def _bump_item(
    setup_model: SetupModel, bump: StationBump | None, row_numbers: Ints, test_family: BonferroniFamily
) -> CheckItem:
    """Test result for a sudden motion (bump) of a station; passed if `bump` is None.

    `row_numbers` (n,) are the row numbers of the n pointings of the set-up in the whole recording, from 1.
    """
    recording, name = setup_model.recording, setup_model.recording.stations[0]
    if bump is None:
        return CheckItem.from_test(name, "bump", True, f"{name}: no sudden motion of the station detected")
    fit = setup_model.fit_columns(bump.design(setup_model.sightings))
    order = np.argsort(recording.time, kind="stable")
    index = int(np.searchsorted(recording.time[order], bump.time))
    pair = order[index - 1 : index + 1]
    time_interval = float(recording.time[pair[0]]), float(recording.time[pair[1]])
    rows_around_motion = int(row_numbers[pair[0]]), int(row_numbers[pair[1]])
    chance = test_family.corrected_p_value(setup_model.p_value(fit), len(order) - 1)
    motion_interval_text = interval_text(recording, int(pair[0]), int(pair[1]), row_numbers.tolist())
    sentence = bump_sentence(recording, motion_interval_text, fit)
    return CheckItem.from_test(
        name, "bump", False, sentence, chance, rows=rows_around_motion, motion_interval_s=time_interval
    )


def _instrument_drift_design(setup_model: SetupModel) -> Floats:
    """Changes (n, 3, 2) of the readings of n pointings per unit of two drift rates of the instrument.

    These are the rates of the range zero [m/s] and of the vertical index [rad/s].
    """
    laws, sightings = (
        [RangeDrift(law="visit"), IndexDrift(law="visit")],
        with_mean_times_of_consecutive_pointings(setup_model.sightings),
    )
    return np.concatenate([law.design(sightings) for law in laws], axis=2)


def _drift_item(
    setup_model: SetupModel,
    test_family: BonferroniFamily,
    kind: CheckItemKind,
    design: Floats,
    write_sentence: DriftSentenceFunction,
) -> CheckItem:
    """Test result for a drift of a station or instrument during its occupation.

    `design` (n, 3, k) are the changes of the readings of n pointings per unit of the k parameters of the drift.
    """
    fit = setup_model.fit_columns(design)
    p_value = test_family.corrected_p_value(setup_model.p_value(fit))
    is_passed = p_value >= test_family.false_alarm_rate
    return CheckItem.from_test(
        setup_model.recording.stations[0],
        kind,
        is_passed,
        write_sentence(setup_model.recording, fit, is_passed),
        p_value,
    )
