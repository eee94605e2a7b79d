"""Single readings that are wrong: they come before any law, which would bend to them.

A reading is a stray one when its normalised residual (Baarda), in units of what readings of its kind really scatter, is
too large for chance, and stands alone: no other reading of its station to its target is off. With one pointing after a
moment a wrong reading is the plainer cause than a target that has moved.
"""

from __future__ import annotations

import numpy as np

from ltsim.adjustment.gross import GrossFinding
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.arrays import Bools
from ltsim.recording.recording import OBSERVABLES

WRONG, OFF = 7.0, 4.0
"""Normalised residuals of a stray reading, which noise does not reach in any recording, and of one that is off too."""
SEEN = 0.02
"""Redundancy from which a reading's own residual tells anything."""
MAD = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""
MOST = 5


def stray_readings(space: ResidualSpace, use: Bools) -> tuple[Bools, list[GrossFinding]]:
    """Readings (n, 3) to use, without stray ones, and these as findings, the worst first."""
    recording, used = space.adjustment.recording, space.use
    rows = int(used.sum())
    w = np.zeros(used.shape)
    w[used] = space.residual[:rows] / np.sqrt(np.maximum(space.redundancy[:rows], SEEN))
    scale = np.array([MAD * np.median(np.abs(w[used[:, k], k])) if used[:, k].any() else 1.0 for k in range(3)])
    w /= np.maximum(scale, 1.0)
    pair = recording.station * len(recording.targets) + recording.target
    off = np.bincount(pair, (np.abs(w) > OFF).sum(axis=1))
    row, column = np.nonzero((np.abs(w) > WRONG) & (off[pair] == 1)[:, None])
    worst = np.argsort(-np.abs(w[row, column]))[:MOST]
    use, found = use.copy(), []
    for i, k in zip(row[worst].tolist(), column[worst].tolist(), strict=True):
        use[i, k] = False
        station, target = recording.stations[recording.station[i]], recording.targets[recording.target[i]]
        arm = 1.0 if k == 0 else float(space.sightings.range_[i])
        redundancy = max(float(space.redundancy[np.flatnonzero(np.flatnonzero(used) == 3 * i + k)[0]]), SEEN)
        size = abs(float(space.adjustment.residuals[i, k])) * arm / redundancy
        sentence = (
            f"The {OBSERVABLES[k]} from {station} to {target} (row {i + 1}) is off by {size * 1e3:.2f} mm, "
            f"{abs(w[i, k]):.0f} times what such readings scatter; the others there are not."
        )
        found.append(GrossFinding("outlier", np.array([i]), (station,), (target,), (OBSERVABLES[k],), size, sentence))
    return use, found
