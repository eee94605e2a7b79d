"""Results of a campaign: statistics, paired differences from equal random draws, figures, xarray datasets."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ltsim.campaigns.columns import columns_from_rows
from ltsim.campaigns.schema import (
    RATIO_STATISTICS,
    SOLVER_DIFFERENCE_COLUMN,
    find_result_column,
    statistic_sql_expressions,
)
from ltsim.campaigns.statistics import CampaignStatistics
from ltsim.campaigns.summary import StatisticSummary
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError, missing_extra_error, unknown_name_error
from ltsim.core.plotting import plotting_module
from ltsim.core.randomness import random_stream
from ltsim.core.results import ColumnValues, Result
from ltsim.core.units import parse_quantity_in_unit, unit_of_key

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

XARRAY_METHOD_AXIS = "calibrator"
"""Name of the axis of calibration methods in an xarray dataset. The name `method` is not possible, because
`Dataset.sel` has an argument of this name."""
N_BOOTSTRAP_RESAMPLES = 400
"""Number of resamples for a bootstrap interval, whose limits then have a sampling error of a tenth of its width."""
RESERVED_XARRAY_AXIS_NAMES = frozenset({XARRAY_METHOD_AXIS, "indexers", "method", "tolerance", "drop"})
"""Names that an axis of an xarray dataset cannot have. An underscore is added to a factor with such a name."""


class CampaignResults(CampaignStatistics, Result):
    """Results of a campaign: statistics of its rows, paired differences, figures and xarray datasets."""

    def __reduce__(self) -> tuple[type[CampaignResults], tuple[Path]]:
        return CampaignResults, (self.folder.resolve(),)

    def paired_differences(self, statistic: str, **pair: tuple[Any, Any]) -> PairedDifferences:
        """Differences of a statistic between two methods, or two levels of a factor, on the same random draws.

        Parameters
        ----------
        statistic : str
            Column of the rows, or a ratio over all trials such as `share_removed`.
        **pair
            Two methods, ``method=("distance", "network")``, or two levels of a factor, ``faces=(1, 2)``. The difference
            is first minus second, for every combination of levels of the other factors.

        Raises
        ------
        ModelError
            When there is no such statistic, method, factor or level.
        """
        self._sql_column(statistic)
        return paired_differences(self, statistic, **pair)

    def bootstrap_statistic(self, function: Callable[..., float], *columns: str) -> list[StatisticSummary]:
        """Value of a function of the trials for each cell and method, with its 95 % bootstrap confidence interval.

        Parameters
        ----------
        function : callable
            Function of one array (trials,) per column, with values of the same trials, that returns a number. Trials
            without a value in a column are omitted.
        *columns : str
            Columns of the rows.

        Returns
        -------
        list of StatisticSummary
            `mean` is the function of all trials. `low` and `high` are its confidence limits from resampled trials
            (percentile bootstrap). `column` is the name of the function.

        Raises
        ------
        ModelError
            When there is no such column, or the function does not return a number.
        """
        if shares := [column for column in columns if column in RATIO_STATISTICS]:
            raise ModelError(
                f"{shares[0]} is a ratio over all trials, not a column of the rows; call `statistic_summaries`"
            )
        sql_columns = [self._sql_column(column) for column in columns]
        condition_text = " AND ".join(f"isfinite({name})" for name in sql_columns) or "true"
        name = getattr(function, "__name__", type(function).__name__)
        spreads = []
        for cell in range(len(self.levels)):
            for method in sorted(self.manifest.methods):
                values = self.sql_expression_values(sql_columns, cell, method, condition_text)
                count = values.shape[1]
                if not count:
                    continue
                draws = random_stream(0, "bootstrap", cell).integers(count, size=(N_BOOTSTRAP_RESAMPLES, count))
                value = _statistic_value(function, values)
                again = [_statistic_value(function, values[:, draw]) for draw in draws]
                low, high = np.nanquantile(again, [0.025, 0.975]).tolist()
                spread = float(np.nanstd(again, ddof=1))
                interval = {"mean": value, "low": low, "high": high, "standard_deviation": spread}
                spreads.append(StatisticSummary(cell=cell, method=method, column=name, trials=count, **interval))
        return spreads

    def plot(self, statistic: str = "", along: str = "", *, panel: str = "", **levels: Any) -> Figure:
        """Figure of the means of a statistic along a factor, with 95 % intervals and the middle 90 % of the trials.

        Parameters
        ----------
        statistic : str
            Column of the rows, or a ratio over all trials such as `share_removed`; default the statistic of the first
            figure in the campaign's report.
        along, panel : str
            Factor along the horizontal axis, and factor for whose levels the figure has separate panels.
        **levels
            Levels of factors, such as ``faces=1``, or one ``method``, to which the figure is restricted.

        Raises
        ------
        ModelError
            When there is no such statistic or factor.
        """
        if not statistic:
            return super().plot()
        figure: Figure = plotting_module("figures.campaign").sweep_figure(self, statistic, along, panel=panel, **levels)
        return figure

    def to_xarray(self, *statistics: str) -> xr.Dataset:
        """Means over the trials with 95 % confidence intervals, as an xarray dataset.

        Parameters
        ----------
        *statistics : str
            Columns of the rows, or ratios over all trials; default all except columns of single parameters.

        Returns
        -------
        xarray.Dataset
            Each statistic with its confidence limits ``NAME_low`` and ``NAME_high``, and its unit in `attrs`. The axes
            are `calibrator` (the methods) and the factors. If the combinations of factor levels form no full grid, the
            axis `cell` replaces the axes of the factors.

        Raises
        ------
        ModelError, InputError
            When there is no such statistic, or when xarray is not installed.
        """
        try:
            from xarray import Dataset
        except ImportError:
            raise missing_extra_error("datasets with axes", "xarray") from None
        axes, places, along = self._xarray_axes()
        methods = list(self.manifest.methods)
        shape = (len(methods), *(len(axes[name][1]) for name in axes))
        variables: dict[str, Any] = {}
        for name in statistics or [c for c in self.columns if ":" not in c and c != SOLVER_DIFFERENCE_COLUMN]:
            bounds = np.full((3, *shape), np.nan)
            for s in self.statistic_summaries(name):
                for bound, value in zip(bounds, (s.mean, s.low, s.high), strict=True):
                    bound[(methods.index(s.method), *places[s.cell])] = value
            meaning, unit = (column.meaning if (column := find_result_column(name)) else ""), self.units.get(name, "")
            for limit, ending, words in zip(bounds, ("", "_low", "_high"), ("mean", "lower", "upper"), strict=True):
                meaning_of_bound = f"{words} of the trials" if not ending else f"{words} 95 % bound of the mean"
                about = {"units": unit, "long_name": f"{meaning_of_bound}: {meaning}"}
                variables[name + ending] = ((XARRAY_METHOD_AXIS, *axes), limit, about)
        title = {"title": self.manifest.title, "trials": self.manifest.trials}
        return Dataset(variables, {XARRAY_METHOD_AXIS: methods} | axes | along, title)

    def _xarray_axes(self) -> tuple[dict[str, Any], list[tuple[int, ...]], dict[str, Any]]:
        """Values of each axis, position of each cell on the axes, and coordinates along an axis, for an xarray dataset.

        The factors of a full grid are axes. Cells (combinations of factor levels) that form no full grid are on the
        single axis `cell`, with the factor levels as coordinates.
        """
        levels, named = (
            self.levels,
            [(f"{f.name}_" if f.name in RESERVED_XARRAY_AXIS_NAMES else f.name, f) for f in self.factors],
        )
        axes = {name: [level[f.name] for level in levels] for name, f in named}
        steps = {name: _sorted_factor_levels(dict.fromkeys(values)) for name, values in axes.items()}
        unit = {name: {"units": f.unit, "keys": " ".join(f.keys)} for name, f in named}
        places = [tuple(steps[name].index(axes[name][k]) for name in steps) for k in range(len(levels))]
        if math.prod(map(len, steps.values())) == len(levels) == len(set(places)):
            return {name: (name, values, unit[name]) for name, values in steps.items()}, places, {}
        along = {name: ("cell", values, unit[name]) for name, values in axes.items()}
        return {"cell": ("cell", list(range(len(levels))))}, [(k,) for k in range(len(levels))], along


def _statistic_value(function: Callable[..., float], columns: Floats) -> float:
    """Value of the statistic `function` of `columns` (columns, trials); raises ModelError if it is no number."""
    result = np.asarray(function(*columns))
    if result.size != 1 or result.dtype.kind not in "fiub":
        raise ModelError(f"the statistic returns {type(result.tolist()).__name__}, expected one number")
    return float(result.item())


def _sorted_factor_levels(levels: Iterable[Any]) -> list[Any]:
    """Levels in increasing order if all are numbers (an axis can then be sliced), else in their given order."""
    level_list = list(levels)
    return sorted(level_list) if all(isinstance(value, int | float) for value in level_list) else level_list


MAX_FACTOR_LEVEL_ROUNDING_ERROR = 5e-4
"""Largest relative difference between a factor level and a number in a user's request for this level. A request with
three digits is sufficient."""
CellAndMethod = tuple[int, str]
"""Index of a cell (combination of factor levels), from 0, and name of a calibration method."""


@dataclass(frozen=True)
class PairedDifference:
    """Difference of a statistic between two methods or factor levels, first minus second, on equal random draws."""

    shared_levels: Mapping[str, Any]
    """Levels of all factors except the compared one, by name of the factor."""
    first_name: str
    """Name of the first method, or name and first level of the compared factor, such as `faces 2`."""
    second_name: str
    """Name of the second method, or name and second level of the compared factor."""
    statistic: str
    """Name of the statistic."""
    unit: str
    """Unit of the statistic."""
    trials: int
    """Number of trials with a value of the statistic for both methods or levels."""
    difference: float
    """Difference of the means: first minus second method or level."""
    low: float
    """Lower 95 % confidence limit of the difference."""
    high: float
    """Upper 95 % confidence limit of the difference."""

    @property
    def sentence(self) -> str:
        """Sentence with the difference, its confidence interval and the number of trials."""
        place = "".join(f", {name} {value}" for name, value in self.shared_levels.items())
        gap, unit = f"{self.difference:.4g}", f" {self.unit}" if self.unit else ""
        interval = f"95 %: {self.low:.4g} to {self.high:.4g}{unit}"
        names = f"{self.first_name} minus {self.second_name}"
        return f"{self.statistic}, {names}{place}: {gap}{unit} ({interval}; {self.trials} trials)"


@dataclass(frozen=True, repr=False)
class PairedDifferences(Result):
    """Differences of a statistic between two methods or factor levels of a campaign, from the same random draws."""

    entries: tuple[PairedDifference, ...]
    """Paired difference for each combination of levels of the other factors."""

    def _summary_lines(self) -> list[str]:
        return [entry.sentence for entry in self.entries]

    def _table_makers(self) -> Mapping[str, Callable[[], ColumnValues]]:
        rows = [vars(entry) for entry in self.entries]
        flat_rows = [row["shared_levels"] | {k: v for k, v in row.items() if k != "shared_levels"} for row in rows]
        return {"differences": lambda: columns_from_rows(flat_rows)}


def paired_differences(results: CampaignStatistics, statistic: str, **pair: tuple[Any, Any]) -> PairedDifferences:
    """Differences of a statistic between two methods or factor levels, in trials with the same random draws."""
    if len(pair) != 1:
        raise ModelError("give either two methods, method=(A, B), or two levels of one factor")
    ((along, (first, second)),) = pair.items()
    differences = []
    for common, this, other in _comparison_pairs(results, along, first, second):
        values = [_trial_numbers_and_values(results, statistic, *place) for place in (this, other)]
        both = np.isin(values[0][0], values[1][0]), np.isin(values[1][0], values[0][0])
        (mean, scatter), (less, less_scatter) = (
            _mean_and_influence(v[1][:, keep]) for v, keep in zip(values, both, strict=True)
        )
        count, gap = len(scatter), mean - less
        half = (
            results.half_width_of_interval(count, float(np.std(scatter - less_scatter, ddof=1)))
            if count > 1
            else math.inf
        )
        this_name, other_name = (str(k) if along == "method" else f"{along} {k}" for k in (first, second))
        named = this_name, other_name, statistic, results.units.get(statistic, "")
        differences.append(PairedDifference(common, *named, count, gap, gap - half, gap + half))
    return PairedDifferences(tuple(differences))


def _comparison_pairs(
    results: CampaignStatistics, factor_name: str, first_level: Any, second_level: Any
) -> Iterator[tuple[dict[str, Any], CellAndMethod, CellAndMethod]]:
    """Shared factor levels, first cell and method, and second cell and method of each paired comparison.

    The compared factor is `factor_name`, or `method` for two methods. ModelError is raised if there is no such factor,
    method or level.
    """
    methods, levels = results.manifest.methods, results.levels
    factors = [factor.name for factor in results.factors]
    if factor_name not in ("method", *factors):
        raise unknown_name_error("factor of this campaign", factor_name, ("method", *factors))
    choices = list(methods) if factor_name == "method" else [level[factor_name] for level in levels]
    first_level, second_level = (_requested_level(factor_name, level, choices) for level in (first_level, second_level))
    for cell, settings in enumerate(levels):
        if factor_name == "method":
            yield dict(settings), (cell, first_level), (cell, second_level)
        elif settings[factor_name] == first_level and (settings | {factor_name: second_level}) in levels:
            rest = {name: value for name, value in settings.items() if name != factor_name}
            for method in methods:
                several = {"method": method} if len(methods) > 1 else {}
                yield rest | several, (cell, method), (levels.index(settings | {factor_name: second_level}), method)


def _requested_level(factor_name: str, requested_level: Any, levels: Sequence[Any]) -> Any:
    """Level that a user requests by its value, by its text with unit, or by its value rounded to three digits.

    ModelError is raised for a value that is no level, or that may be the rounded value of several levels.
    """
    distinct = list(dict.fromkeys(levels))
    if requested_level in distinct:
        return requested_level
    value = (
        parse_quantity_in_unit(requested_level, unit_of_key(factor_name))
        if isinstance(requested_level, str)
        else requested_level
    )
    if isinstance(value, int | float) and not isinstance(value, bool):
        numbers = [k for k in distinct if isinstance(k, int | float)]
        near = [k for k in numbers if math.isclose(k, value, rel_tol=MAX_FACTOR_LEVEL_ROUNDING_ERROR)]
        if len(near) == 1:
            return near[0]
    raise unknown_name_error(f"level of {factor_name}", str(requested_level), [str(k) for k in distinct])


def _trial_numbers_and_values(
    results: CampaignStatistics, statistic: str, cell: int, method: str
) -> tuple[Floats, Floats]:
    """Trial numbers (trials,) of a combination of factor levels and a method, and values whose means give a statistic.

    `cell` is the index of the combination. The values have the shape (1, trials) for a mean, and (2, trials), numerator
    and denominator, for a ratio of means.
    """
    expressions = statistic_sql_expressions(statistic)
    table = results.sql_expression_values(("trial", *expressions), cell, method, f"{expressions[0]} IS NOT NULL")
    return table[0], table[1:]


def _mean_and_influence(trial_values: Floats) -> tuple[float, Floats]:
    """Mean of `trial_values` or ratio of two means, and the influence of each trial on it (influence function).

    `trial_values` has the shape (1, trials) for a mean and (2, trials) for a ratio; the influence has the shape
    (trials,).
    """
    if len(trial_values) == 1:
        return float(np.mean(trial_values)), trial_values[0]
    ratio = float(trial_values[0].mean() / trial_values[1].mean())
    return ratio, (trial_values[0] - ratio * trial_values[1]) / trial_values[1].mean()
