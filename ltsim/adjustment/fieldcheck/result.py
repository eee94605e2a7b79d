"""Result of a field check and its items; correction of p-values for the number of tests."""

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
"""Kinds of items that are reported first: two-face differences and scatter follow from them."""


class Item(Entry):
    """A test of the field check, with its outcome."""

    station: str
    """Empty for what concerns all stations."""
    kind: Kind
    """Test that the item reports."""
    passed: bool
    """True where the item is no reason against going on."""
    sentence: str
    """Text for a person, with units."""
    p_value: OptionalFloat = None
    """Chance of as much by noise, paid for all that was looked at."""
    targets: tuple[str, ...] = ()
    """Targets that stand out."""
    rows: tuple[int, ...] = ()
    """Rows of the recording that stand out, from 1."""
    between_s: tuple[Finite, Finite] | None = None
    """Time interval of a motion [s]: after the first and before the second of these times; empty for other tests."""

    @classmethod
    def of(cls, at: str, kind: Kind, passed: bool, sentence: str, p: float | None = None, **marked: Any) -> Item:
        """Item of a test with its sentence, its p-value and the targets, rows or times that it marks."""
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
"""Kind of the item of a cause that was identified; `cause` for the others."""


def item_of(test: Test) -> Item:
    """The item of a cause that was identified: noise that is less than declared is no reason to stop."""
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
    "half two-face differences with their limits, a row a pair",
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
    """Tests of a set-up: items, two-face differences (None without pairs) and model (None where nothing repeats).

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
    """Recording that was checked, and its set-ups."""

    recording: Recording
    setups: tuple[SetUp, ...]


class Check(ResultFile):
    """`check.json`: the result of `check`."""

    FILE: ClassVar[str] = "check.json"
    format: Literal["ltsim-check/1"] = "ltsim-check/1"
    """Format and version of this file."""
    passed: bool
    """Go."""
    sentence: str
    """Go or no-go, and why."""
    level: Finite
    """Chance of one false alarm in the whole recording."""
    tests: tuple[Test, ...] = ()
    """Simple causes that the readings support, and outliers."""
    items: tuple[Item, ...]
    """Every test, set-up by set-up, of the readings without these causes."""
    _arrays: CheckArrays | None = PrivateAttr(None)

    @classmethod
    def of(cls, arrays: CheckArrays, network: Sequence[Item], level: float, tests: Sequence[Test]) -> Self:
        """The result of the items of the set-ups and of the network: causes and mistakes first, then set-ups."""
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
        """The set-ups as arrays; raises ModelError for a check that was read from a file."""
        if self._arrays is None:
            raise ModelError("a check read from a file has no set-ups; call lt.check with the recording")
        return self._arrays

    def _lines(self) -> list[str]:
        return [self.sentence]

    def _tables(self) -> Mapping[str, Callable[[], Table]]:
        return {"items": lambda: ITEMS.filled(self.items), "two_face": self._two_face}

    def _two_face(self) -> Table:
        """Half two-face differences with their limits, one row a pair."""
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
    """Go or no-go and its reason: first the cause from which others follow, then targets that scatter by themselves."""
    failed = [item for item in items if not item.passed]
    count = sum(not item.passed for item in causes)
    rest = sorted(failed[count:], key=lambda i: not (i.kind in CAUSES or (i.kind == "closure" and i.targets)))
    failed = [*failed[:count], *rest]
    if failed:
        more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
        return f"no-go: {failed[0].sentence}{more}"
    return f"go: {setups} set-up{'s' if setups > 1 else ''} within noise and guarantee"


@dataclass(frozen=True)
class Family:
    """The tests of a recording: `adjusted` chances count all of them and every place that one looked at."""

    level: float
    tests: int

    @property
    def alpha_per_test(self) -> float:
        """Part of the level that one test has."""
        return self.level / self.tests

    def adjusted(self, p: float, looks: int = 1) -> float:
        """Chance of one such result or more among all that was looked at (Bonferroni)."""
        return min(1.0, p * looks * self.tests)


def two_sided(chi2: float, dof: int) -> tuple[float, bool]:
    """Chance of a chi-square so far out on either side, and whether it is too small."""
    low, high = float(special.chdtr(dof, chi2)), float(special.chdtrc(dof, chi2))
    return min(1.0, 2 * min(low, high)), low < high
