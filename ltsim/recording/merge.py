"""Directions, zenith angles and distances listed one by one, gathered into pointings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ltsim.recording.build import NAN, Pointing
from ltsim.recording.recording import HEIGHT_COLUMNS, KIND_COLUMN, SIGMA_COLUMNS
from ltsim.units import ARCSECOND, MILLIMETRE

Kind = Literal["distance", "azimuth", "elevation"]
KINDS: tuple[Kind, ...] = ("distance", "azimuth", "elevation")
UNIT = {"distance": MILLIMETRE, "azimuth": ARCSECOND, "elevation": ARCSECOND}


@dataclass(frozen=True)
class Observed:
    """One observation [m, rad], its standard deviation and heights [m] (NaN: not stated), its line (0: not known)."""

    kind: Kind
    station: str
    target: str
    value: float
    sigma: float = NAN
    instrument_height: float = NAN
    target_height: float = NAN
    horizontal: bool = False
    line: int = 0


@dataclass
class _Row:
    station: str
    target: str
    heights: tuple[float, float]
    values: dict[Kind, Observed] = field(default_factory=dict)

    def takes(self, one: Observed) -> bool:
        """Whether this pointing still lacks such an observation and was made at the same heights."""
        heights = (one.instrument_height, one.target_height)
        agree = all(np.isnan(a) or np.isnan(b) or a == b for a, b in zip(self.heights, heights, strict=True))
        return one.kind not in self.values and agree

    def take(self, one: Observed) -> None:
        self.values[one.kind] = one
        first, second = self.heights
        self.heights = (
            one.instrument_height if np.isnan(first) else first,
            one.target_height if np.isnan(second) else second,
        )


@dataclass(frozen=True)
class Merged:
    """Pointings, and the heights [mm] that are the same in all pointings of a station or target."""

    pointings: list[Pointing]
    instrument_heights: dict[str, float]
    target_heights: dict[str, float]


def merged(observed: Iterable[Observed], file: str = "") -> Merged:
    """Gather observations: the k-th direction, zenith angle and distance of a station to a target are one pointing.

    Heights that differ between the pointings of one station or target become columns; others are returned once.
    """
    rows: list[_Row] = []
    open_rows: dict[tuple[str, str], list[_Row]] = {}
    for one in observed:
        candidates = open_rows.setdefault((one.station, one.target), [])
        row = next((r for r in candidates if r.takes(one)), None)
        if row is None:
            row = _Row(one.station, one.target, (NAN, NAN))
            candidates.append(row)
            rows.append(row)
        row.take(one)
        if len(row.values) == len(KINDS):
            candidates.remove(row)
    constant = [_constant(rows, place) for place in (0, 1)]
    in_columns = [place for place in (0, 1) if constant[place] is None]
    pointings = [_pointing(row, in_columns, file) for row in rows]
    return Merged(pointings, constant[0] or {}, constant[1] or {})


def _constant(rows: Sequence[_Row], place: int) -> dict[str, float] | None:
    """Height [mm] by name where every name has one only; None where some name has several."""
    found: dict[str, float] = {}
    for row in rows:
        name, height = (row.station, row.target)[place], row.heights[place]
        if np.isnan(height):
            continue
        if found.setdefault(name, height) != height:
            return None
    return {name: height / MILLIMETRE for name, height in found.items() if height}


def _pointing(row: _Row, in_columns: list[int], file: str) -> Pointing:
    covariates = {
        SIGMA_COLUMNS[KINDS.index(kind)]: one.sigma / UNIT[kind]
        for kind, one in row.values.items()
        if np.isfinite(one.sigma)
    }
    for place in in_columns:
        height = row.heights[place]
        covariates[HEIGHT_COLUMNS[place]] = 0.0 if np.isnan(height) else height / MILLIMETRE
    values = {kind: one.value for kind, one in row.values.items()}
    flat = "distance" in row.values and row.values["distance"].horizontal
    labels = {KIND_COLUMN: "horizontal"} if flat else {}
    lines = sorted({one.line for one in row.values.values() if one.line})
    source = f"{file}, line{'s' * (len(lines) > 1)} {', '.join(map(str, lines))}" if lines else ""
    return Pointing(row.station, row.target, 1, **values, covariates=covariates, labels=labels, source=source)
