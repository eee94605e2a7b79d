"""Items of a field check, the file check.json, and the correction of p-values for the number of tests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from scipy import special

from ltsim.adjustment.identification.tests import Test
from ltsim.core.results import Table, numbers, texts
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat, ResultFile

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


class CheckFile(ResultFile):
    """`check.json`: from `check`."""

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
