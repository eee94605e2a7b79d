"""What a set-up says of points that nobody measured, and that therefore changes nothing: told, not passed over."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Iterable

from ltsim.recording.files import shown
from ltsim.recording.recording import Recording


def idle_settings(recording: Recording) -> tuple[str, ...]:
    """Notes on settings without effect: marks and datum points that nothing reaches, a lone reference radius."""
    setup, notes = recording.setup, []
    marks = Counter(s.over for name, s in setup.stations.items() if s.over and name in recording.stations)
    for name in recording.stations:
        over = recording.station_setup(name).over
        if over and over not in recording.targets and over not in setup.targets and marks[over] == 1:
            notes.append(
                f"stations.{name}.over names '{shown(over)}', which no pointing and no other set-up names: "
                f"it holds nothing{_near(over, recording.targets)}"
            )
    for name, target in setup.targets.items():
        if target.datum and name not in recording.targets and name not in marks:
            notes.append(
                f"targets.{name} is of the datum but was never measured: left out{_near(name, recording.targets)}"
            )
    if setup.reference_radius_mm is not None and not setup.reflectors:
        notes.append("reference_radius_mm changes nothing: no table [reflectors.NAME] gives an SMR its radius")
    return tuple(notes)


def _near(name: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, list(known), n=3, cutoff=0.5)
    return f"; did you mean {', '.join(near)}?" if near else ""
