"""Field check: tests of every set-up by repeated measurements, with corrected p-values.

All tests of a recording share one false-alarm probability, `level`. Half of it belongs to the tests of single set-ups
and half to those of the network, in equal parts for each test (Bonferroni), and within a test in equal parts for each
target, gap or pointing that was tested.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.blunders import apply_corrections, detect_blunders
from ltsim.adjustment.fieldcheck.network import N_NETWORK_TESTS, adjust_for_check, network_items, scale_target_noise
from ltsim.adjustment.fieldcheck.occupation import ColumnsFit, StationOccupation, TwoFaceDifferences
from ltsim.adjustment.fieldcheck.result import (
    TWO_FACE_TABLE,
    Check,
    CheckArrays,
    CheckItem,
    CheckItemKind,
    HypothesisFamily,
    SetupCheck,
    two_sided_chi2_p_value,
)
from ltsim.adjustment.fieldcheck.words import (
    bump_sentence,
    drift_sentence,
    face_sentence,
    gross_sentence,
    instrument_sentence,
    target_sentence,
)
from ltsim.adjustment.identification import cause_tests, identify_causes
from ltsim.adjustment.reliability import neg_log_p_chi2
from ltsim.adjustment.significance import FAMILY_LEVEL
from ltsim.adjustment.station_motions import MIN_SUPPORTING_TARGETS, UniformMotion, with_equal_times_per_run
from ltsim.adjustment.structure import raise_for_singular_network
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.physics.effects.index_drift import IndexDrift
from ltsim.physics.effects.motions import StationMotion
from ltsim.physics.effects.range_drift import RangeDrift
from ltsim.physics.effects.station_bump import StationBump
from ltsim.physics.model.construction import Construction, declared_construction
from ltsim.recordings.exchange import RecordingSource, load_recording
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import write_result

MAX_GROSS_FRACTION = 0.1
"""Largest fraction of a set-up's pointings that may be gross errors; with more, the declared noise is wrong."""
N_SETUP_TESTS = 6
"""Number of tests of one set-up."""


SentenceWriter = Callable[[Recording, ColumnsFit, bool], str]
"""Function that writes the sentence of a test from the recording, the fit, and a flag that the test passed."""
MIN_TARGET_DOF = 6.0
"""Smallest number of degrees of freedom at which the scatter of a target is tested separately."""


def check(recording: RecordingSource, *, level: float = FAMILY_LEVEL, mpe: tuple[float, float] | None = None) -> Check:
    """Field check of a recording: two-face differences, repeated points, drift, bumps and scatter.

    Parameters
    ----------
    recording : Recording, str or Path
    level : float
        Probability of any false alarm in the whole recording, if noise and specification are correct.
    mpe : pair of float, optional
        Limit of two-face differences as lengths, [um] and [um/m] of the range: ``(20, 6)``; default from the noise and
        the specification of the instrument.

    Raises
    ------
    NetworkError
        When nothing was measured twice: there is nothing to check yet.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> lt.check(recording).passed
    True
    """
    full_recording = load_recording(recording)
    identification = identify_causes(full_recording) if len(full_recording.stations) > 1 else None
    selection = (
        identification
        if identification and (identification.requires_initial_causes or identification.is_consistent)
        else None
    )
    moving = identification.certain_motions if identification is not None and selection is None else ()
    causes = () if selection is None else cause_tests(selection)
    corrected = full_recording if selection is None else selection.fit.correct_recording(full_recording)
    paired = full_recording if selection is None else selection.fit.correct_recording(full_recording, outliers=True)
    family = HypothesisFamily(level, 2 * N_SETUP_TESTS * max(len(full_recording.stations), 1))
    all_indices = range(len(full_recording.stations))
    setups, network = (
        tuple(_test_setup(corrected, paired, s, family, mpe) for s in all_indices),
        tuple[CheckItem, ...](),
    )
    if len(full_recording.stations) > 1:
        motions = tuple(motion for setup in setups for motion in setup.motions)
        moving = tuple(motion for motion in moving if motion.stations not in {m.stations for m in motions})
        plain = adjust_for_check(corrected, motions)
        read, shown, scattering = corrected, corrected, tuple[CheckItem, ...]()
        if isinstance(plain, Adjustment):
            shown, scattering = scale_target_noise(corrected, plain)
            read = apply_corrections(shown, detect_blunders(plain))
        if read is not corrected:  # a set-up is not blamed for what has a name
            setups = tuple(_test_setup(read, read, s, family, mpe) for s in all_indices)
        shared = HypothesisFamily(level, 2 * N_NETWORK_TESTS)
        together = network_items(shown, plain, shared, motions, moving, with_target_noise=shown is not corrected)
        network = (*scattering, *together)
    result = Check.from_items(CheckArrays(full_recording, setups), network, level, causes)
    if not result.items:
        message = "no station measured a target twice, so no test is possible yet; "
        raise NetworkError(message + "measure some targets on both faces, or the first ones again at the end")
    return result


def write_check(check: Check, folder: Path, extra_files: Mapping[str, str]) -> Check:
    """Writing of `check.json`, `two_face.csv` and `extra_files` texts (a figure) into a folder.

    Returns the check with their digests.

    Raises
    ------
    RecordError
        When the folder cannot be written.
    """
    return write_result(folder, check, {TWO_FACE_TABLE.file: check.table("two_face").csv(), **extra_files})


@raise_for_singular_network
def _test_setup(
    setup_recording: Recording,
    paired_recording: Recording,
    station: int,
    family: HypothesisFamily,
    mpe: tuple[float, float] | None,
) -> SetupCheck:
    """Tests of a set-up; its two-face differences are those of `paired_recording`, including outliers."""
    indices = np.flatnonzero(setup_recording.station == station)
    recording, rows, name = setup_recording.select(indices), indices + 1, setup_recording.stations[station]
    construction = declared_construction(recording)
    visit = StationOccupation.from_recording(recording, construction)
    judged = SetupTests((), visit, (), recording)
    if visit.dof > 0:
        judged = _gross_and_motion_tests(visit, construction, family, rows)
    two_faced, motionless = paired_recording.select(indices), judged.motion_corrected.readings
    motionless = np.where(np.isnan(motionless), two_faced.readings, motionless)
    items, faces = (
        list[CheckItem](),
        TwoFaceDifferences.from_recordings(
            two_faced, two_faced.with_readings(motionless), construction, family.alpha_per_test, mpe
        ),
    )
    if faces is not None:
        limit = "noise and specification" if mpe is None else "the limit"
        sentence, targets, worst = face_sentence(faces, recording, limit)
        pair = tuple(rows[worst].tolist())
        items.append(CheckItem.from_test(name, "two-face", not targets, sentence, targets=targets, rows=pair))
    if visit.dof < 1:
        return SetupCheck(name, tuple(items), faces, None, rows)
    remaining, scale = judged.remaining, _scatter_by_target(judged.remaining, family)
    if scale is None:
        items += [*judged.items, _repeatability_item(remaining, family)]
    else:
        judged = _gross_and_motion_tests(
            StationOccupation.from_recording(recording, construction, sigma=visit.sigma * scale),
            construction,
            family,
            rows,
        )
        items += [_target_scatter_item(visit, remaining, family), *judged.items]
    return SetupCheck(name, tuple(items), faces, remaining, rows, judged.motions)


@dataclass(frozen=True)
class SetupTests:
    """Items on pointings and motions of an occupation, the occupation without these, and readings without motions."""

    items: tuple[CheckItem, ...]
    remaining: StationOccupation
    motions: tuple[StationMotion, ...]
    motion_corrected: Recording


def _gross_and_motion_tests(
    occupation: StationOccupation, construction: Construction, family: HypothesisFamily, rows: Ints
) -> SetupTests:
    """Tests of one set-up for gross errors, a bump and a drift, and the readings without its motion."""
    gross, bump, occupation = _gross_pointings_and_bump(occupation, construction, family)
    items = [_gross_item(occupation, gross, rows, family), _bump_item(occupation, bump, rows, family)]
    recording, even = occupation.recording, UniformMotion((occupation.recording.stations[0],))
    motions: list[StationMotion] = [] if bump is None else [bump]
    designs = [motion.design(occupation.sightings) for motion in motions]
    remaining = reduce(StationOccupation.with_fitted_columns, designs, occupation)
    creep, zeros = even.design(occupation.sightings), _zero_drift_design(occupation)
    items.append(_drift_item(remaining, family, "drift", creep, drift_sentence))
    if not items[-1].passed:
        motions.append(even)
        designs, remaining = [*designs, creep], remaining.with_fitted_columns(creep)
    items.append(_drift_item(remaining, family, "instrument-drift", zeros, instrument_sentence))
    if not items[-1].passed:
        designs, remaining = [*designs, zeros], remaining.with_fitted_columns(zeros)
    if designs:
        together = np.concatenate(designs, axis=2)
        recording = recording.with_readings(recording.readings - together @ occupation.fit_columns(together).estimates)
    return SetupTests(tuple(items), remaining, tuple(motions), recording)


def _scatter_by_target(occupation: StationOccupation, family: HypothesisFamily) -> Floats | None:
    """Ratio (n, 1) of the scatter at each pointing's target to the declared noise.

    It is None if all targets have equal scatter (Bartlett).
    """
    chi2, dof = occupation.target_chi2_and_dof()
    is_testable = dof >= MIN_TARGET_DOF
    variance, dof_of_target = chi2[is_testable] / np.maximum(dof[is_testable], 1.0), dof[is_testable]
    if is_testable.sum() < 2 or not variance.min() > 0.0:
        return None
    mean_variance = float(dof_of_target @ variance / dof_of_target.sum())
    gain = dof_of_target.sum() * np.log(mean_variance) - dof_of_target @ np.log(variance)
    gain /= 1.0 + (np.sum(1.0 / dof_of_target) - 1.0 / dof_of_target.sum()) / (3.0 * (len(dof_of_target) - 1.0))
    if not special.chdtrc(len(dof_of_target) - 1.0, gain) < family.alpha_per_test:
        return None
    ratio = np.full(len(dof), np.sqrt(mean_variance))
    ratio[is_testable] = np.sqrt(variance)
    return np.asarray(np.maximum(ratio, 1.0)[occupation.recording.target][:, None])


def _gross_pointings_and_bump(
    occupation: StationOccupation, construction: Construction, family: HypothesisFamily
) -> tuple[dict[int, float], StationBump | None, StationOccupation]:
    """Gross pointings with p-values, removed one by one until a bump explains more than the next one, and the bump."""
    gross: dict[int, float] = {}
    most = max(1, MAX_GROSS_FRACTION * len(occupation.row_mask))
    while True:
        drop, rank = occupation.pointing_removal_tests()
        alone = neg_log_p_chi2(drop, rank) - np.log(len(occupation.row_mask))
        worst = int(np.argmax(alone))
        bump, explained, gaps = best_bump(occupation)
        creep = _neg_log_p(occupation.fit_columns(UniformMotion().design(occupation.sightings)))
        steady = creep >= _neg_log_p(explained) - np.log(gaps)
        bump = None if steady or occupation.p_value(explained) * gaps >= family.alpha_per_test else bump
        enough = alone[worst] <= max(-np.log(family.alpha_per_test), creep if steady else 0.0) or len(gross) >= most
        if enough or (bump is not None and alone[worst] <= _neg_log_p(explained) - np.log(gaps)):
            return gross, bump, occupation
        gross[worst] = float(np.exp(-alone[worst]))
        use: Bools = occupation.row_mask & np.asarray(np.arange(len(occupation.row_mask)) != worst)
        occupation = StationOccupation.from_recording(occupation.recording, construction, use, occupation.sigma)


def best_bump(occupation: StationOccupation) -> tuple[StationBump | None, ColumnsFit, int]:
    """Gap in which a motion of the station explains most, its fit, and the number of gaps."""
    candidates = [
        bump
        for bump in StationBump.candidates(occupation.sightings)
        if _n_targets_across_bump(occupation, bump) >= MIN_SUPPORTING_TARGETS
    ]
    if not candidates:
        return None, ColumnsFit(0.0, 0, np.zeros(6), np.zeros((6, 6))), 1
    explained_by = {bump: occupation.fit_columns(bump.design(occupation.sightings)) for bump in candidates}
    for bump in max(explained_by, key=lambda bump: _neg_log_p(explained_by[bump])).neighbours(occupation.sightings):
        if _n_targets_across_bump(occupation, bump) >= MIN_SUPPORTING_TARGETS:
            explained_by[bump] = occupation.fit_columns(bump.design(occupation.sightings))
    best = max(explained_by, key=lambda bump: _neg_log_p(explained_by[bump]))
    return best, explained_by[best], len(np.unique(occupation.sightings.time)) - 1


def _n_targets_across_bump(occupation: StationOccupation, bump: StationBump) -> int:
    """Number of targets measured both before and after the bump."""
    is_after = occupation.sightings.time >= bump.time
    target = occupation.recording.target
    return len(np.intersect1d(target[occupation.row_mask & is_after], target[occupation.row_mask & ~is_after]))


def _neg_log_p(fit: ColumnsFit) -> float:
    """Negative log p-value of the chi-square decrease under the declared noise."""
    return float(neg_log_p_chi2(fit.chi2_drop, fit.rank))


def _gross_item(
    occupation: StationOccupation, gross: Mapping[int, float], rows: Ints, family: HypothesisFamily
) -> CheckItem:
    recording, name = occupation.recording, occupation.recording.stations[0]
    targets = tuple(dict.fromkeys(recording.targets[recording.target[i]] for i in gross))
    sentence, numbers = gross_sentence(occupation, list(gross), rows), tuple(int(rows[i]) for i in gross)
    chance = family.corrected_p_value(max(gross.values())) if gross else None
    return CheckItem.from_test(name, "gross", not gross, sentence, chance, targets=targets, rows=numbers)


def _bump_item(
    occupation: StationOccupation, bump: StationBump | None, rows: Ints, family: HypothesisFamily
) -> CheckItem:
    recording, name = occupation.recording, occupation.recording.stations[0]
    if bump is None:
        return CheckItem.from_test(name, "bump", True, f"{name}: no sudden motion")
    fit = occupation.fit_columns(bump.design(occupation.sightings))
    order = np.argsort(recording.time, kind="stable")
    index = int(np.searchsorted(recording.time[order], bump.time))
    pair = order[index - 1 : index + 1]
    time_interval = float(recording.time[pair[0]]), float(recording.time[pair[1]])
    numbers = int(rows[pair[0]]), int(rows[pair[1]])
    chance = family.corrected_p_value(occupation.p_value(fit), len(order) - 1)
    sentence = bump_sentence(recording, time_interval, numbers, fit)
    return CheckItem.from_test(name, "bump", False, sentence, chance, rows=numbers, between_s=time_interval)


def _zero_drift_design(occupation: StationOccupation) -> Floats:
    """Change (n, 3, 2) of the readings per second by unit drift rates of the range zero and the vertical index."""
    laws, sightings = [RangeDrift(law="visit"), IndexDrift(law="visit")], with_equal_times_per_run(occupation.sightings)
    return np.concatenate([law.design(sightings) for law in laws], axis=2)


def _drift_item(
    occupation: StationOccupation,
    family: HypothesisFamily,
    kind: CheckItemKind,
    design: Floats,
    write_sentence: SentenceWriter,
) -> CheckItem:
    fit = occupation.fit_columns(design)
    p = family.corrected_p_value(occupation.p_value(fit))
    is_passed = p >= family.false_alarm_rate
    return CheckItem.from_test(
        occupation.recording.stations[0], kind, is_passed, write_sentence(occupation.recording, fit, is_passed), p
    )


def _repeatability_item(occupation: StationOccupation, family: HypothesisFamily) -> CheckItem:
    """Item on the scatter of repeated pointings relative to the declared noise, two-sided.

    Smaller noise passes with a remark.
    """
    name, ratio = occupation.recording.stations[0], float(np.sqrt(occupation.chi2 / max(occupation.dof, 1)))
    if occupation.dof < 1:
        return CheckItem.from_test(
            name, "closure", True, f"{name}: too few repeated pointings for an estimate of the scatter"
        )
    p, less = two_sided_chi2_p_value(occupation.chi2, occupation.dof)
    p = family.corrected_p_value(p)
    freedom = f"{occupation.dof} degrees of freedom"
    phrase = f"{name}: repeated pointings scatter {ratio:.2f} times the declared noise ({freedom})"
    if p >= family.false_alarm_rate:
        return CheckItem.from_test(name, "closure", True, f"{phrase}, as expected", p)
    return CheckItem.from_test(name, "closure", less, f"{phrase}, {'less' if less else 'more'} than declared", p)


def _target_scatter_item(
    occupation: StationOccupation, remaining: StationOccupation, family: HypothesisFamily
) -> CheckItem:
    """Item on the scatter of a set-up whose targets have different scatter."""
    closure, (chi2, dof) = _repeatability_item(remaining, family), remaining.target_chi2_and_dof()
    listed_targets = np.flatnonzero(dof >= MIN_TARGET_DOF)
    listed_targets = listed_targets[np.argsort(-chi2[listed_targets] / dof[listed_targets], kind="stable")]
    sentence, targets = target_sentence(occupation, listed_targets)
    return closure.model_copy(update={"sentence": f"{closure.sentence}: {sentence}", "targets": targets})
