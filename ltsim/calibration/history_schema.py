"""Schema of history.json."""

from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator
from scipy import special

from ltsim.calibration.schema import Fit
from ltsim.recordings.result_file import Entry, Finite, NotNegative, OptionalFloat, ResultFile


class ChiSquareEntry(Entry):
    """A chi-square test."""

    chi2: Finite
    """Weighted sum of squares."""
    dof: int
    """Degrees of freedom."""
    p_value: Finite
    """p-value: probability of as large a chi-square or larger; 1 without degrees of freedom."""

    @classmethod
    def of(cls, chi2: float, dof: int) -> Self:
        """The test of a statistic."""
        return cls(chi2=chi2, dof=dof, p_value=float(special.chdtrc(dof, max(chi2, 0.0))) if dof else 1.0)


class DifferenceEntry(Entry):
    """Later minus earlier estimate of one parameter."""

    name: str
    """Name of the parameter."""
    difference: Finite
    """Later minus earlier estimate, in `unit`."""
    sigma: Finite
    """Standard deviation of the difference."""
    unit: str
    """Unit of the difference and of its standard deviation."""
    p_value: Finite
    """Two-sided p-value of the difference without a change."""


class ChangeEntry(ChiSquareEntry):
    """Change between two calibrations."""

    from_: str = Field(alias="from")
    """The earlier calibration."""
    to: str
    """The later one."""
    changed: tuple[str, ...] = ()
    """Parameters that differ."""
    parameters: tuple[DifferenceEntry, ...] = ()
    """All differences."""


class CourseEntry(Entry):
    """Course of a parameter over the calibrations, in its display unit."""

    name: str
    """Name of the parameter."""
    unit: str = ""
    """Unit of all numbers of the entry."""
    values: tuple[Finite, ...]
    """Estimates, one a calibration."""
    sigmas: tuple[NotNegative, ...]
    """Standard deviations of the estimates, one a calibration."""
    prior_sigma: OptionalFloat = None
    """Prior standard deviation of the parameter."""
    mean: Finite
    """Weighted mean of the estimates."""
    spread: Finite
    """Standard deviation over the calibrations."""
    constant: ChiSquareEntry
    """Test that it did not change."""


class EventEntry(Entry):
    """A step of one parameter that is an outlier among its steps between calibrations."""

    from_: str = Field(alias="from")
    """The earlier calibration."""
    to: str
    """The later one."""
    name: str
    """Name of the parameter."""
    difference: Finite
    """Later minus earlier."""
    sigma: NotNegative
    """Standard deviation of the difference."""
    usual: NotNegative
    """Standard deviation of its other steps from one calibration to the next, without that of the estimates."""
    unit: str
    """Unit of `difference`, `sigma` and `usual`."""
    p_value: Finite
    """p-value of the step, corrected for all steps and parameters."""


class CalibrationOf(Entry):
    """Calibration of a history."""

    label: str
    """Name of the calibration in the report."""
    fit: Fit
    """Agreement of readings and model."""


class HistoryFile(ResultFile):
    """`history.json`: from `history`."""

    FILE: ClassVar[str] = "history.json"
    format: Literal["ltsim-history/1"] = "ltsim-history/1"
    """Format and version of this file."""
    construction: str = ""
    """Model of the instrument: `misalignment`, `dh` or `ideal`."""
    calibrations: tuple[CalibrationOf, ...] = Field(min_length=1)
    """Calibrations in the order of time."""
    parameters: tuple[CourseEntry, ...] = ()
    """Each over the calibrations."""
    mean_covariance: tuple[tuple[Finite, ...], ...] = ()
    """Covariance of the means, in the parameters' units; combinations that no calibration determines keep the prior."""
    constant: ChiSquareEntry | None = None
    """Test that nothing changed."""
    changes: tuple[ChangeEntry, ...] = ()
    """Changes between successive calibrations."""
    events: tuple[EventEntry, ...] = ()
    """Significant steps; empty also where there are too few calibrations to test them."""
    since_first: ChangeEntry
    """Change between the first and the last calibration."""

    @model_validator(mode="after")
    def _values_match_calibrations(self) -> Self:
        count = len(self.calibrations)
        for course in self.parameters:
            if len(course.values) != count or len(course.sigmas) != count:
                raise ValueError(f"the parameter {course.name} has not one value and one sigma a calibration")
        return self
