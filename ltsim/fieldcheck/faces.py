"""Two-face differences of a set-up, target by target, against what its maker guarantees or a stated limit.

Half of face 1 minus face 2, as `ltsim.evaluation.two_face` has it. Its limit is the stated noise and, since a tracker
within its specification has two-face differences too, the spread that the guaranteed errors of axes, beam and encoders
would give at that place (`setup.toml`, [instrument.prior]). A limit of its own, A um + B um/m of the full difference as
a length (the form of ASME B89.4.19), is compared as it stands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from ltsim.adjustment.prior import prior_sigmas
from ltsim.arrays import Bools, Floats
from ltsim.evaluation.two_face import TwoFace, face_pairs, two_face
from ltsim.model.construction import Construction
from ltsim.recording.recording import Recording
from ltsim.units import MICROMETRE


@dataclass(frozen=True)
class Faces:
    """Two-face half differences of one set-up."""

    pairs: TwoFace
    """As read."""
    still: TwoFace
    """Without what a motion of the station, or a drift of the instrument, adds between the faces."""
    noise: Floats
    """(m, 3) [m, rad, rad]: standard deviation of each half difference by the stated noise."""
    guarantee: Floats
    """(m, 3) [m, rad, rad]: standard deviation of what the guaranteed errors of the instrument add."""
    over: Bools
    """(m, 3): what is `still` beyond the limit."""
    limit: Floats
    """(m, 3): largest half difference that passes."""

    @classmethod
    def of(
        cls,
        recording: Recording,
        still: Recording,
        construction: Construction,
        level: float,
        mpe: tuple[float, float] | None,
    ) -> Faces | None:
        """The differences of a recording of one station; None where no target was measured on both faces.

        `still` has its readings without motions.

        `level` is the chance of one false alarm over all of them; `mpe` a limit of lengths [um], and [um/m].
        """
        if not len(face_pairs(recording)):
            return None
        pairs, unmoved = two_face(recording), two_face(still)
        sigma = recording.sigma()
        sigma[:, 1] *= np.abs(np.cos(recording.readings[:, 2]))
        noise = 0.5 * np.sqrt(np.sum(sigma[pairs.rows] ** 2, axis=1))
        prior = prior_sigmas(recording, construction)[0]
        change = [two_face(recording, construction, np.diag(prior)[k]).half - pairs.half for k in range(len(prior))]
        guarantee = np.sqrt(np.sum(np.square(change), axis=0))
        if mpe is None:
            critical = -special.ndtri(level / (2 * pairs.half.size))
            limit = critical * np.hypot(noise, guarantee)
        else:
            metres = pairs.place[:, 0]
            allowed = 0.5 * MICROMETRE * (mpe[0] + mpe[1] * metres)
            limit = np.stack([allowed, allowed / metres, allowed / metres], axis=1)
        return cls(pairs, unmoved, noise, guarantee, np.abs(unmoved.half) > limit, limit)
