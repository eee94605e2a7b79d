"""Errors for networks in which a station, or all targets, got no approximate coordinates."""

import numpy as np

from ltsim.adjustment.frame import are_collinear
from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import NetworkError
from ltsim.core.notation import names_text
from ltsim.recordings.recording import Recording


def require_connected_stations(recording: Recording, is_joined: Bools, points: Floats, undetermined_lines: str) -> None:
    """Check that all stations have approximate coordinates; raises NetworkError with the names of the others.

    Parameters
    ----------
    recording : Recording
    is_joined : (S,) bool
        True for those of the S stations that have coordinates.
    points : (k, 3) float, [m]
        Positions of the k targets that the best connected of the other stations shares with the network.
    undetermined_lines : str
        Text on lines whose length no reading determines, for the end of the message; may be empty.
    """
    if is_joined.all():
        return
    lost = names_text([recording.stations[s] for s in np.flatnonzero(~is_joined)])
    n_targets = len(points)
    if n_targets >= 3 and are_collinear(points):
        what = f"the {n_targets} targets that it shares with the network lie on one line"
        need = "three common targets that are not on one line"
    else:
        what = f"shares only {n_targets} target{'s' * (n_targets != 1)} with the network"
        need = "at least three common targets"
    raise NetworkError(
        f"station {lost}: {what}; its pose needs {need} (two between levelled stations, more if ranges or angles are "
        "missing), or approximate coordinates of all stations and targets; for a station over a target, set over = "
        f'"TARGET" in the set-up{undetermined_lines}'
    )


def require_located_target(recording: Recording, has_coordinates: Bools) -> None:
    """Check that at least one of T targets has approximate coordinates; raises NetworkError.

    `has_coordinates` (T,) flags the targets with coordinates.
    """
    if not has_coordinates.any():
        raise NetworkError(
            f"target {', '.join(recording.targets[:10])}: no station measured range and both angles, and "
            "the lines of sight from different stations do not meet in one point; measure range and both angles"
        )
