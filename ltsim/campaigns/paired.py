"""Ratios over all trials, and differences on common draws, which no single row of a campaign has."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ltsim.campaigns.schema import terms_of
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError, unknown_name
from ltsim.core.results import Columns, Result, by_row

if TYPE_CHECKING:
    from ltsim.campaigns.statistics import Statistics  # needs packages that few install

Place = tuple[int, str]
"""Cell and method."""


@dataclass(frozen=True)
class Difference:
    """Paired difference of a statistic: `first` minus `second` method or level on the same draws, trial by trial.

    `settings` are common to both; `low` and `high` are the 95 % confidence limits.
    """

    settings: Mapping[str, Any]
    first: str
    second: str
    statistic: str
    unit: str
    trials: int
    difference: float
    low: float
    high: float

    @property
    def sentence(self) -> str:
        """Text of the difference in one sentence."""
        where = "".join(f", {name} {value}" for name, value in self.settings.items())
        gap, unit = f"{self.difference:.4g}", f" {self.unit}" if self.unit else ""
        interval = f"95 %: {self.low:.4g} to {self.high:.4g}{unit}"
        return (
            f"{self.statistic}, {self.first} less {self.second}{where}: {gap}{unit} ({interval}; {self.trials} trials)"
        )


@dataclass(frozen=True, repr=False)
class Paired(Result):
    """Differences on common draws."""

    entries: tuple[Difference, ...]

    def _lines(self) -> list[str]:
        return [entry.sentence for entry in self.entries]

    def _tables(self) -> Mapping[str, Callable[[], Columns]]:
        plain = [{**e.settings, **{k: v for k, v in vars(e).items() if k != "settings"}} for e in self.entries]
        return {"differences": lambda: by_row(plain)}


def paired(results: Statistics, statistic: str, **between: tuple[Any, Any]) -> Paired:
    """Paired comparison of methods; see `Results.paired`."""
    if len(between) != 1:
        raise ModelError("paired compares two methods, method=(A, B), or two levels of one factor")
    ((along, (first, second)),) = between.items()
    differences = []
    for common, this, other in _pairs(results, along, first, second):
        values = [_values(results, statistic, *place) for place in (this, other)]
        both = np.isin(values[0][0], values[1][0]), np.isin(values[1][0], values[0][0])
        (mean, scatter), (less, less_scatter) = (_linear(v[1][:, keep]) for v, keep in zip(values, both, strict=True))
        count, gap = len(scatter), mean - less
        half = results.half(count, float(np.std(scatter - less_scatter, ddof=1))) if count > 1 else math.inf
        this_name, other_name = (str(k) if along == "method" else f"{along} {k}" for k in (first, second))
        named = this_name, other_name, statistic, results.units.get(statistic, "")
        differences.append(Difference(common, *named, count, gap, gap - half, gap + half))
    return Paired(tuple(differences))


def _pairs(results: Statistics, along: str, first: Any, second: Any) -> Iterator[tuple[dict[str, Any], Place, Place]]:
    methods, levels = results.manifest.methods, results.levels
    factors = [factor.name for factor in results.factors]
    if along not in ("method", *factors):
        raise unknown_name("factor of this campaign", along, ("method", *factors))
    choices = list(methods) if along == "method" else [level[along] for level in levels]
    for level in (first, second):
        if level not in choices:
            raise unknown_name(f"level of {along}", str(level), [str(k) for k in dict.fromkeys(choices)])
    for cell, settings in enumerate(levels):
        if along == "method":
            yield dict(settings), (cell, first), (cell, second)
        elif settings[along] == first and (settings | {along: second}) in levels:
            rest = {name: value for name, value in settings.items() if name != along}
            for method in methods:
                several = {"method": method} if len(methods) > 1 else {}
                yield rest | several, (cell, method), (levels.index(settings | {along: second}), method)


def _values(results: Statistics, statistic: str, cell: int, method: str) -> tuple[Floats, Floats]:
    """Trials (N,) of a cell and method, and the values to be averaged: (1, N) for a mean, (2, N) for a ratio."""
    terms = terms_of(statistic)
    table = results.of_trials(("trial", *terms), cell, method, f"{terms[0]} IS NOT NULL")
    return table[0], table[1:]


def _linear(terms: Floats) -> tuple[float, Floats]:
    """Mean of (1, N), or ratio of means of (2, N), and the influence (N,) of each trial on it."""
    if len(terms) == 1:
        return float(np.mean(terms)), terms[0]
    ratio = float(terms[0].mean() / terms[1].mean())
    return ratio, (terms[0] - ratio * terms[1]) / terms[1].mean()
