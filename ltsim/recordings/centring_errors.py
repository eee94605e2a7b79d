"""Centring errors of the targets, as tables of `setup.toml`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

from ltsim.recordings.keys import Positive, TomlSection

OccupationGrouping = Literal["station", "instrument_setup", "target_setup", "day"]
"""Rule that groups the pointings to a target into occupations, in which its reflector is not moved: all pointings from
one station, all with the same entry in the column `instrument_setup` or `target_setup`, or all of one day."""


class CentringUncertainty(TomlSection):
    """Centring errors of targets: at each occupation the reflector is displaced from its target at random.

    All pointings of one occupation share the displacement, which is estimated with the network.
    """

    sigma_mm: Positive
    """Standard deviation of the displacement along each axis."""
    occupation: OccupationGrouping = "station"
    """Pointings to a target during which its reflector is not moved: all pointings from one `station`, all with the
    same entry in the column `instrument_setup` or `target_setup`, or all of one `day`.
    """
    stations: tuple[str, ...] = ()
    """Names of the stations whose pointings have these errors; empty for all stations."""
    targets: tuple[str, ...] = ()
    """Names of the targets that have these errors; empty for all targets."""

    def restricted_to(self, stations: Sequence[str], targets: Sequence[str]) -> CentringUncertainty | None:
        """Centring errors of the given stations and targets (names) only; None if these errors act on none of them."""
        names_by_key = {
            key: tuple(name for name in declared_names if name in names)
            for key, declared_names, names in self._declared_names(stations, targets)
        }
        return self.model_copy(update=names_by_key) if all(names_by_key.values()) else None

    def unknown_names(
        self, stations: Sequence[str], targets: Sequence[str]
    ) -> Iterator[tuple[str, str, Sequence[str]]]:
        """Declared names that the recording lacks, each with its key (`stations` or `targets`) and the permitted names.

        The items are (key, name, permitted names). `stations` and `targets` are the names in the recording, which are
        the permitted ones.
        """
        for key, declared_names, names in self._declared_names(stations, targets):
            yield from ((key, name, names) for name in declared_names if name not in names)

    def _declared_names(
        self, stations: Sequence[str], targets: Sequence[str]
    ) -> Iterator[tuple[str, tuple[str, ...], Sequence[str]]]:
        """Keys (`stations`, `targets`) with declared names, each with these names and the permitted names of this kind.

        `stations` and `targets` are the names in the recording, which are the permitted ones.
        """
        yield from (
            (key, declared_names, names)
            for key, declared_names, names in (
                ("stations", self.stations, stations),
                ("targets", self.targets, targets),
            )
            if declared_names
        )
