"""Centring errors of the targets, as tables of `setup.toml`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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

    def restricted_to(self, stations: Sequence[str], targets: Sequence[str]) -> CentringUncertainty | None:
        """The same errors for a part of the stations and targets; None if they concern none of them."""
        names_by_key = {
            key: tuple(name for name in chosen if name in names)
            for key, chosen, names in self._names(stations, targets)
        }
        return self.model_copy(update=names_by_key) if all(names_by_key.values()) else None

    def unknown_names(
        self, stations: Sequence[str], targets: Sequence[str]
    ) -> Iterator[tuple[str, str, Sequence[str]]]:
        """Keys and names of stations and targets that a recording does not have, with the names that it has."""
        for key, chosen, names in self._names(stations, targets):
            yield from ((key, name, names) for name in chosen if name not in names)

    def _names(
        self, stations: Sequence[str], targets: Sequence[str]
    ) -> Iterator[tuple[str, tuple[str, ...], Sequence[str]]]:
        """Keys with names, these names, and the names of the recording."""
        yield from (
            (key, chosen, names)
            for key, chosen, names in (("stations", self.stations, stations), ("targets", self.targets, targets))
            if chosen
        )
