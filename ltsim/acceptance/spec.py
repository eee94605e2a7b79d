"""An acceptance file (ltsim-acceptance/1): which tests, what the maker permits, what is known of the instrument."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from ltsim.acceptance.tests import LENGTHS_OPEN, Standard, Test, builtin, read_tests
from ltsim.errors import ModelError, SetupError, as_setup_error
from ltsim.recording.settings import checked, read_toml
from ltsim.recording.setup import Positive, TomlSection
from ltsim.recording.specification import Specification, completed, sheet

MOST = 10_000_000


class Acceptance(TomlSection):
    """The whole file. Names of other files are seen from this one.

    Without a `recording` or `measured` the tests are predicted: for the instrument of a `calibration`, or for any
    instrument of the specification. With `measured` they are judged; with a `recording` its own network takes the place
    of calibrated lengths.
    """

    format: Literal["ltsim-acceptance/1"] = "ltsim-acceptance/1"
    """Which format and version this file is in."""
    title: str = ""
    """Free text."""
    standard: Standard | None = None
    """A built-in plan of tests."""
    lengths: str | None = None
    """Tests beside the built-in ones: a CSV with a row a test; `iso-10360-10` needs its lengths there."""
    tests: str | None = None
    """A plan of one's own in place of a built-in one: a CSV with a row a test."""
    instrument: str | None = None
    """A built-in data sheet."""
    specification: Specification | None = None
    """The maker's limits in place of it; with an `instrument`, what the sheet leaves open or states otherwise."""
    construction: Literal["source-in-head", "steering-mirror"] = "source-in-head"
    """Where the beam comes from."""
    height_mm: Positive = 1500.0
    """Of the instrument's head above the floor: two-face tests stand on the floor and at twice that height."""
    ranges_m: Annotated[tuple[Positive, ...], Field(min_length=2)] = (2.0, 6.0, 12.0, 18.0, 24.0, 30.0)
    """Lengths along the line of sight go from the first to each of the others."""
    calibration: str | None = None
    """What is known of the instrument: a `calibration.json` or its folder."""
    corrected: bool = False
    """The calibration is applied before the tests, so that its uncertainty remains."""
    recording: str | None = None
    """A network that the instrument measured: its own targets are the reference lengths."""
    measured: str | None = None
    """Errors that were found: a CSV with the columns test, error_um and U_um (may be empty)."""
    trials: Annotated[int, Field(ge=1000, le=MOST)] = 20_000
    """Draws behind the chance to pass."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Root of the draws."""

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.instrument is None and self.specification is None:
            raise ValueError("it should give instrument or the table [specification]")
        if self.recording is None and (self.standard is None) == (self.tests is None):
            raise ValueError("it should give either standard or tests")
        if self.standard == LENGTHS_OPEN and self.lengths is None:
            raise ValueError("it should give lengths = FILE: no open text says where those of iso-10360-10 stand")
        if self.lengths is not None and self.standard is None:
            raise ValueError("it should give lengths beside a standard only; tests holds a whole plan")
        if self.recording is not None and self.measured is not None:
            raise ValueError("it should give recording or measured, not both")
        return self

    @property
    def limits(self) -> Specification:
        """The maker's limits; raises SetupError when no built-in data sheet has the name, or it leaves one open."""
        if self.specification is not None:
            return self.specification
        try:
            return sheet(self.instrument or "")
        except ModelError as problem:
            raise SetupError(str(problem)) from None

    @property
    def plan(self) -> str:
        """What the tests are called: the standard, or the file of tests."""
        return self.tests or self.standard or ""

    def plan_of(self, folder: Path) -> tuple[Test, ...]:
        """The tests, by files that lie in (or are named from) `folder`, or by the standard; raises SetupError."""
        if self.standard is None:
            return tuple(read_tests(folder / (self.tests or "")))
        further = [] if self.lengths is None else read_tests(folder / self.lengths)
        return (*builtin(self.standard, self.height_mm / 1000, self.ranges_m), *further)


def load_acceptance(path: Path) -> Acceptance:
    """The contents of an acceptance file; raises SetupError."""
    with as_setup_error():
        data = read_toml(path, "acceptance file")
    return acceptance_from(data, path)


def acceptance_from(data: Mapping[str, Any], file: object) -> Acceptance:
    """Check the tables of an acceptance file; `file` is named in errors (raises SetupError)."""
    name, stated = data.get("instrument"), data.get("specification", {})
    if isinstance(name, str) and isinstance(stated, Mapping):
        try:
            data = {**data, "specification": completed(name, stated)}
        except ModelError as problem:
            raise SetupError(f"{file}: {problem}") from None
    with as_setup_error():
        return checked(data, Acceptance, "acceptance file", file)
