"""`check`: every set-up of a recording judged by what it measured twice, with the price of many looks paid.

All tests of a recording share one chance of a false alarm, `level`: each of them gets an equal part of it (Bonferroni),
and within a test so does each target, gap or pointing that was looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.adjustment.reliability import surprise
from ltsim.arrays import Bools, Floats, Ints
from ltsim.effects.blunders import StationBump
from ltsim.effects.motions import station_design
from ltsim.effects.ranges import RangeDrift
from ltsim.effects.warming import IndexDrift
from ltsim.errors import NetworkError
from ltsim.fieldcheck.faces import Faces, Mpe, faces_or_none
from ltsim.fieldcheck.items import Family, Item, two_sided
from ltsim.fieldcheck.network import NETWORK_TESTS, items_of_network
from ltsim.fieldcheck.visit import Explained, Visit
from ltsim.fieldcheck.words import bump_sentence, drift_sentence, face_sentence, gross_sentence, instrument_sentence
from ltsim.model.construction import Construction, stated_construction
from ltsim.recording.recording import Recording
from ltsim.results import Columns, Result, by_row

LEVEL = 0.01
MOST_GROSS = 0.1
"""Part of the pointings of a set-up that may be gross; with more, the stated noise is wrong."""
WITNESSES = 3
"""Targets on both sides of a gap that a motion of the station needs: one alone may itself have moved."""
CAUSES = ("mistake", "bump", "drift")
"""What is named first: two faces that differ and scatter follow from it."""
TESTS = 6
"""Tests of one set-up."""


@dataclass(frozen=True)
class SetUp:
    """One set-up: its items, its two-face differences (None without pairs) and its model (None where nothing repeats).

    `rows` are the rows of the whole recording, from 1.
    """

    station: str
    items: tuple[Item, ...]
    faces: Faces | None
    visit: Visit | None
    rows: Ints


@dataclass(frozen=True, repr=False)
class Check(Result):
    """All set-ups of a recording, and whether the stations agree with each other."""

    recording: Recording
    setups: tuple[SetUp, ...]
    network: tuple[Item, ...]
    level: float

    def _lines(self) -> list[str]:
        return [self.sentence]

    def _tables(self) -> Mapping[str, Callable[[], Columns]]:
        return {"items": self._items}

    def _items(self) -> Columns:
        return by_row(
            [
                {"station": i.station, "kind": i.kind, "passed": i.passed, "p_value": i.p_value, "sentence": i.sentence}
                for i in self.items
            ]
        )

    @property
    def items(self) -> tuple[Item, ...]:
        """Every item: mistakes of the work first, then set-up by set-up."""
        mistakes = (item for item in self.network if item.kind == "mistake")
        rest = (item for item in self.network if item.kind != "mistake")
        return (*mistakes, *(item for setup in self.setups for item in setup.items), *rest)

    @property
    def passed(self) -> bool:
        """Whether it is a go."""
        return all(item.passed for item in self.items)

    @property
    def sentence(self) -> str:
        """Go or no-go and why."""
        failed = sorted((item for item in self.items if not item.passed), key=lambda item: item.kind not in CAUSES)
        if failed:
            more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
            return f"no-go: {failed[0].sentence}{more}"
        return f"go: {len(self.setups)} set-up{'s' if len(self.setups) > 1 else ''} within noise and guarantee"


def check(recording: Recording, *, level: float = LEVEL, mpe: Mpe | None = None) -> Check:
    """Judge every set-up of a recording, and the agreement of the stations.

    Parameters
    ----------
    recording : Recording
    level : float
        Chance of one false alarm in the whole recording, if noise and guarantee are as stated.
    mpe : Mpe, optional
        Limit of the two-face differences; default by the stated noise and the maker's guarantee.

    Raises
    ------
    NetworkError
        When nothing was measured twice: there is nothing to check yet.
    """
    family = Family(level, TESTS * max(len(recording.stations), 1) + NETWORK_TESTS)
    setups = tuple(_set_up(recording, s, family, mpe) for s in range(len(recording.stations)))
    found = Check(recording, setups, items_of_network(recording, family), level)
    if not found.items:
        message = "no station measured a target twice, so nothing can be checked yet; "
        raise NetworkError(message + "measure some targets on both faces, or the first ones again at the end")
    return found


def _set_up(whole: Recording, station: int, family: Family, mpe: Mpe | None) -> SetUp:
    at = np.flatnonzero(whole.station == station)
    recording, rows, name = whole.select(at), at + 1, whole.stations[station]
    construction = stated_construction(recording)
    items: list[Item] = []
    faces = faces_or_none(recording, construction, family.share, mpe)
    if faces is not None:
        limit = "noise and guarantee" if mpe is None else "the limit"
        sentence, targets, worst = face_sentence(faces, recording, limit)
        items.append(Item(name, "two-face", not targets, sentence, targets=targets, rows=tuple(rows[worst].tolist())))
    visit = Visit.of(recording, construction)
    if visit.dof < 1:
        return SetUp(name, tuple(items), faces, None, rows)
    gross, bump, visit = _events(visit, construction, family)
    items += [_of_gross(visit, gross, rows), _of_bump(visit, bump, rows, family)]
    if bump is not None:
        visit = visit.without(bump.design(visit.sightings))
    drift = _drift(visit, family)
    steady = visit if drift.passed else visit.without(_creep(visit))
    items += [drift, _instrument_drift(steady, family), _closure(visit, family)]
    return SetUp(name, tuple(items), faces, visit, rows)


def _events(visit: Visit, construction: Construction, family: Family) -> tuple[list[int], StationBump | None, Visit]:
    """Gross pointings, taken out one by one until a bump explains more than the next of them would."""
    gross: list[int] = []
    most = max(1, MOST_GROSS * len(visit.use))
    while True:
        drop, rank = visit.of_pointings()
        alone = surprise(drop, rank) - np.log(len(visit.use))
        worst = int(np.argmax(alone))
        bump, explained, gaps = best_bump(visit)
        creep = _surprise(visit.explained(_creep(visit)))
        steady = creep >= _surprise(explained) - np.log(gaps)
        bump = None if steady or visit.p_value(explained) * gaps >= family.share else bump
        enough = alone[worst] <= max(-np.log(family.share), creep if steady else 0.0) or len(gross) >= most
        if enough or (bump is not None and alone[worst] <= _surprise(explained) - np.log(gaps)):
            return gross, bump, visit
        gross.append(worst)
        use: Bools = visit.use & np.asarray(np.arange(len(visit.use)) != worst)
        visit = Visit.of(visit.recording, construction, use)


def best_bump(visit: Visit) -> tuple[StationBump | None, Explained, int]:
    """The gap in which a motion of the station explains most, what it explains, and how many gaps there are."""
    tried = [bump for bump in StationBump.candidates(visit.sightings) if _witnesses(visit, bump) >= WITNESSES]
    if not tried:
        return None, Explained(0.0, 0, np.zeros(6), np.zeros((6, 6))), 1
    explained_by = {bump: visit.explained(bump.design(visit.sightings)) for bump in tried}
    for bump in max(explained_by, key=lambda bump: _surprise(explained_by[bump])).finer(visit.sightings):
        if _witnesses(visit, bump) >= WITNESSES:
            explained_by[bump] = visit.explained(bump.design(visit.sightings))
    found = max(explained_by, key=lambda bump: _surprise(explained_by[bump]))
    return found, explained_by[found], len(np.unique(visit.sightings.time)) - 1


def _witnesses(visit: Visit, bump: StationBump) -> int:
    """How many targets were measured both before and after."""
    after = visit.sightings.time >= bump.time
    target = visit.recording.target
    return len(np.intersect1d(target[visit.use & after], target[visit.use & ~after]))


def _surprise(explained: Explained) -> float:
    """How unlikely such a fall of chi-square is by the stated noise."""
    return float(surprise(explained.drop, explained.rank))


def _of_gross(visit: Visit, gross: Sequence[int], rows: Ints) -> Item:
    recording, name = visit.recording, visit.recording.stations[0]
    targets = tuple(dict.fromkeys(recording.targets[recording.target[i]] for i in gross))
    sentence = gross_sentence(visit, gross, rows)
    return Item(name, "gross", not gross, sentence, targets=targets, rows=tuple(int(rows[i]) for i in gross))


def _of_bump(visit: Visit, bump: StationBump | None, rows: Ints, family: Family) -> Item:
    recording, name = visit.recording, visit.recording.stations[0]
    if bump is None:
        return Item(name, "bump", True, f"{name}: no motion at once")
    explained = visit.explained(bump.design(visit.sightings))
    order = np.argsort(recording.time, kind="stable")
    at = int(np.searchsorted(recording.time[order], bump.time))
    pair = order[at - 1 : at + 1]
    between = float(recording.time[pair[0]]), float(recording.time[pair[1]])
    numbers = int(rows[pair[0]]), int(rows[pair[1]])
    chance = family.adjusted(visit.p_value(explained), len(order) - 1)
    sentence = bump_sentence(recording, between, numbers, explained)
    return Item(name, "bump", False, sentence, chance, rows=numbers, between=between)


def _creep(visit: Visit) -> Floats:
    """Change (n, 3, 6) of the readings by an even motion of the station, as large as its end."""
    duration = max(float(np.ptp(visit.recording.time)), 1e-9)
    return np.asarray(station_design(visit.sightings) * (visit.sightings.station_time / duration)[:, None, None])


def _drift(visit: Visit, family: Family) -> Item:
    explained = visit.explained(_creep(visit))
    p = family.adjusted(visit.p_value(explained))
    passed = p >= family.level
    return Item(visit.recording.stations[0], "drift", passed, drift_sentence(visit.recording, explained, passed), p)


def _instrument_drift(visit: Visit, family: Family) -> Item:
    laws = [RangeDrift(law="visit"), IndexDrift(law="visit")]
    explained = visit.explained(np.concatenate([law.design(visit.sightings) for law in laws], axis=2))
    p = family.adjusted(visit.p_value(explained))
    passed = p >= family.level
    sentence = instrument_sentence(visit.recording, explained, passed)
    return Item(visit.recording.stations[0], "instrument-drift", passed, sentence, p)


def _closure(visit: Visit, family: Family) -> Item:
    """Scatter of repeated pointings against the stated noise, two-sided; less noise than stated passes with a word."""
    name, ratio = visit.recording.stations[0], float(np.sqrt(visit.chi2 / max(visit.dof, 1)))
    if visit.dof < 1:
        return Item(name, "closure", True, f"{name}: what is left of its repeated pointings tells no scatter")
    p, less = two_sided(visit.chi2, visit.dof)
    p = family.adjusted(p)
    scatter = f"{name}: repeated pointings scatter {ratio:.2f} times the stated noise ({visit.dof} degrees of freedom)"
    if p >= family.level:
        return Item(name, "closure", True, f"{scatter}, as it should be", p)
    return Item(name, "closure", less, f"{scatter}, {'less' if less else 'more'} than stated", p)
