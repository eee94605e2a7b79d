"""Nominal sizes of distance offsets: differences of the radii of common SMRs, and additive constants of prisms."""

from collections.abc import Mapping
from typing import TypeVar

NominalEntryT = TypeVar("NominalEntryT")
"""Type of a dictionary value for a nominal size: the name of a prism constant, or the diameters of two SMRs."""
SMR_DIAMETERS_BY_RADIUS_DIFFERENCE = {
    12.7e-3: ("0.5 inch", "1.5 inch"),
    7.94e-3: ("7/8 inch", "1.5 inch"),
    4.76e-3: ("0.5 inch", "7/8 inch"),
}
"""Nominal diameters of the smaller and the larger SMR, by the difference of their radii [m]."""
PRISM_CONSTANT_NAMES = {17.5e-3: "the constant of a mini prism", 34.4e-3: "the constant of a round prism"}
"""Names of the additive constants of common prisms, by their size [m]."""
MAX_DIFFERENCE_FROM_NOMINAL_SIZE = 60e-6
"""Largest difference [m] between an estimated offset and the nominal size that a sentence names as its cause. The
standard deviation of the offset must also be below this limit.
"""


def offset_cause_text(value: float, sigma: float) -> str:
    """Text on the usual cause of a distance offset, such as another SMR or a prism constant; empty if none fits.

    `value` [m] is the estimated offset, `sigma` [m] its standard deviation.
    """
    text_by_difference = {
        size: f"the radii of a {small} and a {large} SMR differ by this amount"
        for size, (small, large) in SMR_DIAMETERS_BY_RADIUS_DIFFERENCE.items()
    }
    return _entry_of_nearest_nominal_size({**text_by_difference, **PRISM_CONSTANT_NAMES}, value, sigma) or ""


def smr_exchange_text(value: float, sigma: float) -> str:
    """Text that one SMR was used in place of another; empty if no pair of common SMRs fits the displacement.

    `value` [m] is the estimated displacement of the SMR centre, positive away from the nest, `sigma` [m] its standard
    deviation.
    """
    pair = _entry_of_nearest_nominal_size(SMR_DIAMETERS_BY_RADIUS_DIFFERENCE, value, sigma)
    if pair is None:
        return ""
    used, assumed = reversed(pair) if value > 0 else pair
    return f"a {used} SMR in place of a {assumed} one"


def _entry_of_nearest_nominal_size(
    nominal_sizes: Mapping[float, NominalEntryT], value: float, sigma: float
) -> NominalEntryT | None:
    """Entry of the nominal size [m] that agrees with the absolute value of an offset, `value` [m].

    The result is None if no nominal size is nearer to the offset than `MAX_DIFFERENCE_FROM_NOMINAL_SIZE`, or if the
    standard deviation `sigma` [m] of the offset exceeds this limit.
    """
    close = [
        entry
        for size, entry in nominal_sizes.items()
        if abs(abs(value) - size) < MAX_DIFFERENCE_FROM_NOMINAL_SIZE and sigma < MAX_DIFFERENCE_FROM_NOMINAL_SIZE
    ]
    return close[0] if close else None
