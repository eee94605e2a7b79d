"""Nominal sizes of offsets of distances: differences of the radii of common SMRs, and constants of common prisms."""

from collections.abc import Mapping
from typing import TypeVar

NominalEntryT = TypeVar("NominalEntryT")
SMR_RADIUS_DIFFERENCES = {
    12.7e-3: ("0.5 inch", "1.5 inch"),
    7.94e-3: ("7/8 inch", "1.5 inch"),
    4.76e-3: ("0.5 inch", "7/8 inch"),
}
"""Nominal diameters of the smaller and the larger SMR, by the difference of their radii [m]."""
PRISM_CONSTANTS = {17.5e-3: "the constant of a mini prism", 34.4e-3: "the constant of a round prism"}
"""Names of the constants of common prisms, by their size [m]."""
MAX_NOMINAL_DIFFERENCE = 60e-6
"""Difference [m] of an offset from a nominal size below which the sentence names that size. The standard deviation of
the offset must also be smaller than this.
"""


def usual_offset_text(value: float, sigma: float) -> str:
    """Text of the usual cause of an offset of distances, from its `value` and `sigma` [m]; empty if no cause fits."""
    text_by_difference = {
        size: f"the radii of a {small} and a {large} SMR differ by this amount"
        for size, (small, large) in SMR_RADIUS_DIFFERENCES.items()
    }
    return _nearest_nominal({**text_by_difference, **PRISM_CONSTANTS}, value, sigma) or ""


def usual_smr_text(value: float, sigma: float) -> str:
    """Text of the SMR that was used in place of another; empty if no pair of common SMRs fits.

    `value` and `sigma` [m] are those of the displacement of the centre of the SMR, positive away from the nest.
    """
    pair = _nearest_nominal(SMR_RADIUS_DIFFERENCES, value, sigma)
    if pair is None:
        return ""
    used, assumed = reversed(pair) if value > 0 else pair
    return f"a {used} SMR in place of a {assumed} one"


def _nearest_nominal(nominal_sizes: Mapping[float, NominalEntryT], value: float, sigma: float) -> NominalEntryT | None:
    """Entry of the nominal size [m] that differs from the absolute value by less than `MAX_NOMINAL_DIFFERENCE`.

    None if no size does, or if `sigma` is not smaller than that limit.
    """
    close = [
        entry
        for size, entry in nominal_sizes.items()
        if abs(abs(value) - size) < MAX_NOMINAL_DIFFERENCE and sigma < MAX_NOMINAL_DIFFERENCE
    ]
    return close[0] if close else None
