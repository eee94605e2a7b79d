"""Refusing networks that cannot be solved at all."""

from __future__ import annotations

import numpy as np

from ltsim.errors import NetworkError
from ltsim.recording.recording import Recording


def check_solvable(recording: Recording) -> None:
    """Refuse stations that see too few targets to be placed.

    A levelled station, or one over a known mark, needs fewer than three and is left to the adjustment.

    Raises
    ------
    NetworkError
        Naming the station and what would be right.
    """
    for i, name in enumerate(recording.stations):
        station = recording.station_setup(name)
        if station.levelled or station.over is not None:
            continue
        seen = np.unique(recording.target[recording.station == i])
        if len(seen) < 3:
            names = ", ".join(recording.targets[t] for t in seen)
            message = (
                f"station {name} sees {len(seen)} target{'s' if len(seen) != 1 else ''} only ({names}); "
                "at least three are needed to place a station that is not levelled"
            )
            raise NetworkError(message)
