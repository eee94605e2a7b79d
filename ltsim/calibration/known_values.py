"""Known coordinates, lengths and levels in a result: each with what the rest of the network says about it."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.known import KnownTest
from ltsim.recording.result_file import Entry, Finite, Known
from ltsim.results import Table, columns_of
from ltsim.units import ARCSECOND, MILLIMETRE


class KnownEntry(Entry):
    """A component of a known value, tested like a reading; what gives only axes has the kind `axes`."""

    kind: Literal["point", "length", "level", "mark", "axes"]
    """What is known."""
    name: str
    """Target, both ends of a length, or station."""
    component: str = ""
    """x, y or z of a point; the two tilts of a level are x and y."""
    residual: Finite
    """Stated less adjusted."""
    error: Finite
    """By how much it is wrong by what the rest says."""
    sigma_error: Known = None
    """Standard deviation of the error; null where the rest says nothing."""
    minimal_detectable: Known = None
    """Smallest error that the test finds with 80 %."""
    unit: str
    """Of residual, error and what follows them."""
    redundancy: Finite
    """Share of an error that the residual shows."""
    w: Finite
    """Root of the fall of chi-square without the whole known value."""
    left_out: bool = False
    """It contradicts the rest and had no say."""


KNOWN = Table("known.csv", "known values, each tested by the rest", columns_of(KnownEntry))


def known_of(adjustment: Adjustment) -> tuple[KnownEntry, ...]:
    """Every known value with its test, one entry a component."""
    return tuple(_known_entry(test, k) for test in adjustment.known for k in range(len(test.error)))


def _known_entry(test: KnownTest, k: int) -> KnownEntry:
    unit, factor = ("arcsec", ARCSECOND) if test.kind == "level" else ("mm", MILLIMETRE)
    one, sure = len(test.error) == 1 and not test.axes, bool(np.isfinite(test.sigma_error[k]))
    return KnownEntry(
        kind=test.kind,
        name=test.name,
        component="" if one else (test.axes or "xy")[k],
        residual=float(test.residual[k]) / factor,
        error=float(test.error[k]) / factor,
        sigma_error=float(test.sigma_error[k]) / factor if sure else None,
        minimal_detectable=float(test.minimal_detectable[k]) / factor if sure else None,
        unit=unit,
        redundancy=float(test.redundancy[k]),
        w=test.w,
        left_out=test.left_out,
    )
