"""Result of a field check, its items, and correction of p-values for the number of tests."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import PrivateAttr
from scipy import special

from ltsim.adjustment.fieldcheck.occupation import Faces, StationOccupation
from ltsim.adjustment.identification.tests import Test
from ltsim.core.arrays import Ints
from ltsim.core.errors import ModelError
from ltsim.core.results import Table, columns_of, numbers, texts
from ltsim.core.units import ARCSECOND, MICROMETRE
from ltsim.core.values import ValueEquality
from ltsim.physics.effects.motions import StationMotion
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat, ResultFile, SourceEntry

Kind = Literal[
    "cause", "two-face", "gross", "bump", "drift", "instrument-drift", "closure", "network", "level", "mistake"
]
CAUSES = ("cause", "mistake", "bump", "drift")
"""Kinds of items that are reported first, because two-face differences and scatter follow from them."""


class Item(Entry):
    """Test of a field check, with its result."""

    station: str
    """Station; empty for an item on all stations."""
    kind: Kind
    """Kind of test."""
    passed: bool
    """True if the item is no reason to stop."""
    sentence: str
    """Sentence with units."""
    p_value: OptionalFloat = None
    """p-value, corrected for the number of tests."""
    targets: tuple[str, ...] = ()
    """Targets that the item concerns."""
    rows: tuple[int, ...] = ()
    """Rows of the recording that the item concerns, from 1."""
    between_s: tuple[Finite, Finite] | None = None
    """Time interval of a motion [s], after the first and before the second time; null for other tests."""

    @classmethod
    def of(cls, at: str, kind: Kind, passed: bool, sentence: str, p: float | None = None, **marked: Any) -> Item:
        """Item of a test with its sentence, p-value, and the targets, rows or times that it concerns."""
        return cls(station=at, kind=kind, passed=passed, sentence=sentence, p_value=p, **marked)


OF_TEST: dict[str, Kind] = {
    "outlier": "gross",
    "station-bump": "bump",
    "station-drift": "drift",
    "reference-value": "network",
    "names": "mistake",
    "unit": "mistake",
    "height": "mistake",
    "noise-level": "closure",
}
"""Kind of item for each kind of identified cause; `cause` for others."""


def item_of(test: Test) -> Item:
    """Item of an identified cause; it passes only if it is noise smaller than declared."""
    passed = test.kind == "noise-level" and (test.estimate or 0.0) <= 1.0
    at, targets = ", ".join(test.where.stations), test.where.targets
    kind: Kind = "level" if test.acts_on == "level" else OF_TEST.get(test.kind, "cause")
    sentence = test.sentence.rstrip(".")
    return Item.of(at, kind, passed, sentence, test.p_value, targets=targets, rows=test.rows)


ITEMS = Table(
    "items.csv",
    "tests of the field check",
    columns_of(Item, "station kind passed p_value sentence", p_value={"kind": "chance"}),
)
TWO_FACE = Table(
    "two_face.csv",
    "half two-face differences with their limits, one row per pair",
    (
        *texts(station="name", target="name"),
        *numbers(row_1="of the first face, from 1", row_2="of the second face"),
        *numbers(".4f", half_range_um="half difference", half_across_arcsec="as half_range_um"),
        *numbers(".4f", half_elevation_arcsec="as half_range_um", limit_range_um="limit of half_range_um"),
        *numbers(".4f", limit_across_arcsec="as limit_range_um", limit_elevation_arcsec="as limit_range_um"),
        *texts(passed="yes or no"),
    ),
)


@dataclass(frozen=True)
class SetUp(ValueEquality):
    """Tests of a set-up: items, two-face differences (None without pairs), model (None without repeats).

    `rows` are the rows of the whole recording, from 1.
    """

    station: str
    items: tuple[Item, ...]
    faces: Faces | None
    visit: StationOccupation | None
    rows: Ints
    motions: tuple[StationMotion, ...] = ()
    """Motions of the station during the occupation."""


@dataclass(frozen=True)
class CheckArrays(ValueEquality):
    """Arrays of a check: recording and set-ups."""

    recording: Recording
    setups: tuple[SetUp, ...]


class Check(ResultFile):
    """`check.json`: the result of `check`."""

    FILE: ClassVar[str] = "check.json"
    format: Literal["ltsim-check/1"] = "ltsim-check/1"
    """Format and version of this file."""
    passed: bool
    """True for go, False for no-go."""
    sentence: str
    """Sentence with go or no-go and its reason."""
    level: Finite
    """False-alarm probability of the whole check."""
    tests: tuple[Test, ...] = ()
    """Simple causes that the readings support, and outliers."""
    items: tuple[Item, ...]
    """Items of all tests, set-up by set-up, for the readings without these causes."""
    _arrays: CheckArrays | None = PrivateAttr(None)

    @classmethod
    def of(cls, arrays: CheckArrays, network: Sequence[Item], level: float, tests: Sequence[Test]) -> Self:
        """Result from the items of set-ups and network: causes and blunders first, then set-ups."""
        causes = tuple(map(item_of, tests))
        mistakes = (item for item in network if item.kind == "mistake")
        rest = (item for item in network if item.kind != "mistake")
        items = (*causes, *mistakes, *(item for setup in arrays.setups for item in setup.items), *rest)
        made = cls(
            recording=SourceEntry.of(arrays.recording),
            passed=all(item.passed for item in items),
            sentence=_answer(items, causes, len(arrays.setups)),
            level=level,
            tests=tuple(tests),
            items=items,
        )
        made._arrays = arrays
        return made

    @property
    def arrays(self) -> CheckArrays:
        """Set-ups as arrays; raises ModelError for a check that was read from a file."""
        if self._arrays is None:
            raise ModelError("a check read from a file has no set-ups; call lt.check with the recording")
        return self._arrays

    def _lines(self) -> list[str]:
        return [self.sentence]

    def _tables(self) -> Mapping[str, Callable[[], Table]]:
        return {"items": lambda: ITEMS.filled(self.items), "two_face": self._two_face}

    def _two_face(self) -> Table:
        """Table of half two-face differences with their limits, one row per pair."""
        rows, recording = [], self.arrays.recording
        for setup in self.arrays.setups:
            if (faces := setup.faces) is None:
                continue
            sizes = np.concatenate([faces.pairs.half, faces.limit], axis=1) / (2 * [MICROMETRE, ARCSECOND, ARCSECOND])
            for at, size, over in zip(setup.rows[faces.pairs.rows], sizes.tolist(), faces.over, strict=True):
                target = recording.targets[recording.target[at[0] - 1]]
                rows.append([setup.station, target, *at.tolist(), *size, "no" if over.any() else "yes"])
        return TWO_FACE.filled(rows)


def _answer(items: Sequence[Item], causes: Sequence[Item], setups: int) -> str:
    """Sentence with go or no-go and its reason: first causes from which others follow, then noisy targets."""
    failed = [item for item in items if not item.passed]
    count = sum(not item.passed for item in causes)
    rest = sorted(failed[count:], key=lambda i: not (i.kind in CAUSES or (i.kind == "closure" and i.targets)))
    failed = [*failed[:count], *rest]
    if failed:
        more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
        return f"no-go: {failed[0].sentence}{more}"
    return f"go: {setups} set-up{'s' if setups > 1 else ''} within noise and specification"


@dataclass(frozen=True)
class Family:
    """Family of tests of a recording: `adjusted` p-values count all tests and all places within a test."""

    level: float
    tests: int

    @property
    def alpha_per_test(self) -> float:
        """Part of the significance level for one test."""
        return self.level / self.tests

    def adjusted(self, p: float, looks: int = 1) -> float:
        """p-value corrected for the number of tests and of places within a test (Bonferroni)."""
        return min(1.0, p * looks * self.tests)


def two_sided(chi2: float, dof: int) -> tuple[float, bool]:
    """Two-sided p-value of a chi-square, and a flag that it is too small."""
    low, high = float(special.chdtr(dof, chi2)), float(special.chdtrc(dof, chi2))
    return min(1.0, 2 * min(low, high)), low < high
