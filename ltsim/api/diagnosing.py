"""From a recording to the physics that was left out."""

from __future__ import annotations

from ltsim.diagnose import Diagnosis, diagnose as diagnosis_of
from ltsim.recording.exchange import RecordingSource, recording_of


def diagnose(recording: RecordingSource, *, level: float = 0.05, seed: int = 0) -> Diagnosis:
    """Say whether recording and model agree; where not: where, why, how sure, and what to measure next.

    Parameters
    ----------
    recording : Recording, str or Path
    level : float
        False-alarm rate of the whole search on a clean recording.
    seed : int
        Of the draws that price the search.

    Raises
    ------
    NetworkError
        When the network cannot be solved.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> found = lt.diagnose(recording)
    >>> found.verdict, len(found.findings)
    ('consistent', 0)
    """
    return diagnosis_of(recording_of(recording), level=level, seed=seed)
