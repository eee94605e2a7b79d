"""Tests of all stations of a recording together: agreement on common targets and on the vertical."""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.blunders import detect_blunders
from ltsim.adjustment.centring import centring_errors
from ltsim.adjustment.estimate import adjust
from ltsim.adjustment.fieldcheck.result import Family, Item, two_sided
from ltsim.adjustment.quality import network_warnings, require_usable
from ltsim.adjustment.reference_tests import reference_tests
from ltsim.adjustment.reference_values import Kind
from ltsim.adjustment.reliability import FEW
from ltsim.adjustment.significance import GLOBAL_LEVEL
from ltsim.adjustment.station_motions import Motion, SuddenMotion, motion_sentences
from ltsim.adjustment.verdict import Agreement, verdict
from ltsim.core.arrays import Bools
from ltsim.core.errors import ConvergenceError, LtsimError, NetworkError
from ltsim.core.units import ARCSECOND, MILLIMETRE
from ltsim.physics.effects.motions import StationMotion
from ltsim.physics.model.construction import declared_construction
from ltsim.recordings.recording import SIGMA_COLUMNS, Recording
from ltsim.solve.design import median_deviation

NETWORK_TESTS = 2
"""Number of tests of all stations together: common targets, and levels."""
TESTED: tuple[Kind, ...] = ("point", "difference", "length", "mark", "scale")
"""Kinds of reference values that may be excluded; levels are tested one by one."""
CHECKED = 0.05
"""Redundancy below which no other station checks a level."""


def plain_network(recording: Recording, motions: Sequence[StationMotion]) -> Adjustment | LtsimError:
    """Network as of `adjust`, with moving stations, or the error if there is none."""
    try:
        plain = adjust(recording, effects=motions, robust=bool(motions), judging=TESTED)
        require_usable(plain)
    except (NetworkError, ConvergenceError) as problem:
        return problem
    return plain


def with_target_noise(recording: Recording, plain: Adjustment) -> tuple[Recording, tuple[Item, ...]]:
    """Recording with the noise of much noisier targets set to their scatter, and items on them.

    Noisy targets reported by `adjust` give an item if they remain noisy when the instrument's errors are estimated,
    since these affect near and steep targets most. Their pointings need not be repeated for that reason alone.
    """
    if plain.rejected_references or not len(plain.noisy_targets[0]):
        return recording, ()
    with suppress(NetworkError):  # of two designs: nothing is known of their errors
        plain = adjust(recording, declared_construction(recording), effects=plain.effects, judging=TESTED)
    named, ratio, rest = plain.noisy_targets
    if not len(named) or not ratio > 1.0 or verdict(plain).case is not Agreement.LARGER_NOISE:
        return recording, ()
    rows = np.isin(recording.target, named)
    w_by_observable = [w[share > CHECKED] for w, share in zip(plain.w[rows].T, plain.redundancy[rows].T, strict=True)]
    scatter = [median_deviation(w) if len(w) >= FEW else ratio for w in w_by_observable]
    sigma = (
        np.where(rows[:, None], np.maximum(scatter, 1.0), 1.0) * recording.sigma() / [MILLIMETRE, ARCSECOND, ARCSECOND]
    )
    shown = recording.replace(covariates={**recording.covariates, **dict(zip(SIGMA_COLUMNS, sigma.T, strict=True))})
    names = tuple(recording.targets[t] for t in named)
    scatter_words = f"scatter {ratio:.2g} times the declared noise, the others {rest:.2g} times"
    sentence = f"readings to {', '.join(names)} {scatter_words}"
    return shown, (Item.of("", "closure", False, f"{sentence}: these targets are unstable", targets=names),)


def items_of_network(
    recording: Recording,
    plain: Adjustment | LtsimError,
    family: Family,
    motions: Sequence[StationMotion],
    moving: Sequence[Motion],
    *,
    with_target_noise: bool,
) -> tuple[Item, ...]:
    """Tests of the agreement of stations, with estimated errors of the instrument; empty if no comparison is possible.

    `plain` is the network of `adjust` with the declared noise, even for a recording with increased noise of targets;
    `motions` of stations were estimated from their single set-ups, those `moving` from the network.
    """
    try:
        built = declared_construction(recording)
    except NetworkError as problem:
        return (Item.of("", "network", True, f"the stations are not compared: {problem}"),)
    try:
        if isinstance(plain, LtsimError):
            raise plain
        motions = (*motions, *moving)
        fitted = adjust(recording, built, effects=motions, robust=True, judging=TESTED)
    except (NetworkError, ConvergenceError) as problem:
        return (Item.of("", "network", False, f"the set-ups do not form a network: {problem}"),)
    items = [Item.of("", "network", False, doubt) for doubt in network_warnings(plain)]
    items += [
        Item.of(", ".join(motion.stations), "bump" if isinstance(motion, SuddenMotion) else "drift", False, sentence)
        for motion, sentence in motion_sentences(fitted)
        if motion in moving
    ]
    is_explained = np.zeros(len(recording), dtype=bool)
    for motion, *_ in detect_blunders(plain):
        at = ", ".join(motion.stations)
        items.append(
            Item.of(at, "mistake", False, motion.sentence, targets=motion.targets, rows=tuple(motion.rows + 1))
        )
        is_explained[motion.rows] = True
    moved = centring_errors(plain)
    if moved is not None:
        marks = tuple(dict.fromkeys(motion.mark for motion in moved.occupations))
        items.append(Item.of("", "mistake", False, moved.sentence, targets=marks))
    items += [
        Item.of("", "network", False, test.sentence, targets=() if test.kind == "scale" else (test.name,))
        for test in fitted.rejected_references
    ]
    if fitted.solution.converged and fitted.dof > 0:
        use, any_rejected = fitted.problem.use, fitted.rejected.any()
        again = any_rejected or with_target_noise or len(motions) > len(plain.effects)
        without = adjust(recording, effects=motions, use=use, judging=TESTED) if again else plain
        if _at_work(without, fitted):
            without = fitted
        elif any_rejected:
            without = adjust(recording, effects=motions, robust=True, judging=TESTED)
        alone, less = two_sided(without.chi2, without.dof)
        if (
            with_target_noise and not less and family.adjusted(alone) < family.level
        ):  # noise: what stands out of it, by adjust
            is_explained |= ~np.isin(
                np.arange(len(is_explained)), [motion.row for motion in plain.outliers(estimated=True)]
            )
        items += [*_of_targets(without, is_explained, family), *_of_levels(fitted, family)]
    return tuple(items)


def _at_work(without: Adjustment, fitted: Adjustment) -> bool:
    """True if the instrument's errors explain more of the network `without` them than an estimated noise factor."""
    count = fitted.problem.unknowns.instrument.size
    ratio = (without.chi2 - fitted.chi2) / count / max(fitted.chi2 / fitted.dof, 1e-30)
    return bool(special.fdtrc(count, fitted.dof, max(ratio, 0.0)) < GLOBAL_LEVEL)


def _of_targets(fitted: Adjustment, is_explained: Bools, family: Family) -> list[Item]:
    """Items on the agreement of the stations, the worst first.

    Pointings that a blunder explains (`is_explained` (n,)) are excluded.
    """
    recording, out = fitted.recording, fitted.rejected.any(axis=1) & ~is_explained
    alone, less = two_sided(fitted.chi2, fitted.dof)
    p = family.adjusted(alone)
    scatter = f"sigma0 {fitted.sigma0:.2f} where the declared noise gives 1 ({fitted.dof} degrees of freedom)"
    if not out.any():
        passed = less or p >= family.level
        verb = "agree" if passed else "disagree"
        if passed and not less and alone < GLOBAL_LEVEL:
            scatter += f"; noise alone gives this in one of {1 / alone:.0f} networks"
        return [Item.of("", "network", passed, f"the stations {verb} on their common targets: {scatter}", p)]
    size = np.nan_to_num(np.abs(fitted.residuals / fitted.problem.sigma)).max(axis=1)
    rows = np.flatnonzero(out)
    rows = rows[np.argsort(-size[rows], kind="stable")]
    station, target = recording.station[rows[0]], recording.target[rows[0]]
    first = f"{recording.stations[station]} to {recording.targets[target]}, row {rows[0] + 1}"
    many = f"{len(rows)} pointings contradict" if len(rows) > 1 else "a pointing contradicts"
    sentence = f"{many} the other stations ({first}{', is the worst' if len(rows) > 1 else ''})"
    targets = tuple(dict.fromkeys(recording.targets[t] for t in recording.target[rows]))
    return [Item.of("", "network", False, sentence, targets=targets, rows=tuple((rows + 1).tolist()))]


def _of_levels(fitted: Adjustment, family: Family) -> list[Item]:
    """Items on the level of each levelled station relative to the vertical of the others, by their common targets."""
    items, levels = [], fitted.problem.levels
    declared = {fitted.recording.stations[k]: sigma for k, sigma in zip(levels.station, levels.sigma, strict=True)}
    for test in reference_tests(fitted.problem, fitted.solution) if len(levels) > 1 else ():
        if test.kind == "level" and (declared[test.name] / test.sigma_error.min()) ** 2 > CHECKED:
            p = family.adjusted(float(special.chdtrc(test.rank, test.chi2_drop)), len(levels))
            verb = "agrees with" if p >= family.level else "deviates from"
            sentence = f"{test.name}: its level {verb} the vertical of the others ({test.error_text})"
            items.append(Item.of(test.name, "level", p >= family.level, sentence, p))
    return items
