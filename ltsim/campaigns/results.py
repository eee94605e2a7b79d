"""Results of a campaign: statistics, differences on common draws, figures, arrays."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ltsim.campaigns.paired import PairedDifferences, paired_differences
from ltsim.campaigns.schema import DIFFERENCE_COLUMN, RATIO_STATISTICS, find_column
from ltsim.campaigns.statistics import CampaignStatistics, StatisticSummary
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError, missing_extra
from ltsim.core.plotting import plotting_module
from ltsim.core.randomness import stream
from ltsim.core.results import Result

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

METHOD_AXIS = "calibrator"
"""Name of the axis of methods in an xarray dataset, where `method` is already an argument of `sel`."""
N_BOOTSTRAP_RESAMPLES = 400
"""Number of resamples of a bootstrap interval; its limits then have a sampling error of about a tenth of its width."""
RESERVED_AXIS_NAMES = frozenset({METHOD_AXIS, "indexers", "method", "tolerance", "drop"})
"""Names that an axis of a factor cannot have; an underscore is then appended."""


class CampaignResults(CampaignStatistics, Result):
    """Results of a campaign: statistics of its rows, paired differences, figures and arrays."""

    def __reduce__(self) -> tuple[type[CampaignResults], tuple[Path]]:
        return CampaignResults, (self.folder.resolve(),)

    def paired_differences(self, statistic: str, **pair: tuple[Any, Any]) -> PairedDifferences:
        """Differences of a statistic between two methods, or two levels of a factor, on the same draws.

        Parameters
        ----------
        statistic : str
            A column of the rows, or a share.
        **pair
            Either ``method=("distance", "network")``, or a factor with two of its levels, ``faces=(1, 2)``: first minus
            second, for every combination of the other settings.

        Raises
        ------
        ModelError
            When there is no such statistic, method, factor or level.
        """
        self._sql_column(statistic)
        return paired_differences(self, statistic, **pair)

    def statistic(self, function: Callable[..., float], *columns: str) -> list[StatisticSummary]:
        """Statistic that a function defines, over the trials of every cell and method, with its 95 % interval.

        Parameters
        ----------
        function : callable
            Function of one array (n,) per column, with the values of the same n trials, that returns a number. Trials
            without a value in a column are omitted.
        *columns : str
            Columns of the rows.

        Returns
        -------
        list of Spread
            `mean` is the statistic of all trials, `low` and `high` its interval by resampling the trials (percentile
            bootstrap), `column` the name of the function.

        Raises
        ------
        ModelError
            When there is no such column, or the function does not return a number.
        """
        if shares := [column for column in columns if column in RATIO_STATISTICS]:
            raise ModelError(f"{shares[0]} is a ratio over all trials and no column of the rows; use `spread`")
        sql_columns = [self._sql_column(column) for column in columns]
        condition_text = " AND ".join(f"isfinite({name})" for name in sql_columns) or "true"
        name = getattr(function, "__name__", type(function).__name__)
        spreads = []
        for cell in range(len(self.levels)):
            for method in sorted(self.manifest.methods):
                values = self.term_values(sql_columns, cell, method, condition_text)
                count = values.shape[1]
                if not count:
                    continue
                draws = stream(0, "bootstrap", cell).integers(count, size=(N_BOOTSTRAP_RESAMPLES, count))
                value = _checked_number(function, values)
                again = [_checked_number(function, values[:, draw]) for draw in draws]
                low, high = np.nanquantile(again, [0.025, 0.975]).tolist()
                spreads.append(
                    StatisticSummary(cell, method, name, count, value, low, high, float(np.nanstd(again, ddof=1)))
                )
        return spreads

    def plot(self, statistic: str = "", along: str = "", *, panel: str = "", **levels: Any) -> Figure:
        """Figure of the means of a statistic along a factor, with 95 % intervals and the middle 90 % of the trials.

        Parameters
        ----------
        statistic : str
            A column of the rows, or a share; without one it is what the campaign's page shows first.
        along, panel : str
            The factor of the axis; one that has a panel a level.
        **levels
            Only the cells with these levels, ``faces=1``, or one ``method``.

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
            Columns of the rows, or shares; default all but those of single parameters.

        Returns
        -------
        xarray.Dataset
            Each statistic with ``NAME_low`` and ``NAME_high``, its unit in `attrs`; axes are `calibrator` (the methods)
            and the factors, or `cell` with the factors along it where the cells are no grid.

        Raises
        ------
        ModelError, SetupError
            When there is no such statistic; without xarray.
        """
        try:
            from xarray import Dataset
        except ImportError:
            raise missing_extra("datasets with axes", "xarray") from None
        axes, places, along = self._xarray_axes()
        methods = list(self.manifest.methods)
        shape = (len(methods), *(len(axes[name][1]) for name in axes))
        variables: dict[str, Any] = {}
        for name in statistics or [c for c in self.columns if ":" not in c and c != DIFFERENCE_COLUMN]:
            bounds = np.full((3, *shape), np.nan)
            for s in self.distribution(name):
                for bound, value in zip(bounds, (s.mean, s.low, s.high), strict=True):
                    bound[(methods.index(s.method), *places[s.cell])] = value
            meaning, unit = (column.meaning if (column := find_column(name)) else ""), self.units.get(name, "")
            for limit, ending, words in zip(bounds, ("", "_low", "_high"), ("mean", "lower", "upper"), strict=True):
                meaning_of_bound = f"{words} of the trials" if not ending else f"{words} 95 % bound of the mean"
                about = {"units": unit, "long_name": f"{meaning_of_bound}: {meaning}"}
                variables[name + ending] = ((METHOD_AXIS, *axes), limit, about)
        title = {"title": self.manifest.title, "trials": self.manifest.trials}
        return Dataset(variables, {METHOD_AXIS: methods} | axes | along, title)

    def _xarray_axes(self) -> tuple[dict[str, Any], list[tuple[int, ...]], dict[str, Any]]:
        """Axes with their values, position of each cell on them, and other quantities along them.

        Factors of a full grid are axes; other cells are on one axis with the values of the factors.
        """
        levels, named = (
            self.levels,
            [(f"{f.name}_" if f.name in RESERVED_AXIS_NAMES else f.name, f) for f in self.factors],
        )
        axes = {name: [level[f.name] for level in levels] for name, f in named}
        steps = {name: _sorted_levels(dict.fromkeys(values)) for name, values in axes.items()}
        unit = {name: {"units": f.unit, "keys": " ".join(f.keys)} for name, f in named}
        places = [tuple(steps[name].index(axes[name][k]) for name in steps) for k in range(len(levels))]
        if math.prod(map(len, steps.values())) == len(levels) == len(set(places)):
            return {name: (name, values, unit[name]) for name, values in steps.items()}, places, {}
        along = {name: ("cell", values, unit[name]) for name, values in axes.items()}
        return {"cell": ("cell", list(range(len(levels))))}, [(k,) for k in range(len(levels))], along


def _checked_number(function: Callable[..., float], columns: Floats) -> float:
    """Value of a function of the columns (k, n); raises ModelError if it is not a number."""
    result = np.asarray(function(*columns))
    if result.size != 1 or result.dtype.kind not in "fiub":
        raise ModelError(f"the statistic returns {type(result.tolist()).__name__}, expected one number")
    return float(result.item())


def _sorted_levels(levels: Iterable[Any]) -> list[Any]:
    """Sorted numbers, so that an axis can be sliced; texts keep the order of the file."""
    level_list = list(levels)
    return sorted(level_list) if all(isinstance(value, int | float) for value in level_list) else level_list
