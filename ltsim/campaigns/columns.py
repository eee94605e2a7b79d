"""Columns of a campaign's rows: first the levels of the factors, then the results, each with its unit."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from ltsim.campaigns.design import Factor
from ltsim.campaigns.schema import PARAMETER_UNIT_PLACEHOLDER, TRIAL_STATUSES, WITHOUT_RESULT, find_result_column
from ltsim.core.arrays import Floats
from ltsim.core.results import ColumnValues
from ltsim.physics.effects.effect import Effect, Parameter, effect_parameter_names
from ltsim.physics.model.construction import GeometricErrorModel

ResultColumns = dict[str, NDArray[Any]]
"""Result columns of several trials: array (trials,) by column name. The name of a length column contains its unit."""
ARROW_TYPE_BY_VALUE_TYPE = {"number": pa.float64(), "integer": pa.int64(), "boolean": pa.bool_()}
"""Arrow data type of a column, by the type of its values."""


class ParameterLabel(NamedTuple):
    """Label of a parameter of an instrument or effect, which is part of the names of its columns."""

    text: str
    """Text of the label: ``beam-tilt``, ``beam-tilt@NAME`` for several instruments, ``head-sag:sag S2`` for an effect
    at station S2, ``head-sag:sag S2 #2`` for the second such effect there.
    """
    parameter: Parameter
    """Parameter of an instrument or effect."""
    effect: Effect | None = None
    """Effect to which the parameter belongs; None for a parameter of an instrument."""


def parameter_labels(
    construction: GeometricErrorModel, instruments: Sequence[str], effects: Sequence[Effect]
) -> list[ParameterLabel]:
    """Labels of the parameters of all instruments, followed by the parameters of effects."""
    names = construction.instrument_parameter_names(instruments)
    labels = [ParameterLabel(*pair) for pair in zip(names, construction.parameters * len(instruments), strict=True)]
    parameters = [(parameter, effect) for effect in effects for parameter in effect.parameters]
    names_of_effects = effect_parameter_names((e.name, e.place_text, [p.name for p in e.parameters]) for e in effects)
    return labels + [ParameterLabel(name, *pair) for name, pair in zip(names_of_effects, parameters, strict=True)]


def parameter_value_columns(labels: Sequence[ParameterLabel], parameters: Floats, prefix: str) -> ResultColumns:
    """Columns of parameter values, converted to display units, with names such as ``estimate:beam-tilt``.

    `parameters` (parameters, trials) [SI] are the values; `prefix` is the part of the name before the colon.
    """
    return {
        f"{prefix}:{label.text}": row / label.parameter.si_per_display_unit
        for label, row in zip(labels, parameters, strict=True)
    }


def z_score_columns(
    labels: Sequence[ParameterLabel],
    estimates: Floats,
    sigma: Floats,
    true_labels: Sequence[ParameterLabel],
    truths: Floats,
) -> ResultColumns:
    """Columns of z-scores, (estimate - true value) / sigma, of the parameters that have a true value.

    `estimates` and `sigma` (parameters, trials) [SI] belong to the parameters `labels`. `truths` (parameters, trials)
    [SI] are the true values of the parameters `true_labels`.
    """
    true_values = {
        (label.text, label.effect): true_value for label, true_value in zip(true_labels, truths, strict=True)
    }
    with np.errstate(divide="ignore", invalid="ignore"):
        return {
            f"z:{label.text}": (value - true_values[label.text, label.effect]) / spread
            for label, value, spread in zip(labels, estimates, sigma, strict=True)
            if (label.text, label.effect) in true_values
        }


def _column_metadata(name: str, parameters: Mapping[str, str]) -> dict[str, str]:
    """Metadata of a column: its unit and meaning; `parameters` holds the unit of each parameter by its label."""
    column = find_result_column(name)
    if column is None:
        return {"unit": "", "meaning": ""}
    unit = (
        parameters.get(name.partition(":")[2], "") if column.unit == PARAMETER_UNIT_PLACEHOLDER else column.unit or ""
    )
    return {"unit": unit, "meaning": column.meaning}


def append_factor_levels(
    table: pa.Table, factors: Sequence[Factor], level_by_factor: Mapping[str, Any], parameters: Mapping[str, str]
) -> pa.Table:
    """Rows of one cell (combination of factor levels), with its factor levels in the columns after the column `cell`.

    The metadata of the columns contain the units. `parameters` holds the unit of each parameter in the rows, by the
    label of the parameter.
    """
    columns = dict(zip(table.column_names, table.columns, strict=True))
    cell = {"cell": columns.pop("cell")}
    settings = {
        f.name: pa.repeat(
            pa.scalar(level_by_factor[f.name], ARROW_TYPE_BY_VALUE_TYPE.get(f.kind, pa.string())), len(table)
        )
        for f in factors
    }
    metadata = {f.name: {"unit": f.unit, "keys": " ".join(f.keys)} for f in factors}
    all_columns = cell | settings | columns
    fields = [
        pa.field(name, column.type, metadata=metadata.get(name) or _column_metadata(name, parameters))
        for name, column in all_columns.items()
    ]
    return pa.table(list(all_columns.values()), schema=pa.schema(fields))


def method_table(cell: int, method: str, column_groups: list[ResultColumns]) -> pa.Table:
    """Table of the results of a calibration method in the cell (combination of factor levels) number `cell`.

    The rows of `column_groups` (one group per batch of trials) follow each other. Numbers are stored in single
    precision; a value that does not exist is empty.
    """
    names = dict.fromkeys(name for part in column_groups for name in part)
    values_by_column = {
        name: np.concatenate(
            [part[name] if name in part else np.full(len(part["trial"]), np.nan) for part in column_groups]
        )
        for name in names
    }
    order = np.argsort(values_by_column["trial"])
    values_by_column = {name: values[order] for name, values in values_by_column.items()}
    trial, status = values_by_column.pop("trial"), values_by_column.pop("status").astype(np.int64)
    n_trials = len(trial)
    is_lost = status == TRIAL_STATUSES.index(WITHOUT_RESULT)
    columns: dict[str, pa.Array] = {
        "cell": pa.array(np.full(n_trials, cell), pa.int32()),
        "method": pa.array([method] * n_trials, pa.string()),
        "trial": pa.array(trial, pa.int64()),
        "status": pa.array([TRIAL_STATUSES[s] for s in status], pa.string()),
    }
    for name, values in values_by_column.items():
        empty = np.isnan(values) | (is_lost if name.startswith(("z:", "estimate:")) or "after" in name else False)
        columns[name] = pa.array(values.astype(np.float32), pa.float32(), mask=empty)
    return pa.table(columns)


def columns_from_rows(table_rows: Iterable[Mapping[str, Any]]) -> ColumnValues:
    """Values by column name, from rows that are mappings of the same column names to values."""
    columns: dict[str, list[Any]] = {}
    for row in table_rows:
        for name, value in row.items():
            columns.setdefault(name, []).append(value)
    return columns
