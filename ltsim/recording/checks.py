"""What a set-up says without effect, or needs for more than it is known: told, not passed over."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Iterable

import numpy as np

from ltsim.recording.files import shown
from ltsim.recording.recording import Recording
from ltsim.recording.reflectors import excess_radii
from ltsim.units import DEGREE, MILLIMETRE


def notes_on_setup(recording: Recording) -> tuple[str, ...]:
    """Notes on marks that nothing else names, datum points that nothing reaches, normals that the floor plan holds."""
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
    excess = excess_radii(recording)
    if excess is not None and not any(t.known_mm or t.datum for t in setup.targets.values()):
        off = np.abs(excess).max() * DEGREE / MILLIMETRE
        notes.append(
            "balls of several radii: normals of nests are those of the floor plan, and each degree by which the rough "
            f"places of the stations turn it moves a ball by up to {off:.2f} mm; known points would hold the frame"
        )
    return tuple(notes)


def _near(name: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, list(known), n=3, cutoff=0.5)
    return f"; did you mean {', '.join(near)}?" if near else ""
