"""What an invented law is."""

from __future__ import annotations

from collections.abc import Callable

from ltsim.arrays import Floats
from ltsim.scene.sightings import Sightings

Law = Callable[[Sightings, Floats], Floats]
"""Correction (n,) per unit of size at constants (5,), each uniform between 0 and 1; or displacement (n, 3)."""

__all__ = ["Law"]
