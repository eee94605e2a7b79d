"""Result of acceptance tests: the content of accept.json and accept.csv."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from ltsim.core.results import Table, model_columns
from ltsim.core.units import MICROMETRE
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat, Positive, ResultFile
from ltsim.recordings.specification import Specification

Judgement = Literal["accepted", "rejected", "undecided"]
"""Judgement of a measured error by ISO 14253-1: `accepted` if it is below its limit by at least its expanded
uncertainty, `rejected` if it is above its limit by more than its expanded uncertainty, else `undecided`. An error
without an uncertainty is compared with its limit directly."""


JUDGEMENTS_FROM_WORST_TO_BEST: tuple[Judgement, ...] = ("rejected", "undecided", "accepted")
"""Judgements of measured errors in the order from the worst to the best."""


def combined_judgement(judgements: Collection[Judgement]) -> Judgement:
    """Judgement of several test errors together: rejected if one of them is, accepted if all are, else undecided."""
    return "rejected" if "rejected" in judgements else "accepted" if {*judgements} <= {"accepted"} else "undecided"


class TestOutcome(Entry):
    """Outcome of one acceptance test: its measured or predicted error, its limit and the judgement."""

    __test__ = False
    """False: pytest does not collect this class."""

    name: str
    """Name of the acceptance test."""
    group: str
    """Group of the test, such as the two-face tests, or the lengths in one orientation."""
    limit_um: Positive
    """Maximum permissible error by the manufacturer's specification [um]."""
    error_um: Finite
    """Expected or measured error [um]; in a two-face test the distance between the points of both faces, perpendicular
    to the beam."""
    expanded_uncertainty_um: OptionalFloat = None
    """Expanded uncertainty (95 %) of the error [um]; null if it was not reported."""
    pass_probability: OptionalFloat = None
    """Predicted probability that the error is within the limit; null for a measured error."""
    judgement: Judgement | None = None
    """Judgement of a measured error; null for a predicted error."""

    @property
    def lower_bound_to_limit_ratio(self) -> float:
        """Ratio (absolute error minus expanded uncertainty) / limit; an error with a ratio above 1 is rejected."""
        return (abs(self.error_um) - (self.expanded_uncertainty_um or 0.0)) / self.limit_um

    @property
    def hardest_first_sort_key(self) -> tuple[float, int, float]:
        """Sort key that puts the test first whose error exceeds its limit most, or is closest to its limit.

        The key consists of the probability to pass, the judgement, and the ratio of error to limit. The error is
        reduced by its expanded uncertainty if it is rejected, and increased by it otherwise.
        """
        share = self.lower_bound_to_limit_ratio
        if self.judgement != "rejected":
            share += 2 * (self.expanded_uncertainty_um or 0.0) / self.limit_um
        return self.pass_probability or 0.0, JUDGEMENTS_FROM_WORST_TO_BEST.index(self.judgement or "accepted"), -share


class TestGroupSummary(Entry):
    """Summary of the tests of one group."""

    name: str
    """Name of the group of tests."""
    n_tests: int
    """Number of tests in the group."""
    pass_probability: OptionalFloat = None
    """Predicted probability that the errors of all tests in the group are within their limits; null for measured
    errors."""
    judgement: Judgement | None = None
    """Judgement of all measured errors in the group together; null for predicted errors."""
    largest_limit_ratio: Finite
    """Largest ratio of error to limit in the group; a predicted error is increased by its expanded uncertainty."""


TESTS_TABLE = Table(
    "accept.csv",
    "errors and limits of the acceptance tests",
    model_columns(
        TestOutcome,
        name={"name": "test"},
        limit_um={"csv_format": ".6g", "display_format": ".1f"},
        error_um={"csv_format": ".6g", "display_format": ".1f"},
        expanded_uncertainty_um={"name": "U_um", "csv_format": ".6g", "display_format": ".1f"},
        pass_probability={"csv_format": ".4g"},
        judgement={"kind": "text"},
    ),
)
"""Columns of `accept.csv`: errors and limits of the acceptance tests."""


TEST_GROUPS_TABLE = Table(
    "groups.csv",
    "summary of the tests of each group",
    model_columns(
        TestGroupSummary,
        name={"name": "group"},
        n_tests={"name": "tests"},
        pass_probability={"title": "all pass", "n_digits": 3},
        judgement={"kind": "text"},
        largest_limit_ratio={"display_format": ".2f"},
    ),
)
"""Columns of `groups.csv`: summary of the tests of each group."""


class InstrumentConstantSensitivity(Entry):
    """Sensitivity of the tests to one instrument constant, while all other instrument constants are zero."""

    name: str
    """Name of the instrument constant."""
    unit: str
    """Unit of `prior_sigma` and `smallest_failing_value`."""
    prior_sigma: Finite
    """Prior standard deviation of the instrument constant from the specification, in `unit`."""
    smallest_failing_value: OptionalFloat
    """Smallest absolute value of the instrument constant at which a test fails, in `unit`; null if no test depends on
    the constant."""
    failing_test: str
    """Name of the test that fails at `smallest_failing_value`."""


class WorstPassingInstrument(Entry):
    """Instrument that passes every test although its point errors are the largest possible."""

    constants: dict[str, Finite]
    """Value of each instrument constant by its name, in the unit that `sensitivities` of `accept.json` lists."""
    rms_point_error_um: Finite
    """Root mean square error [um] of points 1.5 to 9 m around the instrument, after a rigid best fit of all points."""
    largest_point_error_um: Finite
    """Largest error [um] of a point 1.5 to 9 m around the instrument, after the rigid best fit of all points."""


class AcceptanceFile(ResultFile):
    """Result of `accept`, with the content of `accept.json`."""

    FILE: ClassVar[str] = "accept.json"
    COMPANION_TABLES: ClassVar[Mapping[str, Table]] = {"tests": TESTS_TABLE}
    format: Literal["ltsim-accept/1"] = "ltsim-accept/1"
    """Format and version of this file."""
    title: str = ""
    """Title of the acceptance tests, free text."""
    error_origin: Literal["predicted", "measured", "network"]
    """Origin of the test errors: predicted, measured one by one, or taken from a measured network."""
    plan_name: str
    """Name of the standard, or of the file with the tests."""
    specification: Specification
    """Manufacturer's specification with the limits of the tests."""
    sigma_assumption: str = ""
    """Sentence on the assumption by which limits of the specification were converted to standard deviations."""
    pass_probability: OptionalFloat = None
    """Predicted probability that all tests pass; null for measured errors."""
    judgement: Judgement | None = None
    """Judgement of all measured errors by ISO 14253-1: `rejected` if one error is rejected, `accepted` if all are
    accepted and no test of the plan is missing, else `undecided`; null for a prediction."""
    decision_rule: str = ""
    """Rule by which measured errors are judged, and the content of their uncertainties; empty for a prediction."""
    unmeasured_tests: tuple[str, ...] = ()
    """Names of the planned tests without a measured error."""
    sentence: str
    """Result of all tests in one sentence."""
    next_actions: tuple[str, ...] = ()
    """Recommended actions, the most urgent first."""
    groups: tuple[TestGroupSummary, ...] = Field(min_length=1)
    """Summary of the tests of each group."""
    tests: tuple[TestOutcome, ...] = Field(min_length=1)
    """All tests with their errors and limits."""
    sensitivities: tuple[InstrumentConstantSensitivity, ...] = ()
    """Sensitivity of the tests to each instrument constant, one entry per constant."""
    worst_passing_instrument: WorstPassingInstrument | None = None
    """Instrument that passes every test with the largest point errors; null if it was not searched for."""

    def _summary_lines(self) -> list[str]:
        """Line for a terminal: origin of the errors, plan of tests, and result."""
        return [f"Acceptance ({self.error_origin}, {self.plan_name}): {self.sentence}"]

    def _table_makers(self) -> Mapping[str, Callable[[], Table]]:
        """Functions that build the data tables of the result, by name of the table."""
        return {
            "tests": lambda: TESTS_TABLE.with_rows(self.tests),
            "groups": lambda: TEST_GROUPS_TABLE.with_rows(self.groups),
        }


def group_summaries(
    test_outcomes: Sequence[TestOutcome], pass_probability_by_group: Mapping[str, float] | None = None
) -> tuple[TestGroupSummary, ...]:
    """Summaries of the acceptance tests of each group, from the outcomes of all tests.

    `pass_probability_by_group` holds the predicted probability that all tests of a group pass, by name of the group; it
    is None for measured errors.
    """
    predicted = pass_probability_by_group or {}

    def limit_ratio(test_outcome: TestOutcome) -> float:
        """Ratio of the error of a test to its limit; a predicted error is increased by its expanded uncertainty."""
        margin = (test_outcome.expanded_uncertainty_um or 0.0) if predicted else 0.0
        return (abs(test_outcome.error_um) + margin) / test_outcome.limit_um

    by_group = {
        name: [t for t in test_outcomes if t.group == name] for name in dict.fromkeys(t.group for t in test_outcomes)
    }
    return tuple(
        TestGroupSummary(
            name=name,
            n_tests=len(entries),
            pass_probability=predicted.get(name),
            judgement=None if predicted else combined_judgement([t.judgement for t in entries if t.judgement]),
            largest_limit_ratio=max(map(limit_ratio, entries)),
        )
        for name, entries in by_group.items()
    )


def measured_test_outcome(
    test_name: str, test_group: str, error: float, limit: float, expanded_uncertainty: float = float("nan")
) -> TestOutcome:
    """Outcome of a measured test, from its name, group, error [m] and limit [m]; the error is judged by ISO 14253-1.

    `expanded_uncertainty` (95 %) [m] belongs to the error; NaN if it is unknown.
    """
    sizes_um = {
        "error_um": error / MICROMETRE,
        "limit_um": limit / MICROMETRE,
        "expanded_uncertainty_um": expanded_uncertainty / MICROMETRE,
    }
    margin = 0.0 if np.isnan(expanded_uncertainty) else expanded_uncertainty
    is_accepted, is_rejected = abs(error) + margin <= limit, abs(error) - margin > limit
    judgement: Judgement = "accepted" if is_accepted else "rejected" if is_rejected else "undecided"
    return TestOutcome(name=test_name, group=test_group, judgement=judgement, **sizes_um)
