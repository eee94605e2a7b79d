"""History of an instrument: result of `history` with its parameters in successive calibrations, and their changes."""

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from ltsim.adjustment.significance import FAMILY_WISE_LEVEL
from ltsim.calibration.calibration_series import CalibrationSeries, ChangeEntry, ChiSquareEntry
from ltsim.calibration.events import EventEntry, significant_parameter_steps
from ltsim.calibration.schema import FitEntry
from ltsim.core.errors import ModelError
from ltsim.core.notation import names_text
from ltsim.core.probability import p_value_relation_text
from ltsim.core.results import Column, ColumnValues, Table, model_columns, text_columns
from ltsim.recordings.result_file import Entry, Finite, NotNegative, OptionalFloat, ResultFile


class ParameterHistory(Entry):
    """Values of one parameter in successive calibrations, in its display unit, with their mean and constancy test."""

    name: str
    """Name of the parameter."""
    unit: str = ""
    """Unit of all numbers of the entry."""
    values: tuple[Finite, ...]
    """Estimates of the parameter, one per calibration."""
    sigmas: tuple[NotNegative, ...]
    """Standard deviations of the estimates, one per calibration."""
    prior_sigma: OptionalFloat = None
    """Prior standard deviation of the parameter."""
    mean: Finite
    """Weighted mean of the estimates of all calibrations."""
    between_calibration_sigma: Finite
    """Standard deviation of the true value between calibrations; estimation errors are not included."""
    constancy_test: ChiSquareEntry
    """Chi-square test that the parameter is the same in all calibrations."""


class HistoryCalibration(Entry):
    """Calibration in a history: its label and its fit statistics."""

    label: str
    """Name of the calibration in the report."""
    fit: FitEntry
    """Fit statistics of the calibration: chi-square, sigma0 and p-value."""


INSTRUMENT_CHANGES_TABLE = Table(
    "changes.csv",
    "changes of an instrument between its calibrations",
    (
        *text_columns(
            **{"from": "the earlier calibration"}, to="the later calibration", above_all="parameters that differ"
        ),
        Column("chi2", "weighted sum of squares of the differences", display_format=".1f"),
        Column("parameters", "degrees of freedom"),
        Column("p_value", "p-value of the test that the instrument did not change", "p_value", title="p"),
    ),
)
PARAMETER_HISTORIES_TABLE = Table(
    "parameters.csv",
    "parameters that the calibrations determine",
    (
        *text_columns(parameter="name"),
        Column("last", "estimate of the last calibration", sigma_column="sigma_last"),
        Column("sigma_last", "standard deviation of this estimate"),
        *text_columns(unit="unit of all numbers in the row"),
        Column("mean", "weighted mean of the estimates", n_digits=3),
        Column("spread", "standard deviation between calibrations, without estimation errors", n_digits=3),
        Column("p_constant", "p-value of the test that the parameter did not change", "p_value"),
    ),
)
CALIBRATION_FITS_TABLE = Table(
    "fits.csv",
    "fit statistics of each calibration",
    (
        *text_columns(calibration="label"),
        Column("chi2", "weighted sum of squared residuals", n_digits=3),
        Column("degrees_of_freedom", "degrees of freedom of the fit"),
        Column("sigma0", "standard deviation of unit weight", n_digits=3),
    ),
)
EVENTS_TABLE = Table(
    "events.csv",
    "changes of parameters between successive calibrations that are outliers among the changes of the same parameter",
    model_columns(
        EventEntry,
        "from_ to name difference sigma usual_step_sigma unit p_value",
        from_={"name": "from"},
        name={"name": "parameter"},
        difference={"name": "step", "sigma_column": "sigma"},
        usual_step_sigma={"name": "usual_step"},
        p_value={"kind": "p_value", "title": "p"},
    ),
)


class History(ResultFile):
    """History of an instrument: result of `history`, with the content of `history.json`."""

    FILE: ClassVar[str] = "history.json"
    FURTHER_FILES: ClassVar[tuple[str, ...]] = ("history.svg",)
    format: Literal["ltsim-history/1"] = "ltsim-history/1"
    """Name and version of the file format."""
    construction: str = ""
    """Name of the geometric error model: `misalignment`, `dh`, `steering-mirror` or `ideal`."""
    calibrations: tuple[HistoryCalibration, ...] = Field(min_length=1)
    """Calibrations in chronological order."""
    parameters: tuple[ParameterHistory, ...] = ()
    """Values of each parameter over the calibrations."""
    mean_covariance: tuple[tuple[Finite, ...], ...] = ()
    """Covariance of the mean parameters, in their units. Combinations that no calibration determines have their prior
    variance."""
    constancy_test: ChiSquareEntry | None = None
    """Chi-square test that no parameter changed; null if it cannot be computed."""
    changes: tuple[ChangeEntry, ...] = ()
    """Changes between successive calibrations."""
    events: tuple[EventEntry, ...] = ()
    """Significant changes of parameters between successive calibrations; empty also if there are too few
    calibrations for a test."""
    change_since_first: ChangeEntry
    """Change between the first and the last calibration."""
    _series: CalibrationSeries | None = PrivateAttr(None)

    @classmethod
    def from_series(cls, series: CalibrationSeries) -> Self:
        """History of a series of calibrations, with the parameters in display units."""
        factors = np.array([p.si_per_display_unit for p in series.construction.parameters])
        result = cls(
            construction=series.construction.name,
            calibrations=tuple(
                HistoryCalibration(label=label, fit=FitEntry(chi2=c.fit.chi2, dof=c.fit.dof, sigma0=c.fit.sigma0))
                for label, c in zip(series.labels, series.calibrations, strict=True)
            ),
            parameters=tuple(_parameter_history(series, k) for k in range(series.construction.n_parameters)),
            mean_covariance=(series.population.covariance / np.outer(factors, factors)).tolist(),
            constancy_test=series.constancy_test(),
            changes=tuple(series.successive_changes()),
            events=significant_parameter_steps(series),
            change_since_first=series.change_between(0, len(series) - 1),
        )
        result._series = series
        return result

    @property
    def series(self) -> CalibrationSeries:
        """Calibrations of the history as arrays; raises ModelError for a history that was read from a file."""
        if self._series is None:
            raise ModelError("a history read from a file has no calibrations; call lt.history with them")
        return self._series

    @property
    def labels(self) -> list[str]:
        """Labels of the calibrations in chronological order."""
        return [calibration.label for calibration in self.calibrations]

    @property
    def determined_parameters(self) -> list[ParameterHistory]:
        """Parameters that at least two calibrations determine, so that their constancy can be tested."""
        return [course for course in self.parameters if course.constancy_test.dof]

    def _summary_lines(self) -> list[str]:
        since, labels = self.change_since_first, self.labels
        return [
            f"History: {len(labels)} calibrations, {labels[0]} to {labels[-1]}",
            f"first to last calibration: chi2 {since.chi2:.1f}/{since.dof}, {p_value_relation_text(since.p_value)}",
        ]

    def _table_makers(self) -> Mapping[str, Callable[[], Table | ColumnValues]]:
        return {
            "values": lambda: self._table_by_calibration([course.values for course in self.parameters]),
            "sigmas": lambda: self._table_by_calibration([course.sigmas for course in self.parameters]),
            "changes": self._changes_table,
            "events": lambda: EVENTS_TABLE.with_rows(self.events),
            "parameters": self._parameters_table,
            "fits": lambda: CALIBRATION_FITS_TABLE.with_rows(
                [c.label, c.fit.chi2, c.fit.dof, c.fit.sigma0] for c in self.calibrations
            ),
        }

    def _table_by_calibration(self, values_by_parameter: Sequence[tuple[float, ...]]) -> ColumnValues:
        """Table with a row per calibration and a column per parameter, from the values of each parameter."""
        columns = {
            f"{p.name} [{p.unit}]": list(column) for p, column in zip(self.parameters, values_by_parameter, strict=True)
        }
        return {"label": self.labels, **columns}

    def _changes_table(self) -> Table:
        """Table of changes from each calibration to the next, and from the first to the last."""
        candidates = [*self.changes, self.change_since_first] if len(self.changes) > 1 else [self.change_since_first]
        return INSTRUMENT_CHANGES_TABLE.with_rows(
            [
                c.from_,
                c.to,
                names_text(c.changed_parameters) or ("no single parameter" if c.p_value < FAMILY_WISE_LEVEL else ""),
                c.chi2,
                c.dof,
                c.p_value,
            ]
            for c in candidates
        )

    def _parameters_table(self) -> Table:
        return PARAMETER_HISTORIES_TABLE.with_rows(
            [p.name, p.values[-1], p.sigmas[-1], p.unit, p.mean, p.between_calibration_sigma, p.constancy_test.p_value]
            for p in self.determined_parameters
        )

    @model_validator(mode="after")
    def _values_match_calibrations(self) -> Self:
        n_calibrations = len(self.calibrations)
        for course in self.parameters:
            if len(course.values) != n_calibrations or len(course.sigmas) != n_calibrations:
                raise ValueError(f"the parameter {course.name} needs one value and one sigma per calibration")
        return self


def _parameter_history(series: CalibrationSeries, parameter_index: int) -> ParameterHistory:
    """Values of the parameter with the index `parameter_index` over a series of calibrations, in its display unit."""
    parameter, population = series.construction.parameters[parameter_index], series.population
    return ParameterHistory(
        name=parameter.name,
        unit=parameter.unit,
        values=(series.estimates[:, parameter_index] / parameter.si_per_display_unit).tolist(),
        sigmas=(series.sigma[:, parameter_index] / parameter.si_per_display_unit).tolist(),
        prior_sigma=series.prior_sigma[parameter_index] / parameter.si_per_display_unit,
        mean=population.mean[parameter_index] / parameter.si_per_display_unit,
        between_calibration_sigma=population.between_calibration_sigma[parameter_index] / parameter.si_per_display_unit,
        constancy_test=series.constancy_test(parameter_index),
    )
