"""Nominal sizes of offsets: radii of common SMRs, and constants of common prisms."""

from collections.abc import Mapping
from typing import TypeVar

NominalType = TypeVar("NominalType")
SMR_RADIUS_DIFFERENCES = {
    12.7e-3: ("0.5 inch", "1.5 inch"),
    7.94e-3: ("7/8 inch", "1.5 inch"),
    4.76e-3: ("0.5 inch", "7/8 inch"),
}
"""Differences of the radii of common SMRs [m], with the smaller and the larger one."""
PRISM_CONSTANTS = {17.5e-3: "the constant of a mini prism", 34.4e-3: "the constant of a round prism"}
"""Constants of common prisms [m]."""
MAX_NOMINAL_DIFFERENCE = 60e-6
"""Tolerance [m] between an offset and a nominal size, for an offset with a smaller uncertainty."""


def usual_offset_text(value: float, sigma: float) -> str:
    """Text of the usual cause of an offset of distances [m]; empty for none."""
    pairs = {
        size: f"the radii of a {small} and a {large} SMR differ by this"
        for size, (small, large) in SMR_RADIUS_DIFFERENCES.items()
    }
    return _nearest_nominal({**pairs, **PRISM_CONSTANTS}, value, sigma) or ""


def usual_smr_text(value: float, sigma: float) -> str:
    """Text of the SMR that was used in place of another, from the displacement [m] of its centre from the nest.

    It is empty for none.
    """
    pair = _nearest_nominal(SMR_RADIUS_DIFFERENCES, value, sigma)
    if pair is None:
        return ""
    used, assumed = reversed(pair) if value > 0 else pair
    return f"a {used} SMR in place of a {assumed} one"


def _nearest_nominal(nominal_sizes: Mapping[float, NominalType], value: float, sigma: float) -> NominalType | None:
    """Entry of the usual size [m] within `MAX_NOMINAL_DIFFERENCE` of a value.

    None if there is none or the sigma is larger.
    """
    close = [
        entry
        for size, entry in nominal_sizes.items()
        if abs(abs(value) - size) < MAX_NOMINAL_DIFFERENCE and sigma < MAX_NOMINAL_DIFFERENCE
    ]
    return close[0] if close else None
