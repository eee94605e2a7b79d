"""The statistics of a campaign as an xarray dataset: an axis a factor, units with every variable."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ltsim.campaigns.schema import column_of
from ltsim.campaigns.statistics import Statistics
from ltsim.errors import missing_extra

if TYPE_CHECKING:
    import xarray as xr

CALIBRATOR = "calibrator"
"""Axis of the methods: `method` is an argument of `sel` already."""
ARGUMENTS = frozenset({CALIBRATOR, "indexers", "method", "tolerance", "drop"})
"""Names that an axis of a factor cannot have; it has an underscore behind then."""


def cube(results: Statistics, statistics: Sequence[str]) -> xr.Dataset:
    """As `Results.to_xarray`."""
    try:
        from xarray import Dataset
    except ImportError:
        raise missing_extra("datasets with axes", "xarray") from None
    axes, places, along = _axes(results)
    methods = list(results.manifest.methods)
    shape = (len(methods), *(len(axes[name][1]) for name in axes))
    variables: dict[str, Any] = {}
    for name in statistics:
        bounds = np.full((3, *shape), np.nan)
        for s in results.spread(name):
            for bound, value in zip(bounds, (s.mean, s.low, s.high), strict=True):
                bound[(methods.index(s.method), *places[s.cell])] = value
        meaning, unit = (known.meaning if (known := column_of(name)) else ""), results.units.get(name, "")
        for own, ending, words in zip(bounds, ("", "_low", "_high"), ("mean", "lower", "upper"), strict=True):
            said = f"{words} of the trials" if not ending else f"{words} 95 % bound of the mean"
            variables[name + ending] = ((CALIBRATOR, *axes), own, {"units": unit, "long_name": f"{said}: {meaning}"})
    title = {"title": results.manifest.title, "trials": results.manifest.trials}
    return Dataset(variables, {CALIBRATOR: methods} | axes | along, title)


def _in_order(values: Iterable[Any]) -> list[Any]:
    """Numbers rising, so that an axis can be sliced however the sweep has grown; words as the file has them."""
    listed = list(values)
    return sorted(listed) if all(isinstance(value, int | float) for value in listed) else listed


def _axes(results: Statistics) -> tuple[dict[str, Any], list[tuple[int, ...]], dict[str, Any]]:
    """Axes with their values, where each cell is on them, and what else is known along them.

    Factors of a full grid are axes; other cells are one axis, the factors' values along it.
    """
    levels, named = results.levels, [(f"{f.name}_" if f.name in ARGUMENTS else f.name, f) for f in results.factors]
    own = {name: [level[f.name] for level in levels] for name, f in named}
    steps = {name: _in_order(dict.fromkeys(values)) for name, values in own.items()}
    unit = {name: {"units": f.unit, "keys": " ".join(f.keys)} for name, f in named}
    places = [tuple(steps[name].index(own[name][k]) for name in steps) for k in range(len(levels))]
    if math.prod(map(len, steps.values())) == len(levels) == len(set(places)):
        return {name: (name, values, unit[name]) for name, values in steps.items()}, places, {}
    along = {name: ("cell", values, unit[name]) for name, values in own.items()}
    return {"cell": ("cell", list(range(len(levels))))}, [(k,) for k in range(len(levels))], along
