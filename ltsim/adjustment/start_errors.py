"""Errors for networks without approximate coordinates of every station."""

import numpy as np

from ltsim.adjustment.frame import are_collinear
from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import NetworkError
from ltsim.core.notation import listing
from ltsim.recordings.recording import Recording


def require_connected_stations(recording: Recording, is_joined: Bools, points: Floats, undetermined_lines: str) -> None:
    """Check that all stations have coordinates; raises NetworkError with the names of those without.

    Parameters
    ----------
    recording : Recording
    is_joined : array of bool (S,)
        Stations with coordinates.
    points : array (k, 3)
        Positions [m] of the targets that the best connected station without coordinates shares with the network.
    undetermined_lines : str
        Text on the lines of the plan whose length no reading determines; it ends the message.
    """
    if is_joined.all():
        return
    lost = listing([recording.stations[s] for s in np.flatnonzero(~is_joined)])
    n_targets = len(points)
    if n_targets >= 3 and are_collinear(points):
        what = f"the {n_targets} targets that it shares with the network lie on one line; three that do not"
    else:
        what = f"shares only {n_targets} target{'s' * (n_targets != 1)} with the network; at least three"
    raise NetworkError(
        f"station {lost}: {what} are needed (two between levelled stations, more where ranges or angles are missing), "
        'or approximate coordinates of all stations and targets; for a station over a target, set over = "TARGET"'
        f"{undetermined_lines}"
    )


def require_located_target(recording: Recording, has_coordinates: Bools) -> None:
    """Check that at least one target has coordinates (T,); raises NetworkError."""
    if not has_coordinates.any():
        raise NetworkError(
            f"target {', '.join(recording.targets[:10])}: no station measured range and both angles, and "
            "the lines of sight from different stations do not meet in one point"
        )
