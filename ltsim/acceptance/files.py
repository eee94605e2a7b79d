"""Result of acceptance tests: accept.json and accept.csv."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from ltsim.core.results import Table, columns_of
from ltsim.core.units import MICROMETRE
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat, Positive, ResultFile
from ltsim.recordings.specification import Specification

Judgement = Literal["accepted", "rejected", "undecided"]
"""Judgement of a measured error by ISO 14253-1: accepted or rejected by more than its expanded uncertainty.

An error without an uncertainty is compared with the limit alone.
"""


JUDGEMENT_ORDER: tuple[Judgement, ...] = ("rejected", "undecided", "accepted")
"""Judgements, the worst first."""


def joint_judgement(judgements: Collection[Judgement]) -> Judgement:
    """Judgement of several errors: rejected if one is, accepted if all are."""
    return "rejected" if "rejected" in judgements else "accepted" if {*judgements} <= {"accepted"} else "undecided"


class TestEntry(Entry):
    """An acceptance test, measured or predicted."""

    __test__ = False

    name: str
    """Name of the test."""
    group: str
    """Group of the test: lengths of one position, two-face tests, ..."""
    limit_um: Positive
    """Maximum permissible error of the manufacturer's specification [um]."""
    error_um: Finite
    """Expected or measured error [um]; for a two-face test the distance perpendicular to the beam."""
    expanded_um: OptionalFloat = None
    """Expanded uncertainty (95 %) of the error [um]; null if it was not reported."""
    pass_probability: OptionalFloat = None
    """Predicted probability that the error is within the limit; null for a measured error."""
    judgement: Judgement | None = None
    """Judgement of a measured error; null for a predicted one."""

    @property
    def guarded_limit_ratio(self) -> float:
        """Ratio of the error, reduced by its expanded uncertainty, to the limit; above 1 the error is rejected."""
        return (abs(self.error_um) - (self.expanded_um or 0.0)) / self.limit_um

    @property
    def hardest_first_key(self) -> tuple[float, int, float]:
        """Sort key that puts the test closest to failure first.

        It contains the probability to pass, the judgement, and a ratio of error to limit: for a rejected error with the
        error reduced by its uncertainty, otherwise with the error increased by it.
        """
        share = self.guarded_limit_ratio
        if self.judgement != "rejected":
            share += 2 * (self.expanded_um or 0.0) / self.limit_um
        return self.pass_probability or 0.0, JUDGEMENT_ORDER.index(self.judgement or "accepted"), -share


class GroupEntry(Entry):
    """Summary of the tests of one group."""

    name: str
    """Name of the group."""
    tests: int
    """Number of tests in the group."""
    pass_probability: OptionalFloat = None
    """Predicted probability that all tests are within their limits; null for measured errors."""
    judgement: Judgement | None = None
    """Judgement of all measured errors; null for predicted ones."""
    largest_limit_ratio: Finite
    """Largest ratio of error to limit; for a prediction the error includes its uncertainty."""


TESTS_TABLE = Table(
    "accept.csv",
    "errors and limits of the tests",
    columns_of(
        TestEntry,
        name={"name": "test"},
        limit_um={"csv_format": ".6g", "display_format": ".1f"},
        error_um={"csv_format": ".6g", "display_format": ".1f"},
        expanded_um={"name": "U_um", "csv_format": ".6g", "display_format": ".1f"},
        pass_probability={"csv_format": ".4g"},
        judgement={"kind": "text"},
    ),
)


GROUPS_TABLE = Table(
    "groups.csv",
    "tests by group",
    columns_of(
        GroupEntry,
        name={"name": "group"},
        pass_probability={"title": "all pass", "n_digits": 3},
        judgement={"kind": "text"},
        largest_limit_ratio={"display_format": ".2f"},
    ),
)


class SensitivityEntry(Entry):
    """Sensitivity of the tests to one constant of the instrument, with all others zero."""

    name: str
    """Name of the constant."""
    unit: str
    """Unit of `prior_sigma` and `smallest_failing`."""
    prior_sigma: Finite
    """Prior standard deviation of the constant by the specification, in `unit`."""
    smallest_failing: OptionalFloat
    """Smallest size of the constant at which a test fails; null if no test depends on it."""
    test: str
    """Test that fails first."""


class WorstPassingInstrumentEntry(Entry):
    """Instrument with the largest point errors that still passes every test."""

    constants: dict[str, Finite]
    """Constants of the instrument, in the units of the sensitivities."""
    rms_um: Finite
    """Root mean square error of points around it, 1.5 to 9 m away, after a best fit."""
    largest_um: Finite
    """Largest error of these points."""


class AcceptanceFile(ResultFile):
    """`accept.json`: the result of `accept`."""

    FILE: ClassVar[str] = "accept.json"
    format: Literal["ltsim-accept/1"] = "ltsim-accept/1"
    """Format and version of this file."""
    title: str = ""
    """Free text."""
    kind: Literal["predicted", "measured", "network"]
    """Origin of the test errors: predicted, measured, or taken from a network."""
    plan: str
    """Standard, or file of tests."""
    specification: Specification
    """Limits of the manufacturer."""
    assumption: str = ""
    """Assumption by which limits were converted to standard deviations."""
    pass_probability: OptionalFloat = None
    """Predicted probability that all tests pass; null for measured errors."""
    judgement: Judgement | None = None
    """Judgement of all measured errors by ISO 14253-1: rejected if one is, accepted if all are and no test of the plan
    is missing; null for a prediction.
    """
    decision_rule: str = ""
    """Rule by which measured errors are judged, and the content of their uncertainties; empty for a prediction."""
    unmeasured: tuple[str, ...] = ()
    """Tests of the plan without a measured error."""
    sentence: str
    """Sentence with the result."""
    next_actions: tuple[str, ...] = ()
    """Next actions, the most urgent first."""
    groups: tuple[GroupEntry, ...] = Field(min_length=1)
    """Tests by group."""
    tests: tuple[TestEntry, ...] = Field(min_length=1)
    """All tests."""
    sensitivities: tuple[SensitivityEntry, ...] = ()
    """Sensitivity of the tests to each constant of the instrument."""
    worst_passing: WorstPassingInstrumentEntry | None = None
    """Instrument with the largest point errors that passes every test; null if it was not searched."""

    def _lines(self) -> list[str]:
        return [f"Acceptance ({self.kind}, {self.plan}): {self.sentence}"]

    def _tables(self) -> Mapping[str, Callable[[], Table]]:
        return {
            "tests": lambda: TESTS_TABLE.with_rows(self.tests),
            "groups": lambda: GROUPS_TABLE.with_rows(self.groups),
        }


def group_entries(
    test_entries: Sequence[TestEntry], pass_probability_by_group: Mapping[str, float] | None = None
) -> tuple[GroupEntry, ...]:
    """Summaries of `test_entries` by group; in a prediction the uncertainty of an error is included in it.

    `pass_probability_by_group` holds the predicted probability that all tests of a group pass; None for measured
    errors.
    """
    predicted = pass_probability_by_group or {}

    def limit_ratio(test_entry: TestEntry) -> float:
        margin = (test_entry.expanded_um or 0.0) if predicted else 0.0
        return (abs(test_entry.error_um) + margin) / test_entry.limit_um

    by_group = {
        name: [t for t in test_entries if t.group == name] for name in dict.fromkeys(t.group for t in test_entries)
    }
    return tuple(
        GroupEntry(
            name=name,
            tests=len(entries),
            pass_probability=predicted.get(name),
            judgement=None if predicted else joint_judgement([t.judgement for t in entries if t.judgement]),
            largest_limit_ratio=max(map(limit_ratio, entries)),
        )
        for name, entries in by_group.items()
    )


def make_test_entry(
    test_name: str, test_group: str, error: float, limit: float, expanded_uncertainty: float = float("nan")
) -> TestEntry:
    """Entry of a test with its name and group, from its error and limit [m]; the error is judged by ISO 14253-1.

    `expanded_uncertainty` (95 %) is that of the error [m], NaN if not given.
    """
    sizes_um = {
        "error_um": error / MICROMETRE,
        "limit_um": limit / MICROMETRE,
        "expanded_um": expanded_uncertainty / MICROMETRE,
    }
    margin = 0.0 if np.isnan(expanded_uncertainty) else expanded_uncertainty
    is_accepted, is_rejected = abs(error) + margin <= limit, abs(error) - margin > limit
    judgement: Judgement = "accepted" if is_accepted else "rejected" if is_rejected else "undecided"
    return TestEntry(name=test_name, group=test_group, judgement=judgement, **sizes_um)
