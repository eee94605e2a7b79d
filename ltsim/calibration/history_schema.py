"""history.json: what stands in it, for writers and readers."""

from __future__ import annotations

from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ltsim.calibration.events import Event, events
from ltsim.calibration.history import Change, History
from ltsim.calibration.schema import Fit, NotNegative
from ltsim.recording.result_file import Entry, Finite, Known, ResultFile


class ChiSquareEntry(Entry):
    """A chi-square test."""

    chi2: Finite
    """Weighted sum of squares."""
    dof: int
    """Degrees of freedom."""
    p_value: Finite
    """Chance of as much or more in a correct model."""


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


def history_file(history: History) -> HistoryFile:
    """The content of `history.json`: parameters in the units a person reads, tests as chi-square."""
    factors = np.array([p.factor for p in history.construction.parameters])
    return HistoryFile(
        construction=history.construction.name,
        calibrations=tuple(
            CalibrationOf(label=label, fit=Fit(chi2=c.fit.chi2, dof=c.fit.dof, sigma0=c.fit.sigma0))
            for label, c in zip(history.labels, history.calibrations, strict=True)
        ),
        parameters=tuple(_course(history, k) for k in range(history.construction.size)),
        mean_covariance=(history.population.covariance / np.outer(factors, factors)).tolist(),
        constant=ChiSquareEntry(**history.constancy().entry),
        changes=tuple(_change(history, change) for change in history.changes()),
        events=tuple(_event(history, event) for event in events(history)),
        since_first=_change(history, history.change(0, len(history) - 1)),
    )


def _course(history: History, k: int) -> CourseEntry:
    parameter, known = history.construction.parameters[k], history.population
    return CourseEntry(
        name=parameter.name,
        unit=parameter.unit,
        values=(history.values[:, k] / parameter.factor).tolist(),
        sigmas=(history.sigma[:, k] / parameter.factor).tolist(),
        prior_sigma=history.prior_sigma[k] / parameter.factor,
        mean=known.mean[k] / parameter.factor,
        spread=known.spread[k] / parameter.factor,
        constant=ChiSquareEntry(**history.constancy(k).entry),
    )


def _event(history: History, event: Event) -> EventEntry:
    parameter = history.construction.parameters[event.parameter]
    return EventEntry(
        from_=history.labels[event.step],
        to=history.labels[event.step + 1],
        name=parameter.name,
        difference=event.difference / parameter.factor,
        sigma=event.sigma / parameter.factor,
        usual=event.usual / parameter.factor,
        unit=parameter.unit,
        p_value=event.p_value,
    )


def _change(history: History, change: Change) -> ChangeEntry:
    parameters = history.construction.parameters
    return ChangeEntry(
        from_=change.first,
        to=change.second,
        **change.joint.entry,
        changed=tuple(parameters[k].name for k in change.changed()),
        parameters=tuple(
            DifferenceEntry(
                name=parameter.name,
                difference=change.difference[k] / parameter.factor,
                sigma=change.sigma[k] / parameter.factor,
                unit=parameter.unit,
                p_value=change.p_values[k],
            )
            for k, parameter in enumerate(parameters)
        ),
    )
