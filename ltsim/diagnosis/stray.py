"""Single readings that are wrong: they come before any law, which would bend to them.

A reading is a stray one when its normalised residual (Baarda), in units of what readings of its kind really scatter, is
too large for chance, and when without it no other reading of its target is off. With one pointing after a moment a
wrong reading is the plainer cause than a target that has moved.
"""

import numpy as np

from ltsim.adjustment.gross import GrossFinding
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Bools, Floats
from ltsim.recordings.recording import OBSERVABLES

WRONG, OFF = 8.0, 4.0
"""Normalised residuals of a stray reading, which noise does not reach in any recording, and of one that is off too."""
SEEN = 0.02
"""Redundancy from which a reading's own residual tells anything."""
MAD = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""
MOST = 5


def stray_readings(space: ResidualSpace, use: Bools) -> tuple[Bools, list[GrossFinding]]:
    """Readings (n, 3) to use, without stray ones, and these as findings, the worst first."""
    use, found = use.copy(), list[GrossFinding]()
    place = np.flatnonzero(space.use)
    target = space.adjustment.recording.target[place // 3]
    w = _normalised(space)
    while len(found) < MOST and np.abs(w).max(initial=0.0) > WRONG:
        worst = int(np.argmax(np.abs(w)))
        rest = space.extended(np.eye(1, space.size, worst).T)
        others = _normalised(rest)
        if np.abs(others[target == target[worst]]).max() > OFF:
            break
        use.ravel()[place[worst]] = False
        found.append(_finding(space, int(place[worst]), worst, float(abs(w[worst]))))
        space, w = rest, others
    return use, found


def _normalised(space: ResidualSpace) -> Floats:
    """Residuals (r,) of the readings over what readings of their kind scatter; zero where nothing would show."""
    kind = np.nonzero(space.use)[1]
    redundancy = space.redundancy[: len(kind)]
    w = np.where(redundancy > SEEN, space.residual[: len(kind)] / np.sqrt(np.maximum(redundancy, SEEN)), 0.0)
    scale = np.array([MAD * np.median(np.abs(w[kind == k])) if (kind == k).any() else 1.0 for k in range(3)])
    found: Floats = w / np.maximum(scale, 1.0)[kind]
    return found


def _finding(space: ResidualSpace, place: int, row: int, times: float) -> GrossFinding:
    """The finding of a reading, by its place among all (n, 3)."""
    recording, (i, k) = space.adjustment.recording, divmod(place, 3)
    station, target = recording.stations[recording.station[i]], recording.targets[recording.target[i]]
    arm = 1.0 if k == 0 else float(space.sightings.range_[i])
    size = abs(float(space.residual[row])) / float(space.redundancy[row]) * float(space.sigma[i, k]) * arm
    sentence = (
        f"The {OBSERVABLES[k]} from {station} to {target} (row {i + 1}) is off by {size * 1e3:.2f} mm, "
        f"{times:.0f} times what such readings scatter; without it no other reading of {target} is."
    )
    return GrossFinding(
        "outlier", np.array([i]), (station,), (target,), (OBSERVABLES[k],), size, sentence, size / times
    )
