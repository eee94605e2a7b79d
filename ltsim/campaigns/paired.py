"""Differences between two methods or levels of a campaign, trial by trial on the same random draws."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ltsim.campaigns.schema import sql_terms
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError, unknown_name
from ltsim.core.results import ColumnValues, Result, columns_from_rows
from ltsim.core.units import parse_in_unit, unit_of_key

if TYPE_CHECKING:
    from ltsim.campaigns.statistics import CampaignStatistics  # needs packages that few install

LEVEL_ROUNDING = 5e-4
"""Largest relative difference between a level and a number that a user gives for it; the level may thus be rounded to
three digits.
"""
CellMethod = tuple[int, str]
"""Number of a cell, and name of a method."""


@dataclass(frozen=True)
class PairedDifference:
    """Paired difference of a statistic: first minus second method or level on the same draws, trial by trial."""

    settings: Mapping[str, Any]
    """Values of all other factors, which both have in common."""
    first: str
    """First method or level."""
    second: str
    """Second method or level."""
    statistic: str
    """Name of the statistic."""
    unit: str
    """Unit of the statistic."""
    trials: int
    """Number of trials."""
    difference: float
    """Mean of the statistic of the first minus that of the second."""
    low: float
    """Lower 95 % confidence limit of the difference."""
    high: float
    """Upper 95 % confidence limit of the difference."""

    @property
    def sentence(self) -> str:
        """Sentence on the difference."""
        where = "".join(f", {name} {value}" for name, value in self.settings.items())
        gap, unit = f"{self.difference:.4g}", f" {self.unit}" if self.unit else ""
        interval = f"95 %: {self.low:.4g} to {self.high:.4g}{unit}"
        return (
            f"{self.statistic}, {self.first} less {self.second}{where}: {gap}{unit} ({interval}; {self.trials} trials)"
        )


@dataclass(frozen=True, repr=False)
class PairedDifferences(Result):
    """Differences between the methods and levels of a campaign on common draws."""

    entries: tuple[PairedDifference, ...]
    """Difference for each combination of the other settings."""

    def _lines(self) -> list[str]:
        return [entry.sentence for entry in self.entries]

    def _tables(self) -> Mapping[str, Callable[[], ColumnValues]]:
        plain = [{**e.settings, **{k: v for k, v in vars(e).items() if k != "settings"}} for e in self.entries]
        return {"differences": lambda: columns_from_rows(plain)}


def paired_differences(results: CampaignStatistics, statistic: str, **pair: tuple[Any, Any]) -> PairedDifferences:
    """Paired differences of a statistic between two methods or levels; see `CampaignResults.paired_differences`."""
    if len(pair) != 1:
        raise ModelError("give either two methods, method=(A, B), or two levels of one factor")
    ((along, (first, second)),) = pair.items()
    differences = []
    for common, this, other in _comparison_pairs(results, along, first, second):
        values = [_trial_values(results, statistic, *place) for place in (this, other)]
        both = np.isin(values[0][0], values[1][0]), np.isin(values[1][0], values[0][0])
        (mean, scatter), (less, less_scatter) = (
            _mean_and_influence(v[1][:, keep]) for v, keep in zip(values, both, strict=True)
        )
        count, gap = len(scatter), mean - less
        half = results.half_interval(count, float(np.std(scatter - less_scatter, ddof=1))) if count > 1 else math.inf
        this_name, other_name = (str(k) if along == "method" else f"{along} {k}" for k in (first, second))
        named = this_name, other_name, statistic, results.units.get(statistic, "")
        differences.append(PairedDifference(common, *named, count, gap, gap - half, gap + half))
    return PairedDifferences(tuple(differences))


def _comparison_pairs(
    results: CampaignStatistics, factor_name: str, first_level: Any, second_level: Any
) -> Iterator[tuple[dict[str, Any], CellMethod, CellMethod]]:
    """Common settings, first cell and method, second cell and method of each comparison.

    Raises ModelError if there is no such factor, method or level.
    """
    methods, levels = results.manifest.methods, results.levels
    factors = [factor.name for factor in results.factors]
    if factor_name not in ("method", *factors):
        raise unknown_name("factor of this campaign", factor_name, ("method", *factors))
    choices = list(methods) if factor_name == "method" else [level[factor_name] for level in levels]
    first_level, second_level = (_level_of(factor_name, level, choices) for level in (first_level, second_level))
    for cell, settings in enumerate(levels):
        if factor_name == "method":
            yield dict(settings), (cell, first_level), (cell, second_level)
        elif settings[factor_name] == first_level and (settings | {factor_name: second_level}) in levels:
            rest = {name: value for name, value in settings.items() if name != factor_name}
            for method in methods:
                several = {"method": method} if len(methods) > 1 else {}
                yield rest | several, (cell, method), (levels.index(settings | {factor_name: second_level}), method)


def _level_of(factor_name: str, requested_level: Any, levels: Sequence[Any]) -> Any:
    """Level that a user's value means: the level itself, with its unit as in the file, or rounded to three digits.

    Raises ModelError for a value that is no level, or that is the rounded value of several levels.
    """
    distinct = list(dict.fromkeys(levels))
    if requested_level in distinct:
        return requested_level
    value = (
        parse_in_unit(requested_level, unit_of_key(factor_name))
        if isinstance(requested_level, str)
        else requested_level
    )
    if isinstance(value, int | float) and not isinstance(value, bool):
        numbers = [k for k in distinct if isinstance(k, int | float)]
        near = [k for k in numbers if math.isclose(k, value, rel_tol=LEVEL_ROUNDING)]
        if len(near) == 1:
            return near[0]
    raise unknown_name(f"level of {factor_name}", str(requested_level), [str(k) for k in distinct])


def _trial_values(results: CampaignStatistics, statistic: str, cell: int, method: str) -> tuple[Floats, Floats]:
    """Numbers (N,) of the trials of a cell and method, and the terms to be averaged over these trials.

    The terms are (1, N) for a mean, and (2, N), numerator and denominator, for a ratio of means.
    """
    terms = sql_terms(statistic)
    table = results.term_values(("trial", *terms), cell, method, f"{terms[0]} IS NOT NULL")
    return table[0], table[1:]


def _mean_and_influence(trial_terms: Floats) -> tuple[float, Floats]:
    """Mean of terms (1, N), or ratio of the means of terms (2, N), and influence (N,) of each trial on the result."""
    if len(trial_terms) == 1:
        return float(np.mean(trial_terms)), trial_terms[0]
    ratio = float(trial_terms[0].mean() / trial_terms[1].mean())
    return ratio, (trial_terms[0] - ratio * trial_terms[1]) / trial_terms[1].mean()
