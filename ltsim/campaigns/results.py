"""The results of a campaign: its statistics, differences on common draws, pictures, axes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ltsim.campaigns.cube import cube
from ltsim.campaigns.paired import Paired, paired
from ltsim.campaigns.schema import CHECKED
from ltsim.campaigns.statistics import Statistics
from ltsim.drawing import pictures
from ltsim.results import Result

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure


class Results(Statistics, Result):
    """What a campaign gives: the statistics of its rows, and what is made of them."""

    def __reduce__(self) -> tuple[type[Results], tuple[Path]]:
        return Results, (self.folder.resolve(),)

    def paired(self, statistic: str, **between: tuple[Any, Any]) -> Paired:
        """Differences of a statistic between two methods, or two levels of a factor, on the same draws.

        Parameters
        ----------
        statistic : str
            A column of the rows, or a share.
        **between
            One of ``method=("distance", "network")`` or a factor with two of its levels, ``faces=(1, 2)``: the first
            less the second, for every combination of the other settings.

        Raises
        ------
        ModelError
            When there is no such statistic, method, factor or level.
        """
        self._quoted(statistic)
        return paired(self, statistic, **between)

    def plot(self, statistic: str = "", along: str = "", *, panel: str = "", **levels: Any) -> Figure:
        """Means of a statistic along a factor, a line a method, with 95 % intervals and the middle 90 % of the trials.

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
        figure: Figure = pictures("figures.campaign").sweep_figure(self, statistic, along, panel=panel, **levels)
        return figure

    def to_xarray(self, *statistics: str) -> xr.Dataset:
        """Means over the trials with their 95 % intervals, on axes that `sel` takes.

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
        return cube(self, statistics or [c for c in self.columns if ":" not in c and c != CHECKED])
