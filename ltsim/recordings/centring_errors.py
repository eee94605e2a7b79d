"""Centring errors of the targets, as tables of `setup.toml`."""

from __future__ import annotations

from typing import Literal

from ltsim.recordings.keys import Positive, TomlSection

Occupation = Literal["station", "instrument_setup", "target_setup", "day"]
"""Occupation of a target, during which its reflector stays in place: all its pointings from one station, of one cell of
a column of occupations, or of one day."""


class CentringUncertainty(TomlSection):
    """Centring errors of targets: at each occupation the reflector is displaced from its target at random.

    All pointings of one occupation share the displacement, which is estimated with the network.
    """

    sigma_mm: Positive
    """Standard deviation of the displacement along each axis."""
    occupation: Occupation = "station"
    """Occupation during which the reflector stays in place: pointings from one `station`, of one entry of the column
    `instrument_setup` or `target_setup`, or of one `day`.
    """
    stations: tuple[str, ...] = ()
    """Stations with such errors; empty for all."""
    targets: tuple[str, ...] = ()
    """Targets with such errors; empty for all."""
