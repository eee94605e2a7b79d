"""accept.json and accept.csv: what acceptance tests will find, or found."""

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Literal

from ltsim.core.results import Result, Table, columns_of
from ltsim.recordings.result_file import Entry, Finite, Known, ResultFile
from ltsim.recordings.specification import Specification


class TestEntry(Entry):
    """One test."""

    __test__ = False

    name: str
    """Of the test."""
    group: str
    """Lengths of one position, two-face tests, ..."""
    limit_um: Finite
    """What the maker permits."""
    error_um: Finite
    """Expected or found; of a two-face test the distance across the beam."""
    expanded_um: Known = None
    """Its uncertainty for 95 %; null where nobody said it."""
    passes: Finite
    """Chance to keep the limit; 1 or 0 for an error that was found."""


class GroupEntry(Entry):
    """The tests of one group."""

    name: str
    """Of the group."""
    tests: int
    """How many."""
    passes: Finite
    """Chance that all keep their limits; 1 or 0 where errors were found."""
    largest_share: Finite
    """Largest error over its limit; of a prediction the error and its uncertainty together."""


TESTS = Table(
    "accept.csv",
    "tests against the maker's limits",
    columns_of(
        TestEntry,
        name={"name": "test"},
        limit_um={"form": ".6g", "shown": ".1f"},
        error_um={"form": ".6g", "shown": ".1f"},
        expanded_um={"name": "U_um", "form": ".6g", "shown": ".1f"},
        passes={"form": ".4g"},
    ),
)


GROUPS = Table("groups.csv", "tests by group", columns_of(GroupEntry, name={"name": "group"}))


class SensitivityEntry(Entry):
    """What one constant of the instrument does to the tests, alone."""

    name: str
    """Of the constant."""
    unit: str
    """Of both sizes."""
    prior_sigma: Finite
    """How large it usually is, by the specification."""
    smallest_failing: Known
    """Size at which it fails a test; null where no test sees it."""
    test: str
    """The test that it fails first."""


class WorstEntry(Entry):
    """The instrument that harms points around it most and passes every test."""

    constants: dict[str, Finite]
    """Its constants in the units of the sensitivities."""
    rms_um: Finite
    """Error of points around it, 1.5 to 9 m away, after a best fit: root mean square."""
    largest_um: Finite
    """The largest of them."""


class AcceptanceFile(ResultFile, Result):
    """`accept.json`: from `accept`."""

    FILE: ClassVar[str] = "accept.json"
    format: Literal["ltsim-accept/1"] = "ltsim-accept/1"
    """Which format and version this file is in."""
    title: str = ""
    """Free text."""
    kind: Literal["predicted", "measured", "network"]
    """Whether the tests were predicted, measured, or taken from a network."""
    plan: str
    """The standard, or the file of tests."""
    specification: Specification
    """The maker's limits."""
    assumption: str = ""
    """How limits became standard deviations."""
    passes: Finite
    """Chance to pass every test; 1 or 0 where errors were found."""
    sentence: str
    """The answer."""
    groups: tuple[GroupEntry, ...]
    """Tests by group."""
    tests: tuple[TestEntry, ...]
    """All of them."""
    sensitivities: tuple[SensitivityEntry, ...] = ()
    """What each constant of the instrument does."""
    worst_passing: WorstEntry | None = None
    """What the tests are blind to."""

    __repr__ = __str__ = Result.__repr__

    def _lines(self) -> list[str]:
        return [f"Acceptance ({self.kind}, {self.plan}): {self.sentence}"]

    def _tables(self) -> Mapping[str, Callable[[], Table]]:
        return {"tests": lambda: TESTS.filled(self.tests), "groups": lambda: GROUPS.filled(self.groups)}


def group_entries(
    tests: Sequence[TestEntry], passes: Mapping[str, float], *, predicted: bool
) -> tuple[GroupEntry, ...]:
    """The tests by group; of a prediction the uncertainty of an error counts with it."""

    def share(test: TestEntry) -> float:
        margin = (test.expanded_um or 0.0) if predicted else 0.0
        return (abs(test.error_um) + margin) / test.limit_um

    shares = {name: [share(t) for t in tests if t.group == name] for name in passes}
    return tuple(
        GroupEntry(name=name, tests=len(shares[name]), passes=p, largest_share=max(shares[name]))
        for name, p in passes.items()
    )


def passes_words(content: AcceptanceFile, chance: float) -> str:
    """A chance to pass, or whether errors that were found keep their limits."""
    return f"{100 * chance:.1f} %" if content.kind == "predicted" else "yes" if chance == 1 else "no"
