"""The public function of the check in the field."""

from __future__ import annotations

from ltsim.fieldcheck.check import Check, check as check_of
from ltsim.fieldcheck.faces import Mpe
from ltsim.recording.exchange import RecordingSource, recording_of
from ltsim.units import MICROMETRE


def check(recording: RecordingSource, *, level: float = 0.01, mpe: tuple[float, float] | None = None) -> Check:
    """Go or no-go in the field: two-face differences, repeated points, drift, bumps and scatter.

    Parameters
    ----------
    recording : Recording, str or Path
    level : float
        Chance of one false alarm in the whole recording.
    mpe : pair of float, optional
        Limit of two-face differences as lengths, [um] and [um/m] of the range: ``(20, 6)``; default by the stated noise
        and what the maker guarantees.

    Raises
    ------
    NetworkError
        When nothing was measured twice.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> lt.check(recording).passed
    True
    """
    limit = None if mpe is None else Mpe(mpe[0] * MICROMETRE, mpe[1] * MICROMETRE)
    return check_of(recording_of(recording), level=level, mpe=limit)
