"""Two-face half differences: what the two faces of an instrument say differently about the same target.

The difference between faces needs no network, no nominal and no second station: whatever flips with the face is in
it, doubled. Parameters found elsewhere that make it smaller are right about the instrument.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import NetworkError
from ltsim.geometry.polar import to_polar, wrap
from ltsim.physics.model.construction import Construction, ideal
from ltsim.recordings.recording import Recording


@dataclass(frozen=True)
class TwoFace:
    """Pairs of pointings of one station to one target on both faces."""

    rows: Ints
    """Rows of the recording: face 1, face 2, (m, 2)."""
    place: Floats
    """Mean front-face range, azimuth, elevation, (m, 3) [m, rad, rad]."""
    half: Floats
    """(m, 3) [m, rad, rad]: half of face 1 minus face 2: range, azimuth across the beam (times the cosine of the
    elevation), elevation.
    """

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def rms(self) -> Floats:
        """(3,) root mean square of the half differences: range [m], azimuth across the beam, elevation [rad]."""
        return np.sqrt(np.mean(self.half**2, axis=0))

    @property
    def median(self) -> Floats:
        """(3,) median of the absolute half differences, which a few gross errors do not move."""
        return np.median(np.abs(self.half), axis=0)

    def only(self, pairs: Bools) -> Self:
        """Subset of the pairs, (m,) bool."""
        return replace(self, rows=self.rows[pairs], place=self.place[pairs], half=self.half[pairs])


def face_pairs(recording: Recording) -> Ints:
    """Rows (m, 2) of complete pointings on face 1 and face 2 of the same station, target and repeat."""
    whole = np.all(recording.usable, axis=1)
    rows_by_key: dict[tuple[int, int, int], dict[int, int]] = {}
    keys = zip(recording.station.tolist(), recording.target.tolist(), recording.repeat.tolist(), strict=True)
    for row, key in enumerate(keys):
        if whole[row]:
            rows_by_key.setdefault(key, {})[int(recording.face[row])] = row
    pairs = [(faces[1], faces[2]) for faces in rows_by_key.values() if len(faces) == 2]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def two_face(recording: Recording, construction: Construction | None = None, values: Floats | None = None) -> TwoFace:
    """Half differences of a recording, with parameters (p,) or (n, p) [SI] of a construction applied.

    By default of an ideal tracker, that is, the readings as they are. Raises NetworkError when no target was measured
    on both faces.
    """
    pairs = face_pairs(recording)
    if not len(pairs):
        raise NetworkError("no station measured a target in range and both angles on both faces")
    built = construction or ideal()
    applied = np.zeros(built.size) if values is None else values
    readings = np.where(recording.measured, recording.readings, 1.0)
    polar = to_polar(built.point(readings, applied))
    first, second = polar[pairs[:, 0]], polar[pairs[:, 1]]
    gap = first - second
    gap[:, 1:] = wrap(gap[:, 1:])
    place = first - 0.5 * gap
    half = 0.5 * gap
    half[:, 1] *= np.cos(place[:, 2])
    return TwoFace(pairs, place, half)
