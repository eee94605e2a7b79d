"""Centring errors of targets: contents of the tables `[[centring]]` of `setup.toml`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

from ltsim.recordings.keys import Positive, TomlSection

OccupationGrouping = Literal["station", "instrument_setup", "target_setup", "day"]
"""Rule that assigns pointings to occupations of a target (times during which its reflector is not moved). One
occupation has all pointings from one station, all with one entry in the column `instrument_setup` or `target_setup`, or
all of one day."""


class CentringUncertainty(TomlSection):
    """Centring errors of targets: in each occupation the reflector is displaced from its target by a random vector.

    All pointings of one occupation share the vector, which the adjustment estimates.
    """

    sigma_mm: Positive
    """Standard deviation [mm] of the random displacement of the reflector along each coordinate axis."""
    occupation: OccupationGrouping = "station"
    """Rule that assigns pointings to occupations, in which the reflector is not moved. One occupation has all pointings
    from one `station`, all with one entry in the column `instrument_setup` or `target_setup`, or all of one `day`."""
    stations: tuple[str, ...] = ()
    """Names of the stations whose pointings have the centring errors of this table; empty for all stations."""
    targets: tuple[str, ...] = ()
    """Names of the targets that have the centring errors of this table; empty for all targets."""

    def restricted_to(self, stations: Sequence[str], targets: Sequence[str]) -> CentringUncertainty | None:
        """Copy of this table for given stations and targets (names) only; None if its errors act on none of them."""
        names_by_key = {
            key: tuple(name for name in declared_names if name in names)
            for key, declared_names, names in self._declared_names(stations, targets)
        }
        return self.model_copy(update=names_by_key) if all(names_by_key.values()) else None

    def unknown_names(
        self, stations: Sequence[str], targets: Sequence[str]
    ) -> Iterator[tuple[str, str, Sequence[str]]]:
        """Names in the keys `stations` and `targets` of this table that do not occur in the recording.

        The arguments `stations` and `targets` are the names in the recording. Each item is the key, the unknown name,
        and the names of the recording among which the user can choose.
        """
        for key, declared_names, names in self._declared_names(stations, targets):
            yield from ((key, name, names) for name in declared_names if name not in names)

    def _declared_names(
        self, stations: Sequence[str], targets: Sequence[str]
    ) -> Iterator[tuple[str, tuple[str, ...], Sequence[str]]]:
        """Keys `stations` and `targets` if they are not empty, each with its names and with the names in the recording.

        The arguments `stations` and `targets` are the names in the recording. Each item is the key, the names in this
        table, and the names in the recording.
        """
        yield from (
            (key, declared_names, names)
            for key, declared_names, names in (
                ("stations", self.stations, stations),
                ("targets", self.targets, targets),
            )
            if declared_names
        )
