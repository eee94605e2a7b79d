"""Known differences of marks: between which places of a network they hold."""

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.recordings.files import FilePlace, shown
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import KnownDifference, Target, symmetric

MUCH_BETTER = 0.1
"""Standard deviation of a mark that nobody measured, in that of a difference to it, up to which it counts as exact."""


def places_of(recording: Recording) -> dict[str, int]:
    """Place of each mark among T targets and S set-ups: its target, else T + the first set-up over it.

    T + S for one that nobody measured, but that is known.
    """
    count, last = len(recording.targets), len(recording.targets) + len(recording.stations)
    found = {name: last for name, target in recording.setup.targets.items() if target.known_mm is not None}
    overs = [recording.station_setup(name).over for name in recording.stations]
    found |= {mark: count + s for s, mark in reversed([*enumerate(overs)]) if mark}
    return found | {name: i for i, name in enumerate(recording.targets)}


def check_differences(recording: Recording, file: object) -> None:
    """RecordError where an end of a known difference is neither measured nor known much better."""
    places, last = places_of(recording), len(recording.targets) + len(recording.stations)
    for one in recording.setup.differences:
        for name in (one.from_, one.to):
            if places.get(name, last) == last and not _is_exact(recording.target_setup(name), one):
                known = f"known along {one.known_axes}, at least ten times better than this difference"
                message = f"'{shown(name)}' was never measured, expected a mark that was, or one that is {known}"
                raise FilePlace(file, column=f"difference {one.called}").wrong(message)


def _is_exact(target: Target, difference: KnownDifference) -> bool:
    axes = ["xyz".index(axis) for axis in difference.known_axes]
    stated = target.known_mm is not None and {*difference.known_axes} <= {*target.known_axes}
    return stated and bool(_sigmas(target)[axes].max() <= MUCH_BETTER * _sigmas(difference)[axes].min())


def _sigmas(known: Target | KnownDifference) -> Floats:
    """Standard deviations (3,) [mm] of known coordinates."""
    if known.known_covariance_mm2 is None:
        return np.full(3, known.known_sigma_mm)
    return np.sqrt(np.diag(symmetric(known.known_covariance_mm2)))
