"""history.json: what stands in it, for writers and readers."""

from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator
from scipy import special

from ltsim.calibration.schema import Fit
from ltsim.recordings.result_file import Entry, Finite, Known, NotNegative, ResultFile


class ChiSquareEntry(Entry):
    """A chi-square test."""

    chi2: Finite
    """Weighted sum of squares."""
    dof: int
    """Degrees of freedom."""
    p_value: Finite
    """Chance of as much or more in a correct model; 1 without degrees of freedom."""

    @classmethod
    def of(cls, chi2: float, dof: int) -> Self:
        """The test of a statistic."""
        return cls(chi2=chi2, dof=dof, p_value=float(special.chdtrc(dof, max(chi2, 0.0))) if dof else 1.0)


class DifferenceEntry(Entry):
    """Later minus earlier estimate of one parameter."""

    name: str
    """Its name."""
    difference: Finite
    """Later minus earlier."""
    sigma: Finite
    """Of the difference."""
    unit: str
    """Of both."""
    p_value: Finite
    """Chance of as much or more in a correct model."""


class ChangeEntry(ChiSquareEntry):
    """From one calibration to another."""

    from_: str = Field(alias="from")
    """The earlier calibration."""
    to: str
    """The later one."""
    changed: tuple[str, ...] = ()
    """Parameters that differ."""
    parameters: tuple[DifferenceEntry, ...] = ()
    """All differences."""


class CourseEntry(Entry):
    """One parameter over the calibrations, in the unit a person reads."""

    name: str
    """Its name."""
    unit: str = ""
    """Of all its numbers."""
    values: tuple[Finite, ...]
    """One a calibration."""
    sigmas: tuple[NotNegative, ...]
    """One a calibration."""
    prior_sigma: Known = None
    """What was known before."""
    mean: Finite
    """Weighted."""
    spread: Finite
    """Standard deviation over the calibrations."""
    constant: ChiSquareEntry
    """Test that it did not change."""


class EventEntry(Entry):
    """A step of one parameter that stands out of how it moves from one calibration to the next."""

    from_: str = Field(alias="from")
    """The earlier calibration."""
    to: str
    """The later one."""
    name: str
    """Of the parameter."""
    difference: Finite
    """Later minus earlier."""
    sigma: NotNegative
    """Of the difference."""
    usual: NotNegative
    """How far it moves from one calibration to the next otherwise."""
    unit: str
    """Of all three."""
    p_value: Finite
    """Chance of as much without a step."""


class CalibrationOf(Entry):
    """One calibration of a history."""

    label: str
    """What the report calls it."""
    fit: Fit
    """Agreement of readings and model."""


class HistoryFile(ResultFile):
    """`history.json`: from `history`."""

    FILE: ClassVar[str] = "history.json"
    format: Literal["ltsim-history/1"] = "ltsim-history/1"
    """Which format and version this file is in."""
    construction: str = ""
    """Which model of the instrument."""
    calibrations: tuple[CalibrationOf, ...]
    """In the order of time."""
    parameters: tuple[CourseEntry, ...] = ()
    """Each over the calibrations."""
    mean_covariance: tuple[tuple[Finite, ...], ...] = ()
    """Of the means, in the parameters' units; combinations that no calibration tells stay as the prior has them."""
    constant: ChiSquareEntry | None = None
    """Test that nothing changed."""
    changes: tuple[ChangeEntry, ...] = ()
    """From each to the next."""
    events: tuple[EventEntry, ...] = ()
    """Steps that stand out; empty too where there are too few calibrations to tell."""
    since_first: ChangeEntry
    """From the first to the last."""

    @model_validator(mode="after")
    def _one_value_a_calibration(self) -> Self:
        count = len(self.calibrations)
        for course in self.parameters:
            if len(course.values) != count or len(course.sigmas) != count:
                raise ValueError(f"the parameter {course.name} has not one value and one sigma a calibration")
        return self
