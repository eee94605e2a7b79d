"""Refusal of networks whose equations no factorisation solves, in one sentence for all verbs."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np

from ltsim.core.errors import NetworkError
from ltsim.recordings.recording import Recording

P = ParamSpec("P")
R = TypeVar("R")


def refusing_singular(function: Callable[Concatenate[Recording, P], R]) -> Callable[Concatenate[Recording, P], R]:
    """A function of a recording that raises NetworkError where its matrices are singular beyond what it handles."""

    @wraps(function)
    def refusing(recording: Recording, /, *args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return function(recording, *args, **kwargs)
        except np.linalg.LinAlgError:
            raise NetworkError(_sentence(recording)) from None

    return refusing


def _sentence(recording: Recording) -> str:
    """The weakest station and target of a network, by their readings."""
    count = recording.measured.sum(axis=1)
    stations = np.bincount(recording.station, count, len(recording.stations))
    targets = np.bincount(recording.target, count, len(recording.targets))
    weakest = (
        f"station {recording.stations[int(stations.argmin())]} has {stations.min():.0f} readings, "
        f"target {recording.targets[int(targets.argmin())]} has {targets.min():.0f}"
    )
    return (
        f"the equations of the network are singular: its readings leave some unknowns undetermined ({weakest}); "
        "measure range and both angles to three or more common targets from each station"
    )
