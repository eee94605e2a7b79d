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
from ltsim.adjustment.fieldcheck.network import NETWORK_TESTS, items_of_network, plain_network, with_target_noise
from ltsim.adjustment.fieldcheck.occupation import ColumnsFit, Faces, StationOccupation
from ltsim.adjustment.fieldcheck.result import TWO_FACE, Check, CheckArrays, Family, Item, Kind, SetUp, two_sided
from ltsim.adjustment.fieldcheck.words import (
    bump_sentence,
    drift_sentence,
    face_sentence,
    gross_sentence,
    instrument_sentence,
    target_sentence,
)
from ltsim.adjustment.identification import identified, outcomes
from ltsim.adjustment.reliability import neg_log_p_chi2
from ltsim.adjustment.significance import FAMILY_LEVEL
from ltsim.adjustment.station_motions import WITNESSES, EvenMotion, by_runs
from ltsim.adjustment.structure import refusing_singular
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.physics.effects.index_drift import IndexDrift
from ltsim.physics.effects.motions import StationMotion
from ltsim.physics.effects.range_drift import RangeDrift
from ltsim.physics.effects.station_bump import StationBump
from ltsim.physics.model.construction import Construction, declared_construction
from ltsim.recordings.exchange import RecordingSource, recording_of
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import write_result

MOST_GROSS = 0.1
"""Largest fraction of a set-up's pointings that may be gross errors; with more, the declared noise is wrong."""
TESTS = 6
"""Number of tests of one set-up."""


Words = Callable[[Recording, ColumnsFit, bool], str]
MIN_TARGET_DOF = 6.0
"""Smallest number of degrees of freedom at which the scatter of a target is tested separately."""


def check(recording: RecordingSource, *, level: float = FAMILY_LEVEL, mpe: tuple[float, float] | None = None) -> Check:
    """Field check of a recording: two-face differences, repeated points, drift, bumps and scatter.

    Parameters
    ----------
    recording : Recording, str or Path
    level : float
        Chance of one false alarm in the whole recording, if noise and specification are correct.
    mpe : pair of float, optional
        Limit of two-face differences as lengths, [um] and [um/m] of the range: ``(20, 6)``; default by the noise
        and the specification of the instrument.

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
    whole = recording_of(recording)
    identification = identified(whole) if len(whole.stations) > 1 else None
    selection = identification if identification and (identification.leads or identification.explains) else None
    moving = identification.motions if identification is not None and selection is None else ()
    causes = () if selection is None else outcomes(selection)
    corrected = whole if selection is None else selection.fit.corrected(whole)
    paired = whole if selection is None else selection.fit.corrected(whole, outliers=True)
    family = Family(level, 2 * TESTS * max(len(whole.stations), 1))
    every = range(len(whole.stations))
    setups, network = tuple(_set_up(corrected, paired, s, family, mpe) for s in every), tuple[Item, ...]()
    if len(whole.stations) > 1:
        motions = tuple(motion for setup in setups for motion in setup.motions)
        moving = tuple(motion for motion in moving if motion.stations not in {m.stations for m in motions})
        plain = plain_network(corrected, motions)
        read, shown, scattering = corrected, corrected, tuple[Item, ...]()
        if isinstance(plain, Adjustment):
            shown, scattering = with_target_noise(corrected, plain)
            read = apply_corrections(shown, detect_blunders(plain))
        if read is not corrected:  # a set-up is not blamed for what has a name
            setups = tuple(_set_up(read, read, s, family, mpe) for s in every)
        shared = Family(level, 2 * NETWORK_TESTS)
        together = items_of_network(shown, plain, shared, motions, moving, with_target_noise=shown is not corrected)
        network = (*scattering, *together)
    result = Check.of(CheckArrays(whole, setups), network, level, causes)
    if not result.items:
        message = "no station measured a target twice, so no test is possible yet; "
        raise NetworkError(message + "measure some targets on both faces, or the first ones again at the end")
    return result


def write_check(check: Check, folder: Path, further: Mapping[str, str]) -> Check:
    """Writing of `check.json`, `two_face.csv` and `further` texts (a figure) into a folder.

    Returns the check with their digests.

    Raises
    ------
    RecordError
        When the folder cannot be written.
    """
    return write_result(folder, check, {TWO_FACE.file: check.table("two_face").csv(), **further})


@refusing_singular
def _set_up(
    whole: Recording, paired: Recording, station: int, family: Family, mpe: tuple[float, float] | None
) -> SetUp:
    """Tests of a set-up; its two-face differences are those of `paired`, including outliers."""
    at = np.flatnonzero(whole.station == station)
    recording, rows, name = whole.select(at), at + 1, whole.stations[station]
    construction = declared_construction(recording)
    visit = StationOccupation.of(recording, construction)
    judged = SetUpTests((), visit, (), recording)
    if visit.dof > 0:
        judged = _tests_of_set_up(visit, construction, family, rows)
    two_faced, motionless = paired.select(at), judged.motion_corrected.readings
    motionless = np.where(np.isnan(motionless), two_faced.readings, motionless)
    items, faces = (
        list[Item](),
        Faces.of(two_faced, two_faced.with_readings(motionless), construction, family.alpha_per_test, mpe),
    )
    if faces is not None:
        limit = "noise and specification" if mpe is None else "the limit"
        sentence, targets, worst = face_sentence(faces, recording, limit)
        pair = tuple(rows[worst].tolist())
        items.append(Item.of(name, "two-face", not targets, sentence, targets=targets, rows=pair))
    if visit.dof < 1:
        return SetUp(name, tuple(items), faces, None, rows)
    remaining, scale = judged.remaining, _scatter_by_target(judged.remaining, family)
    if scale is None:
        items += [*judged.items, _closure(remaining, family)]
    else:
        judged = _tests_of_set_up(
            StationOccupation.of(recording, construction, sigma=visit.sigma * scale), construction, family, rows
        )
        items += [_scattering(visit, remaining, family), *judged.items]
    return SetUp(name, tuple(items), faces, remaining, rows, judged.motions)


@dataclass(frozen=True)
class SetUpTests:
    """Items on pointings and motions of an occupation, the occupation without these, and readings without motions."""

    items: tuple[Item, ...]
    remaining: StationOccupation
    motions: tuple[StationMotion, ...]
    motion_corrected: Recording


def _tests_of_set_up(visit: StationOccupation, construction: Construction, family: Family, rows: Ints) -> SetUpTests:
    """Tests of one set-up for gross errors, a bump and a drift, and the readings without its motion."""
    gross, bump, visit = _events(visit, construction, family)
    items = [_of_gross(visit, gross, rows, family), _of_bump(visit, bump, rows, family)]
    recording, even = visit.recording, EvenMotion((visit.recording.stations[0],))
    motions: list[StationMotion] = [] if bump is None else [bump]
    designs = [motion.design(visit.sightings) for motion in motions]
    remaining = reduce(StationOccupation.without, designs, visit)
    creep, zeros = even.design(visit.sightings), _zeros(visit)
    items.append(_drift(remaining, family, "drift", creep, drift_sentence))
    if not items[-1].passed:
        motions.append(even)
        designs, remaining = [*designs, creep], remaining.without(creep)
    items.append(_drift(remaining, family, "instrument-drift", zeros, instrument_sentence))
    if not items[-1].passed:
        designs, remaining = [*designs, zeros], remaining.without(zeros)
    if designs:
        together = np.concatenate(designs, axis=2)
        recording = recording.with_readings(recording.readings - together @ visit.explained(together).values)
    return SetUpTests(tuple(items), remaining, tuple(motions), recording)


def _scatter_by_target(visit: StationOccupation, family: Family) -> Floats | None:
    """Ratio (n, 1) of the scatter at each pointing's target to the declared noise.

    It is None if all targets have equal scatter (Bartlett).
    """
    chi2, dof = visit.scatter()
    is_testable = dof >= MIN_TARGET_DOF
    variance, dof_of_target = chi2[is_testable] / np.maximum(dof[is_testable], 1.0), dof[is_testable]
    if is_testable.sum() < 2 or not variance.min() > 0.0:
        return None
    pooled = float(dof_of_target @ variance / dof_of_target.sum())
    gain = dof_of_target.sum() * np.log(pooled) - dof_of_target @ np.log(variance)
    gain /= 1.0 + (np.sum(1.0 / dof_of_target) - 1.0 / dof_of_target.sum()) / (3.0 * (len(dof_of_target) - 1.0))
    if not special.chdtrc(len(dof_of_target) - 1.0, gain) < family.alpha_per_test:
        return None
    ratio = np.full(len(dof), np.sqrt(pooled))
    ratio[is_testable] = np.sqrt(variance)
    return np.asarray(np.maximum(ratio, 1.0)[visit.recording.target][:, None])


def _events(
    visit: StationOccupation, construction: Construction, family: Family
) -> tuple[dict[int, float], StationBump | None, StationOccupation]:
    """Gross pointings with p-values, removed one by one until a bump explains more than the next one, and the bump."""
    gross: dict[int, float] = {}
    most = max(1, MOST_GROSS * len(visit.use))
    while True:
        drop, rank = visit.of_pointings()
        alone = neg_log_p_chi2(drop, rank) - np.log(len(visit.use))
        worst = int(np.argmax(alone))
        bump, explained, gaps = best_bump(visit)
        creep = _neg_log_p(visit.explained(EvenMotion().design(visit.sightings)))
        steady = creep >= _neg_log_p(explained) - np.log(gaps)
        bump = None if steady or visit.p_value(explained) * gaps >= family.alpha_per_test else bump
        enough = alone[worst] <= max(-np.log(family.alpha_per_test), creep if steady else 0.0) or len(gross) >= most
        if enough or (bump is not None and alone[worst] <= _neg_log_p(explained) - np.log(gaps)):
            return gross, bump, visit
        gross[worst] = float(np.exp(-alone[worst]))
        use: Bools = visit.use & np.asarray(np.arange(len(visit.use)) != worst)
        visit = StationOccupation.of(visit.recording, construction, use, visit.sigma)


def best_bump(visit: StationOccupation) -> tuple[StationBump | None, ColumnsFit, int]:
    """Gap in which a motion of the station explains most, its fit, and the number of gaps."""
    tried = [bump for bump in StationBump.candidates(visit.sightings) if _witnesses(visit, bump) >= WITNESSES]
    if not tried:
        return None, ColumnsFit(0.0, 0, np.zeros(6), np.zeros((6, 6))), 1
    explained_by = {bump: visit.explained(bump.design(visit.sightings)) for bump in tried}
    for bump in max(explained_by, key=lambda bump: _neg_log_p(explained_by[bump])).neighbours(visit.sightings):
        if _witnesses(visit, bump) >= WITNESSES:
            explained_by[bump] = visit.explained(bump.design(visit.sightings))
    best = max(explained_by, key=lambda bump: _neg_log_p(explained_by[bump]))
    return best, explained_by[best], len(np.unique(visit.sightings.time)) - 1


def _witnesses(visit: StationOccupation, bump: StationBump) -> int:
    """Number of targets measured both before and after the bump."""
    after = visit.sightings.time >= bump.time
    target = visit.recording.target
    return len(np.intersect1d(target[visit.use & after], target[visit.use & ~after]))


def _neg_log_p(explained: ColumnsFit) -> float:
    """Negative log p-value of the chi-square decrease under the declared noise."""
    return float(neg_log_p_chi2(explained.drop, explained.rank))


def _of_gross(visit: StationOccupation, gross: Mapping[int, float], rows: Ints, family: Family) -> Item:
    recording, name = visit.recording, visit.recording.stations[0]
    targets = tuple(dict.fromkeys(recording.targets[recording.target[i]] for i in gross))
    sentence, numbers = gross_sentence(visit, list(gross), rows), tuple(int(rows[i]) for i in gross)
    chance = family.adjusted(max(gross.values())) if gross else None
    return Item.of(name, "gross", not gross, sentence, chance, targets=targets, rows=numbers)


def _of_bump(visit: StationOccupation, bump: StationBump | None, rows: Ints, family: Family) -> Item:
    recording, name = visit.recording, visit.recording.stations[0]
    if bump is None:
        return Item.of(name, "bump", True, f"{name}: no sudden motion")
    explained = visit.explained(bump.design(visit.sightings))
    order = np.argsort(recording.time, kind="stable")
    at = int(np.searchsorted(recording.time[order], bump.time))
    pair = order[at - 1 : at + 1]
    between = float(recording.time[pair[0]]), float(recording.time[pair[1]])
    numbers = int(rows[pair[0]]), int(rows[pair[1]])
    chance = family.adjusted(visit.p_value(explained), len(order) - 1)
    sentence = bump_sentence(recording, between, numbers, explained)
    return Item.of(name, "bump", False, sentence, chance, rows=numbers, between_s=between)


def _zeros(visit: StationOccupation) -> Floats:
    """Change (n, 3, 2) of the readings per second by unit drift rates of the range zero and the vertical index."""
    laws, sightings = [RangeDrift(law="visit"), IndexDrift(law="visit")], by_runs(visit.sightings)
    return np.concatenate([law.design(sightings) for law in laws], axis=2)


def _drift(visit: StationOccupation, family: Family, kind: Kind, design: Floats, words: Words) -> Item:
    explained = visit.explained(design)
    p = family.adjusted(visit.p_value(explained))
    passed = p >= family.level
    return Item.of(visit.recording.stations[0], kind, passed, words(visit.recording, explained, passed), p)


def _closure(visit: StationOccupation, family: Family) -> Item:
    """Item on the scatter of repeated pointings relative to the declared noise, two-sided.

    Smaller noise passes with a remark.
    """
    name, ratio = visit.recording.stations[0], float(np.sqrt(visit.chi2 / max(visit.dof, 1)))
    if visit.dof < 1:
        return Item.of(name, "closure", True, f"{name}: too few repeated pointings for an estimate of the scatter")
    p, less = two_sided(visit.chi2, visit.dof)
    p = family.adjusted(p)
    freedom = f"{visit.dof} degrees of freedom"
    scatter = f"{name}: repeated pointings scatter {ratio:.2f} times the declared noise ({freedom})"
    if p >= family.level:
        return Item.of(name, "closure", True, f"{scatter}, as expected", p)
    return Item.of(name, "closure", less, f"{scatter}, {'less' if less else 'more'} than declared", p)


def _scattering(visit: StationOccupation, remaining: StationOccupation, family: Family) -> Item:
    """Item on the scatter of a set-up whose targets have different scatter."""
    closure, (chi2, dof) = _closure(remaining, family), remaining.scatter()
    shown = np.flatnonzero(dof >= MIN_TARGET_DOF)
    shown = shown[np.argsort(-chi2[shown] / dof[shown], kind="stable")]
    sentence, targets = target_sentence(visit, shown)
    return closure.model_copy(update={"sentence": f"{closure.sentence}: {sentence}", "targets": targets})
