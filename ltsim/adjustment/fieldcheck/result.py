"""Result of a field check with the results of its tests (items), and correction of p-values for the number of tests."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import PrivateAttr
from scipy import special

from ltsim.adjustment.fieldcheck.setup_model import SetupModel, TwoFaceDifferences
from ltsim.adjustment.identification.cause_tests import CauseTest
from ltsim.core.arrays import Ints
from ltsim.core.equality import ValueEquality
from ltsim.core.errors import ModelError
from ltsim.core.results import Table, model_columns, number_columns, text_columns
from ltsim.core.units import ARCSECOND, MICROMETRE
from ltsim.physics.effects.motions import StationMotionEffect
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat, ResultFile, ResultSource

CheckItemKind = Literal[
    "cause",
    "two-face",
    "gross",
    "bump",
    "drift",
    "instrument-drift",
    "closure",
    "network",
    "reference",
    "level",
    "mistake",
]
"""Kind of a test of a field check.

`cause` identified cause without a kind below, `two-face` two-face differences, `gross` gross pointings, `bump` sudden
motion of a station, `drift` motion of a station at a constant rate, `instrument-drift` drift of the zeros of an
instrument, `closure` scatter of repeated pointings, `network` agreement of the stations, `reference` reference values,
`level` levels, `mistake` blunders."""
FIRST_REPORTED_TEST_KINDS = ("cause", "mistake", "gross", "bump", "drift")
"""Kinds of failed tests that are reported first, because their causes also produce two-face differences and scatter.

Of one set-up, a gross error precedes a bump (sudden motion of the station): pointings are rejected only while each
rejection reduces chi-square more than the best bump does.
"""


class CheckItem(Entry):
    """Result of one test of a field check."""

    station: str
    """Name of the tested station; empty for a test of all stations."""
    kind: CheckItemKind
    """Kind of test."""
    passed: bool
    """True if the test detected no error, so that the measurement can continue."""
    sentence: str
    """Result of the test as a sentence with units."""
    p_value: OptionalFloat = None
    """p-value, corrected for the number of tests (for an identified cause not corrected); null for a test without
    one."""
    targets: tuple[str, ...] = ()
    """Names of the targets with the detected error."""
    rows: tuple[int, ...] = ()
    """Row numbers, from 1, of the pointings with the detected error."""
    motion_interval_s: tuple[Finite, Finite] | None = None
    """Times [s] between which a sudden motion of the station happened; null for other tests."""

    @classmethod
    def from_test(
        cls,
        station: str,
        kind: CheckItemKind,
        passed: bool,
        sentence: str,
        p_value: float | None = None,
        **details: Any,
    ) -> CheckItem:
        """Result of a test of `station`, which is empty for a test of all stations.

        `details` are the fields `targets`, `rows` and `motion_interval_s`.
        """
        return cls(station=station, kind=kind, passed=passed, sentence=sentence, p_value=p_value, **details)


CHECK_ITEM_KIND_BY_CAUSE_KIND: dict[str, CheckItemKind] = {
    "outlier": "gross",
    "station-bump": "bump",
    "station-drift": "drift",
    "station-settling": "drift",
    "reference-value": "reference",
    "names": "mistake",
    "unit": "mistake",
    "height": "mistake",
    "noise-level": "closure",
}
"""Kind of test under which a field check lists an identified cause, by the kind of the cause; `cause` for other
kinds."""


def check_item_from_cause(test: CauseTest) -> CheckItem:
    """Test result of a field check for an identified cause: failed, except for noise smaller than declared."""
    stations, targets = ", ".join(test.where.stations), test.where.targets
    kind: CheckItemKind = "level" if test.acts_on == "level" else CHECK_ITEM_KIND_BY_CAUSE_KIND.get(test.kind, "cause")
    sentence = test.sentence.rstrip(".")
    return CheckItem.from_test(
        stations, kind, not test.is_fault, sentence, test.p_value, targets=targets, rows=test.rows
    )


ITEMS_TABLE = Table(
    "items.csv",
    "tests of the field check",
    model_columns(CheckItem, "station kind passed p_value sentence", p_value={"kind": "p_value"}),
)
TWO_FACE_TABLE = Table(
    "two_face.csv",
    "half two-face differences (face 1 minus face 2) with their limits, one row per pair",
    (
        *text_columns(station="name of the station", target="name of the target"),
        *number_columns(row_1="row of the pointing on face 1, from 1", row_2="row of the pointing on face 2, from 1"),
        *number_columns(".4f", half_range_um="half difference of the range"),
        *number_columns(".4f", half_across_arcsec="half difference of the azimuth, times the cosine of the elevation"),
        *number_columns(".4f", half_elevation_arcsec="half difference of the elevation"),
        *number_columns(".4f", limit_range_um="largest permitted half_range_um"),
        *number_columns(".4f", limit_across_arcsec="largest permitted half_across_arcsec"),
        *number_columns(".4f", limit_elevation_arcsec="largest permitted half_elevation_arcsec"),
        *text_columns(passed="yes if all three half differences are within their limits, else no"),
    ),
)


@dataclass(frozen=True)
class SetupCheck(ValueEquality):
    """Results of all tests of one set-up, with the data from which they were computed."""

    station: str
    """Name of the station."""
    items: tuple[CheckItem, ...]
    """Test results, one per test."""
    two_face_differences: TwoFaceDifferences | None
    """Half two-face differences with their limits; None if no target was measured in both faces."""
    setup_model: SetupModel | None
    """Linear model of the repeated pointings of this set-up; None if no target was measured twice."""
    row_numbers: Ints
    """Row numbers (n,) of the n pointings of the set-up in the whole recording, from 1."""
    motions: tuple[StationMotionEffect, ...] = ()
    """Detected motions of the station during its occupation: sudden (bump) or at a constant rate (drift)."""


@dataclass(frozen=True)
class CheckArrays(ValueEquality):
    """Data of a field check that are not written to `check.json`: the recording, and arrays of each set-up."""

    recording: Recording
    """Recording that was checked."""
    setup_checks: tuple[SetupCheck, ...]
    """Test results and data of each set-up, in the order of the stations."""


class Check(ResultFile):
    """Result of a field check (command `check`), with the content of `check.json`."""

    FILE: ClassVar[str] = "check.json"
    COMPANION_TABLES: ClassVar[Mapping[str, Table]] = {"two_face": TWO_FACE_TABLE}
    FURTHER_FILES: ClassVar[tuple[str, ...]] = ("check.svg",)
    format: Literal["ltsim-check/1"] = "ltsim-check/1"
    """Format and version of this file."""
    passed: bool
    """True if all tests passed (go), False otherwise (no-go)."""
    sentence: str
    """Sentence that begins with go or no-go, and its reason."""
    level: Finite
    """False-alarm probability of the whole check."""
    tests: tuple[CauseTest, ...] = ()
    """Tests of identified causes of errors (for example a moved target or a wrong unit), and of outliers."""
    items: tuple[CheckItem, ...]
    """Results of all tests: identified causes, then set-ups, then the network. For the tests of set-ups and network the
    readings are corrected for the identified causes.
    """
    _arrays: CheckArrays | None = PrivateAttr(None)

    @classmethod
    def from_items(
        cls, arrays: CheckArrays, network_check_items: Sequence[CheckItem], alpha: float, tests: Sequence[CauseTest]
    ) -> Self:
        """Result of a field check, with test results in this order: identified causes, blunders, set-ups, network.

        `tests` are the tests of identified causes, `alpha` is the false-alarm probability of the whole check.
        """
        causes = tuple(map(check_item_from_cause, tests))
        mistakes = (item for item in network_check_items if item.kind == "mistake")
        other_network_items = (item for item in network_check_items if item.kind != "mistake")
        items = (
            *causes,
            *mistakes,
            *(item for setup in arrays.setup_checks for item in setup.items),
            *other_network_items,
        )
        result = cls(
            recording=ResultSource.from_recording(arrays.recording),
            passed=all(item.passed for item in items),
            sentence=_go_or_no_go_sentence(items, causes, arrays),
            level=alpha,
            tests=tuple(tests),
            items=items,
        )
        result._arrays = arrays
        return result

    @property
    def arrays(self) -> CheckArrays:
        """Recording and arrays of the set-ups; raises ModelError for a check that was read from a file."""
        if self._arrays is None:
            raise ModelError("a check read from a file has no recording; call lt.check with the recording")
        return self._arrays

    def _summary_lines(self) -> list[str]:
        return [self.sentence]

    def _table_makers(self) -> Mapping[str, Callable[[], Table]]:
        return {"items": lambda: ITEMS_TABLE.with_rows(self.items), "two_face": self._two_face_table}

    def _two_face_table(self) -> Table:
        """Data table of the half two-face differences with their limits, one row per pair of pointings."""
        rows, recording = [], self.arrays.recording
        for setup in self.arrays.setup_checks:
            if (faces := setup.two_face_differences) is None:
                continue
            sizes = np.concatenate([faces.uncorrected_pairs.half_differences, faces.half_difference_limits], axis=1) / (
                2 * [MICROMETRE, ARCSECOND, ARCSECOND]
            )
            for at, size, over in zip(
                setup.row_numbers[faces.uncorrected_pairs.pointing_indices],
                sizes.tolist(),
                faces.exceeds_limit,
                strict=True,
            ):
                target = recording.targets[recording.target[at[0] - 1]]
                rows.append([setup.station, target, *at.tolist(), *size, "no" if over.any() else "yes"])
        return TWO_FACE_TABLE.with_rows(rows)


def _go_or_no_go_sentence(
    check_items: Sequence[CheckItem], cause_items: Sequence[CheckItem], arrays: CheckArrays
) -> str:
    """Sentence that begins with go or no-go, and the sentence of the most important failed test.

    Failed tests that may be the cause of other failures are the most important. The sentence of the test gets a capital
    letter, unless it begins with the name of a station or target.
    """
    failed_items = [item for item in check_items if not item.passed]
    n_failed_causes = sum(not item.passed for item in cause_items)
    rest = sorted(
        failed_items[n_failed_causes:],
        key=lambda i: not (i.kind in FIRST_REPORTED_TEST_KINDS or (i.kind == "closure" and i.targets)),
    )
    failed_items = [*failed_items[:n_failed_causes], *rest]
    if failed_items:
        n_more = len(failed_items) - 1
        more = f" (and {n_more} more failed test{'s' if n_more > 1 else ''})" if n_more else ""
        reason = failed_items[0].sentence
        names = (*arrays.recording.stations, *arrays.recording.targets)
        is_name_first = any(re.match(rf"{re.escape(name)}(?!\w)", reason) for name in names)
        reason = reason if is_name_first else f"{reason[:1].upper()}{reason[1:]}"
        return f"no-go: {reason}{more}"
    n_setups = len(arrays.setup_checks)
    return f"go: {n_setups} set-up{'s' if n_setups > 1 else ''} within noise and specification"


@dataclass(frozen=True)
class BonferroniFamily:
    """Family of tests that share one false-alarm probability equally (Bonferroni)."""

    false_alarm_rate: float
    """Probability of at least one false alarm among all tests of the family."""
    n_tests: int
    """Number of tests of the family."""

    @property
    def alpha_per_test(self) -> float:
        """Significance level of one test of the family."""
        return self.false_alarm_rate / self.n_tests

    def corrected_p_value(self, p_value: float, n_alternatives: int = 1) -> float:
        """p-value corrected for the number of tests (Bonferroni), at most 1.

        The p-value is multiplied by the number of tests of the family, and by `n_alternatives`, the number of time gaps
        or pointings that one test examines.
        """
        return min(1.0, p_value * n_alternatives * self.n_tests)


def two_sided_chi2_p_value(chi2: float, dof: int) -> tuple[float, bool]:
    """Two-sided p-value of `chi2` with `dof` degrees of freedom, and a flag, True if `chi2` is below its median."""
    low, high = float(special.chdtr(dof, chi2)), float(special.chdtrc(dof, chi2))
    return min(1.0, 2 * min(low, high)), low < high
