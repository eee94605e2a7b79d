"""Experimental design of a campaign: factors, points in ranges of settings, and the names of factors in the rows."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ltsim.core.arrays import Floats
from ltsim.core.randomness import random_stream
from ltsim.core.units import unit_of_key
from ltsim.recordings.result_file import Entry
from ltsim.recordings.setup import Finite, TomlSection
from ltsim.simulation.keys import ValueType, value_at_key, value_type_of_key

RESERVED_COLUMNS = frozenset(
    {
        "cell", "label", "method", "trial", "trials", "status", "chi2",
        "column", "unit", "mean", "deviation", "low", "high", "least", "largest",
    }
)  # fmt: skip
"""Names of the columns that every campaign has."""
SIGNIFICANT_DIGITS = 4
"""Number of significant digits of a value in a design. With four digits the points remain distinct and the values are
easy to read.
"""
MAX_DESIGN_SETTINGS = 64
"""Largest number of settings that a design varies, each over one range of values."""


class SettingRange(TomlSection):
    """Range of one setting in a design, in the unit of its key; values are integers if the key takes integers."""

    low: Finite
    """Smallest value of the key."""
    high: Finite
    """Largest value of the key."""
    scale: Literal["linear", "log"] = "linear"
    """Spacing of the points: uniform in the value, or in its logarithm."""

    @model_validator(mode="after")
    def _check_limits_ascend(self) -> Self:
        if self.low >= self.high or (self.scale == "log" and self.low <= 0):
            raise ValueError("low should be less than high, and above 0 for a log scale")
        return self

    def values_at(self, fractions: Floats, *, is_integer: bool) -> list[float]:
        """Values at given fractions (n,) of the range, 0 to 1; integers are equally likely."""
        low, high = (self.low, self.high + 1.0) if is_integer else (self.low, self.high)
        values = low * (high / low) ** fractions if self.scale == "log" else low + fractions * (high - low)
        return [int(min(v, self.high)) if is_integer else float(f"{v:.{SIGNIFICANT_DIGITS}g}") for v in values]


class Design(TomlSection):
    """Points distributed evenly over ranges of several keys, in place of a grid with too many combinations."""

    kind: Literal["latin-hypercube", "sobol"]
    """Kind of design: Latin hypercube (McKay 1979), or scrambled Sobol sequence (Owen 1998)."""
    cells: Annotated[int, Field(ge=2)]
    """Number of points; for a Sobol sequence a power of two."""
    ranges: Annotated[dict[str, SettingRange], Field(min_length=1, max_length=MAX_DESIGN_SETTINGS)]
    """Range of each key, by dotted key or by a name in `[link]`: tables `[design.ranges.KEY]`."""

    @model_validator(mode="after")
    def _check_balance(self) -> Self:
        if self.kind == "sobol" and self.cells & (self.cells - 1):
            near = 2 ** round(float(np.log2(self.cells)))
            raise ValueError(f"it should have a power of two as cells for a Sobol sequence, such as {near}")
        return self

    def points(self, seed: int, keys: Mapping[str, str]) -> list[dict[str, Any]]:
        """Value of each key at each point of the design, drawn with the campaign's seed.

        `keys` gives, for each range, the dotted key that decides whether values are integers.
        """
        from scipy.stats import qmc  # a second to load, and few campaigns have a design

        draw = random_stream(seed, "campaign", "design", self.kind)
        sampler = qmc.Sobol if self.kind == "sobol" else qmc.LatinHypercube
        shares = sampler(len(self.ranges), seed=draw).random(self.cells)
        columns = [
            limits.values_at(shares[:, k], is_integer=value_type_of_key(keys[name]) == "integer")
            for k, (name, limits) in enumerate(self.ranges.items())
        ]
        return [dict(zip(self.ranges, point, strict=True)) for point in zip(*columns, strict=True)]


class Factor(Entry):
    """Factor of a campaign: a setting that differs between its combinations of settings."""

    name: str
    """Name of the factor, and of its column in rows and summary."""
    keys: tuple[str, ...]
    """Dotted keys of the scenario that take the value of the factor."""
    unit: str = ""
    """Unit of the values."""
    kind: ValueType = "number"
    """Type of the values; tables are written as JSON."""

    def level(self, scenario: Mapping[str, Any]) -> Any:
        """Value of the factor in a combination of settings (cell), from the tables of the cell's scenario.

        A table is returned as JSON, a missing key as None.
        """
        value = value_at_key(dict(scenario), self.keys[0])
        return json.dumps(value) if isinstance(value, (dict, list)) else value

    def level_text(self, level: Any) -> str:
        """Text of a value of the factor; the unit is added unless the name of the factor contains it."""
        text = level if isinstance(level, str) else "none" if level is None else f"{level:g}"
        if isinstance(level, bool):
            text = "yes" if level else "no"
        return f"{text} {self.unit}" if self.unit and not unit_of_key(self.name) and level is not None else text


def short_key_names(keys: Sequence[str]) -> dict[str, str]:
    """Shortest suffix of each dotted key that is unique among the keys and the other columns, by key."""
    depth = dict.fromkeys(keys, 1)
    while True:
        names = {key: "_".join(key.split(".")[-depth[key] :]) for key in keys}
        often = Counter(names.values())
        again = [
            k for k in keys if (often[names[k]] > 1 or names[k] in RESERVED_COLUMNS) and depth[k] < len(k.split("."))
        ]
        if not again:
            return names
        for key in again:
            depth[key] += 1


def cell_label(factors: Sequence[Factor], level_by_factor: Mapping[str, Any]) -> str:
    """Description of a combination of settings in one line: the value of each factor."""
    return ", ".join(f"{f.name} = {f.level_text(level_by_factor[f.name])}" for f in factors) or "as the scenario says"
