"""accept.json and accept.csv: what acceptance tests will find, or found."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from ltsim.acceptance.judged import Found
from ltsim.acceptance.prediction import Plan, Prediction, Worst
from ltsim.arrays import Floats
from ltsim.recording.recording import Recording
from ltsim.recording.result_file import Entry, Finite, Known, ResultFile, SourceEntry, write_result
from ltsim.recording.specification import Specification
from ltsim.results import Result, Table, columns_of
from ltsim.units import MICROMETRE


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


def predicted(
    plan: Plan, found: Prediction, worst: Worst, prior: Floats, *, title: str, name: str, of: str
) -> AcceptanceFile:
    """What tests will find, for the instrument that `of` names."""
    size = np.hypot(found.errors[:, 0], found.errors[:, 1])
    signed = np.where(plan.is_length, found.errors[:, 0], size)
    expanded = 2 * np.sqrt(np.sum(found.sigma**2, axis=1))
    tests = tuple(
        TestEntry(name=t.name, group=t.group, limit_um=limit, error_um=e, expanded_um=u, passes=float(p))
        for t, limit, e, u, p in zip(
            plan.tests,
            *(np.asarray(x) / MICROMETRE for x in (plan.limits, signed, expanded)),
            found.passes,
            strict=True,
        )
    )
    smallest, first = plan.smallest_failing()
    parameters = plan.construction.parameters
    sensitivities = tuple(
        SensitivityEntry(
            name=p.name,
            unit=p.unit,
            prior_sigma=float(prior[k] / p.factor),
            smallest_failing=float(smallest[k] / p.factor),
            test=first[k].name if np.isfinite(smallest[k]) else "",
        )
        for k, p in enumerate(parameters)
    )
    chance = f"{100 * found.all_pass:.1f} %" if found.all_pass < 0.9995 else "more than 99.9 %"
    weakest = min(zip(found.passes, plan.tests, strict=True), key=lambda pair: pair[0])
    sentence = f"{of} passes all {len(tests)} tests with a chance of {chance}"
    if weakest[0] < 0.9995:
        sentence += f"; the hardest is {weakest[1].name} ({100 * weakest[0]:.1f} %)"
    return AcceptanceFile(
        title=title,
        kind="predicted",
        plan=name,
        specification=plan.specification,
        assumption=plan.specification.assumption,
        passes=found.all_pass,
        sentence=sentence,
        groups=_groups(tests, found.group_passes, predicted=True),
        tests=tests,
        sensitivities=sensitivities,
        worst_passing=WorstEntry(
            constants={p.name: float(v / p.factor) for p, v in zip(parameters, worst.values, strict=True)},
            rms_um=worst.rms / MICROMETRE,
            largest_um=worst.largest / MICROMETRE,
        ),
    )


def judged(
    errors: Sequence[Found],
    specification: Specification,
    *,
    title: str,
    name: str,
    left: int = 0,
    recording: Recording | None = None,
) -> AcceptanceFile:
    """Errors that were found, against their limits; `left` tests of the plan have none."""
    tests = tuple(
        TestEntry(
            name=e.name,
            group=e.group,
            limit_um=e.limit / MICROMETRE,
            error_um=e.error / MICROMETRE,
            expanded_um=e.expanded / MICROMETRE,
            passes=float(e.passed),
        )
        for e in errors
    )
    groups = {t.group: float(all(o.passes for o in tests if o.group == t.group)) for t in tests}
    failed = sorted((e for e in errors if not e.passed), key=lambda e: e.limit / max(abs(e.error), 1e-12))
    blunt = sum(not e.sharp for e in errors)
    if failed:
        w = failed[0]
        sentence = (
            f"{len(failed)} of {len(errors)} errors are over their limits; the worst is {w.name}: "
            f"{w.error / MICROMETRE:.1f} um where {w.limit / MICROMETRE:.1f} um are permitted"
        )
    else:
        sentence = f"all {len(errors)} errors are within their limits"
    if left:
        sentence += f"; {left} tests of the plan were not measured"
    if blunt:
        sentence += (
            f"; for {blunt} the uncertainty is more than a quarter of the limit, too much to judge by them alone"
        )
    content = AcceptanceFile(
        title=title,
        kind="measured" if recording is None else "network",
        plan=name,
        specification=specification,
        passes=float(not failed and not left),
        sentence=sentence,
        groups=_groups(tests, groups, predicted=False),
        tests=tests,
    )
    return content if recording is None else content.model_copy(update={"recording": SourceEntry.of(recording)})


def _groups(tests: Sequence[TestEntry], passes: dict[str, float], *, predicted: bool) -> tuple[GroupEntry, ...]:
    shares = {name: [_share(t, predicted=predicted) for t in tests if t.group == name] for name in passes}
    return tuple(
        GroupEntry(name=name, tests=len(shares[name]), passes=p, largest_share=max(shares[name]))
        for name, p in passes.items()
    )


def _share(test: TestEntry, *, predicted: bool) -> float:
    margin = test.expanded_um or 0.0 if predicted else 0.0
    return (abs(test.error_um) + margin) / test.limit_um


def passes_words(content: AcceptanceFile, chance: float) -> str:
    """A chance to pass, or whether errors that were found keep their limits."""
    return f"{100 * chance:.1f} %" if content.kind == "predicted" else "yes" if chance == 1 else "no"


def write_acceptance(content: AcceptanceFile, folder: Path) -> AcceptanceFile:
    """Write accept.json and accept.csv (a row a test) into a folder; give what was written.

    Raises
    ------
    RecordError
        When the folder cannot be written; nothing half-written stays behind.
    """
    return write_result(folder, content, {TESTS.file: content.table("tests").csv()})
