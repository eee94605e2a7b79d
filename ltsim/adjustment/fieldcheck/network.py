"""Tests of all stations of a recording together: agreement on their common targets and on the vertical."""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
from scipy import special

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.doubt import require_result, weaknesses
from ltsim.adjustment.estimate import adjust
from ltsim.adjustment.fieldcheck.items import Family, Item, two_sided
from ltsim.adjustment.gross import mistakes
from ltsim.adjustment.known import known_tests
from ltsim.adjustment.moving import SuddenMotion, moving_stations, told_motions
from ltsim.adjustment.occupations import moved_tripods
from ltsim.adjustment.reliability import FEW
from ltsim.adjustment.stated import Kind
from ltsim.adjustment.verdict import LEVEL as RARE, Agreement, verdict
from ltsim.core.arrays import Bools
from ltsim.core.errors import ConvergenceError, LtsimError, NetworkError
from ltsim.core.units import ARCSECOND, MILLIMETRE
from ltsim.physics.effects.motions import StationMotion
from ltsim.physics.model.construction import declared_construction
from ltsim.recordings.recording import SIGMA_COLUMNS, Recording
from ltsim.solve.design import median_deviation

NETWORK_TESTS = 2
"""Tests of all stations together: common targets, and levels."""
TESTED: tuple[Kind, ...] = ("point", "difference", "length", "mark", "scale")
"""Known values that may be left out; levels are tested one by one."""
CHECKED = 0.05
"""Redundancy below which no other station checks a level."""
EXPLAINED = 0.05
"""Chance of what the instrument's errors explain, below which they are at work; otherwise the plain network counts."""


def plain_network(recording: Recording, motions: Sequence[StationMotion]) -> Adjustment | LtsimError:
    """The network as `adjust` has it, with stations that moved, or why there is none."""
    try:
        plain = adjust(recording, effects=motions, robust=bool(motions), judging=TESTED)
        require_result(plain)
    except (NetworkError, ConvergenceError) as problem:
        return problem
    return plain


def with_own_noise(recording: Recording, plain: Adjustment) -> tuple[Recording, tuple[Item, ...]]:
    """The recording with readings to targets that scatter far more than all others as uncertain as they show.

    What `adjust` says of such targets is an item where they still do beside the instrument's errors, which bend the
    readings to near and steep ones most; none of their pointings is one to measure again for that alone.
    """
    if plain.wrong or not len(plain.restless[0]):
        return recording, ()
    with suppress(NetworkError):  # of two designs: nothing is known of their errors
        plain = adjust(recording, declared_construction(recording), effects=plain.effects, judging=TESTED)
    named, own, rest = plain.restless
    if not len(named) or not own > 1.0 or verdict(plain).case is not Agreement.LARGER_NOISE:
        return recording, ()
    rows = np.isin(recording.target, named)
    told = [one[share > CHECKED] for one, share in zip(plain.w[rows].T, plain.redundancy[rows].T, strict=True)]
    seen = [median_deviation(one) if len(one) >= FEW else own for one in told]
    sigma = np.where(rows[:, None], np.maximum(seen, 1.0), 1.0) * recording.sigma() / [MILLIMETRE, ARCSECOND, ARCSECOND]
    shown = recording.replace(covariates={**recording.covariates, **dict(zip(SIGMA_COLUMNS, sigma.T, strict=True))})
    names = tuple(recording.targets[t] for t in named)
    sentence = f"readings to {', '.join(names)} scatter {own:.2g} times as stated, the others {rest:.2g} times"
    return shown, (Item.of("", "closure", False, f"{sentence}: it belongs to the target", targets=names),)


def items_of_network(
    recording: Recording,
    plain: Adjustment | LtsimError,
    family: Family,
    motions: Sequence[StationMotion],
    *,
    own_noise: bool,
) -> tuple[Item, ...]:
    """Whether the stations agree, the instrument's errors estimated; nothing where they cannot be compared.

    `plain` is the network as `adjust` has it, with the stated noise even where the recording has its `own_noise`;
    `motions` of stations are known from their own set-ups.
    """
    try:
        built = declared_construction(recording)
    except NetworkError as problem:
        return (Item.of("", "network", True, f"the stations are not compared: {problem}"),)
    try:
        if isinstance(plain, LtsimError):
            raise plain
        found = adjust(recording, built, effects=motions, robust=True, judging=TESTED)
        if moving := moving_stations(found):
            motions = (*motions, *moving)
            found = adjust(recording, built, effects=motions, robust=True, judging=TESTED)
    except (NetworkError, ConvergenceError) as problem:
        return (Item.of("", "network", False, f"the set-ups make no network: {problem}"),)
    items = [Item.of("", "network", False, doubt) for doubt in weaknesses(plain)]
    items += [
        Item.of(", ".join(one.stations), "bump" if isinstance(one, SuddenMotion) else "drift", False, told)
        for one, told in told_motions(found)
        if one in moving
    ]
    known = np.zeros(len(recording), dtype=bool)
    for one, *_ in mistakes(plain):
        at = ", ".join(one.stations)
        items.append(Item.of(at, "mistake", False, one.sentence, targets=one.targets, rows=tuple(one.rows + 1)))
        known[one.rows] = True
    moved = moved_tripods(plain)
    if moved is not None:
        marks = tuple(dict.fromkeys(one.mark for one in moved.found))
        items.append(Item.of("", "mistake", False, moved.sentence, targets=marks))
    items += [
        Item.of("", "network", False, test.sentence, targets=() if test.kind == "scale" else (test.name,))
        for test in found.wrong
    ]
    if found.solution.converged and found.dof > 0:
        use, some = found.problem.use, found.rejected.any()
        again = some or own_noise or len(motions) > len(plain.effects)
        without = adjust(recording, effects=motions, use=use, judging=TESTED) if again else plain
        if _at_work(without, found):
            without = found
        elif some:
            without = adjust(recording, effects=motions, robust=True, judging=TESTED)
        alone, less = two_sided(without.chi2, without.dof)
        if own_noise and not less and family.adjusted(alone) < family.level:  # noise: what stands out of it, by adjust
            known |= ~np.isin(np.arange(len(known)), [one.row for one in plain.outliers(estimated=True)])
        items += [*_of_targets(without, known, family), *_of_levels(found, family)]
    return tuple(items)


def _at_work(without: Adjustment, found: Adjustment) -> bool:
    """Whether the instrument's errors explain more of the network `without` them than noise as large as found does."""
    count = found.problem.unknowns.instrument.size
    ratio = (without.chi2 - found.chi2) / count / max(found.chi2 / found.dof, 1e-30)
    return bool(special.fdtrc(count, found.dof, max(ratio, 0.0)) < EXPLAINED)


def _of_targets(found: Adjustment, known: Bools, family: Family) -> list[Item]:
    """Whether the stations agree, pointings whose mistake is `known` (n,) aside; the worst pointing is named first."""
    recording, out = found.recording, found.rejected.any(axis=1) & ~known
    alone, less = two_sided(found.chi2, found.dof)
    p = family.adjusted(alone)
    scatter = f"sigma0 {found.sigma0:.2f} where the stated noise gives 1 ({found.dof} degrees of freedom)"
    if not out.any():
        passed = less or p >= family.level
        verb = "agree" if passed else "disagree"
        if passed and not less and alone < RARE:
            scatter += f", as noise brings it in one network of {1 / alone:.0f}"
        return [Item.of("", "network", passed, f"the stations {verb} on their common targets: {scatter}", p)]
    size = np.nan_to_num(np.abs(found.residuals / found.problem.sigma)).max(axis=1)
    rows = np.flatnonzero(out)
    rows = rows[np.argsort(-size[rows], kind="stable")]
    station, target = recording.station[rows[0]], recording.target[rows[0]]
    first = f"{recording.stations[station]} to {recording.targets[target]}, row {rows[0] + 1}"
    many = f"{len(rows)} pointings contradict" if len(rows) > 1 else "a pointing contradicts"
    sentence = f"{many} the other stations ({first}{', is the worst' if len(rows) > 1 else ''})"
    targets = tuple(dict.fromkeys(recording.targets[t] for t in recording.target[rows]))
    return [Item.of("", "network", False, sentence, targets=targets, rows=tuple((rows + 1).tolist()))]


def _of_levels(found: Adjustment, family: Family) -> list[Item]:
    """The level of each levelled station against the vertical of the others, through their common targets."""
    items, levels = [], found.problem.levels
    stated = {found.recording.stations[k]: sigma for k, sigma in zip(levels.station, levels.sigma, strict=True)}
    for test in known_tests(found.problem, found.solution) if len(levels) > 1 else ():
        if test.kind == "level" and (stated[test.name] / test.sigma_error.min()) ** 2 > CHECKED:
            p = family.adjusted(float(special.chdtrc(test.rank, test.drop)), len(levels))
            verb = "agrees with" if p >= family.level else "is off"
            told = f"{test.name}: its level {verb} the vertical of the others ({test.off})"
            items.append(Item.of(test.name, "level", p >= family.level, told, p))
    return items
